"""Sound brought to another rate while it is read: the level and the phase that the other rate would have recorded."""

import numpy as np
import pytest
import torch
from dataset_factory import MICROPHONE, TASK, audio_feature
from lerobot.datasets import LeRobotDataset

from lerobot_playbyear.datasets import EpisodeStore, resampling
from lerobot_playbyear.datasets.resampling import resampled_pieces

FPS, LENGTHS = 20, (7, 12)
HERTZ = (440.0, 1330.0)  # an episode each, so that what leaks into its neighbour is seen
LEVEL = 0.4
REACH = 80  # samples at 16 kHz that the resampler's filter sees


def tone(rate: int, episode: int) -> np.ndarray:
    """(n,) in [-1, 1], cut off where it is loud."""
    time = np.arange(LENGTHS[episode] * rate // FPS) / rate
    return LEVEL * np.cos(2 * np.pi * HERTZ[episode] * time + 0.3)


def write(root, rate: int, dtype: str = "int16") -> LeRobotDataset:
    features = {
        MICROPHONE: {**audio_feature(rate, FPS), "dtype": dtype},
        "observation.state": {"dtype": "float32", "shape": (2,), "names": None},
        "action": {"dtype": "float32", "shape": (2,), "names": None},
    }
    dataset = LeRobotDataset.create("tests/tones", FPS, features, root=root, use_videos=False)
    for episode, length in enumerate(LENGTHS):
        samples = tone(rate, episode).reshape(length, -1)
        samples = np.round(samples * 32768).astype(np.int16) if dtype == "int16" else samples.astype(dtype)
        for i, block in enumerate(samples):
            low = np.full(2, i, np.float32)
            dataset.add_frame({MICROPHONE: block, "observation.state": low, "action": low, "task": TASK})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("tests/tones", root=root)


@pytest.fixture(scope="module")
def tones(tmp_path_factory) -> dict[int, LeRobotDataset]:
    folder = tmp_path_factory.mktemp("tones")
    return {rate: write(folder / str(rate), rate) for rate in (16000, 44100, 48000)}


def load(dataset, rate=None, **options) -> EpisodeStore:
    rates = None if rate is None else {MICROPHONE: rate}
    return EpisodeStore.from_dataset(dataset, device="cpu", sample_rates=rates, **options)


@pytest.mark.parametrize(("recorded", "wanted"), [(48000, 16000), (16000, 48000), (44100, 16000)])
def test_windows_are_those_that_the_other_rate_would_have_recorded(tones, recorded, wanted):
    deltas = {MICROPHONE: range(-30, 1), "observation.state": [0]}
    last = [0, 3, 6, 7, 12, 18]  # first, middle and last frame of both episodes
    batch, expected = load(tones[recorded], wanted).windows(last, deltas), load(tones[wanted]).windows(last, deltas)

    assert batch[MICROPHONE].dtype == torch.int16
    assert torch.equal(batch[f"{MICROPHONE}_is_pad"], expected[f"{MICROPHONE}_is_pad"])
    assert torch.equal(batch["observation.state"], expected["observation.state"])
    wrong = (batch[MICROPHONE].int() - expected[MICROPHONE].int()).abs()
    if wanted > recorded:  # an episode's last sample stands for more than one, which nobody heard
        wrong = wrong[..., : 1 - wanted // recorded]
    assert wrong.max() <= 0.02 * LEVEL * 32768


@pytest.mark.parametrize(("recorded", "wanted"), [(48000, 16000), (16000, 48000)])
def test_only_the_edges_of_episodes_differ_by_more_than_rounding(tones, recorded, wanted):
    store = load(tones[recorded], wanted)
    for episode, (start, end) in enumerate(zip(store.starts, store.ends, strict=True)):
        wrong = store.column(MICROPHONE)[start:end].reshape(-1).numpy() - tone(wanted, episode) * 32768
        edge = REACH * wanted // 16000
        assert np.abs(wrong[edge:-edge]).max() <= 3
        after = max(wanted // recorded - 1, 0)  # after the last sample that was recorded
        assert np.abs(wrong[: len(wrong) - after]).max() <= 0.02 * LEVEL * 32768
        assert np.abs(wrong).max() <= 0.15 * LEVEL * 32768


def test_what_the_lower_rate_cannot_hold_is_gone_and_not_folded_back(tmp_path, monkeypatch):
    monkeypatch.setattr(f"{__name__}.HERTZ", (9000.0, 12000.0))
    sound = load(write(tmp_path / "high", 48000), 16000).column(MICROPHONE)[1:6].float()
    assert sound.square().mean().sqrt() < 0.01 * LEVEL * 32768


def test_pieces_make_the_same_as_the_whole_and_any_row_can_be_the_first(tones, monkeypatch):
    whole = np.concatenate(list(resampled_pieces(tones[48000], MICROPHONE, 16000)))
    monkeypatch.setattr(resampling, "_SAMPLES_AT_ONCE", 1600)
    pieces = list(resampled_pieces(tones[48000], MICROPHONE, 16000))
    assert [len(piece) for piece in pieces] == [2, 2, 2, 1, 2, 2, 2, 2, 2, 2]
    assert np.abs(np.concatenate(pieces).astype(int) - whole).max() <= 1
    for first in (1, 7, 10):
        rest = np.concatenate(list(resampled_pieces(tones[48000], MICROPHONE, 16000, first)))
        assert np.abs(rest.astype(int) - whole[first:]).max() <= 1


def test_sound_at_full_scale_is_cut_off_and_does_not_turn_over(tmp_path, monkeypatch):
    monkeypatch.setattr(f"{__name__}.tone", tone_of_square)
    sound = load(write(tmp_path / "square", 48000), 16000).column(MICROPHONE)
    assert (sound.max(), sound.min()) == (32767, -32768)  # a band-limited square reaches further than the square
    square = np.sign(np.concatenate([tone_of_square(16000, episode) for episode in (0, 1)]))
    assert (np.sign(sound.reshape(-1).numpy()) == square).mean() > 0.95


def tone_of_square(rate: int, episode: int) -> np.ndarray:
    return 32767 / 32768 * np.sign(np.sin(2 * np.pi * 100 * (np.arange(LENGTHS[episode] * rate // FPS) + 0.5) / rate))


def test_floats_stay_floats_and_nan_is_refused(tmp_path):
    store = load(write(tmp_path / "floats", 48000, "float32"), 16000)
    assert store.column(MICROPHONE).dtype == torch.float32
    assert np.abs(store.column(MICROPHONE)[:7].reshape(-1).numpy() - tone(16000, 0)).max() < 0.01 * LEVEL


def test_the_disk_holds_the_same_and_a_folder_for_each_rate(tones, tmp_path):
    dataset = tones[48000]
    own = load(dataset, place="disk", cache=tmp_path)
    assert torch.equal(load(dataset, 48000, place="disk", cache=tmp_path).column(MICROPHONE), own.column(MICROPHONE))
    assert len([path for path in tmp_path.iterdir() if path.is_dir()]) == 1
    for rate in (16000, 8000):
        for _ in range(2):
            kept = load(dataset, rate, place="disk", cache=tmp_path)
            assert torch.equal(kept.column(MICROPHONE), load(dataset, rate).column(MICROPHONE))
    assert len([path for path in tmp_path.iterdir() if path.is_dir()]) == 3


def test_a_rate_that_frames_do_not_divide_is_refused(tones):
    with pytest.raises(ValueError, match=r"sample_rate / fps = 16001 / 20"):
        load(tones[48000], 16001)
