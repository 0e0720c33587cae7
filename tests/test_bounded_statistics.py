"""Statistics of long sound and of many pictures: LeRobot's figures, without LeRobot's memory."""

import tracemalloc

import numpy as np
import pytest
from lerobot.datasets.compute_stats import get_feature_stats

from lerobot_playbyear.datasets.statistics import channel_stats, sound_stats


@pytest.mark.parametrize("kind", ["quiet", "loud", "constant", "one sample", "clipped"])
@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_sound_in_pieces_has_the_statistics_that_lerobot_has_of_all_samples(kind, dtype):
    rng = np.random.default_rng(0)
    shape = (1, 1) if kind == "one sample" else (1500, 800)  # more than a piece
    samples = rng.normal(3, {"quiet": 20, "clipped": 30000}.get(kind, 3000), shape)
    samples = np.clip(np.full(shape, 7.0) if kind == "constant" else samples, -32768, 32767)
    waveform = samples.astype(np.int16) if dtype is np.int16 else (samples / 32768).astype(np.float32)

    ours = sound_stats(waveform)

    lerobots = get_feature_stats(waveform.astype(np.float64).reshape(-1, 1), axis=0, keepdims=False)
    assert set(ours) == set(lerobots)
    assert ours.pop("count") == [len(waveform)]
    for name, value in ours.items():
        assert value.shape == (shape[1],)
        assert value[0] == pytest.approx(
            float(lerobots[name][0]), rel=1e-4 if dtype is np.float32 else 2e-5, abs=1e-9
        ), name


def test_statistics_of_sound_take_no_memory_that_grows_with_it():
    waveform = np.random.default_rng(0).normal(0, 300, (6000, 1600)).astype(np.int16)  # 19 MB
    tracemalloc.start()
    sound_stats(waveform)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * waveform.nbytes  # 16 bytes a sample would be eight times


def test_pictures_in_pieces_have_the_statistics_that_lerobot_has_of_them():
    pictures = np.random.default_rng(0).integers(0, 200, (37, 3, 20, 30), dtype=np.uint8)
    pictures[:, 1] //= 5

    ours = channel_stats(lambda: (pictures[i : i + 10] for i in range(0, 37, 10)), 37)

    lerobots = get_feature_stats(pictures, axis=(0, 2, 3), keepdims=True)
    assert ours.pop("count") == lerobots.pop("count") == [37]
    for name, value in ours.items():
        assert value.shape == (3, 1, 1)
        np.testing.assert_allclose(value, np.squeeze(lerobots[name] / 255, axis=0), rtol=1e-4, atol=1e-6)
