"""The latency of sound beside pictures is found from taps, whatever the rate of pictures, or refused."""

import numpy as np
import pytest

from lerobot_playbyear.calibration.estimator import CalibrationError, estimate_latency


def recorded(
    latency_s: float,
    *,
    event: str = "begins",
    n_taps: int = 10,
    fps: float = 30.0,
    seed: int = 0,
    wrong: int = 0,
    jitter_s: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times and motion of pictures, times and level of sound, of taps about 0.8 s apart."""
    rng = np.random.default_rng(seed)
    taps = 1 + np.arange(n_taps) * 0.8 + rng.uniform(0, 0.1, n_taps)
    picture_times = np.arange(0, taps[-1] + 1, 1 / fps) + rng.uniform(0, 0.002)
    places = np.zeros(len(picture_times))  # of a hand that moves for 0.2 s, or a lamp that changes at once
    for tap in taps:
        begin = tap - 0.2 if event == "stops" else tap
        places += np.clip((picture_times - begin) / 0.2, 0, 1) if event == "stops" else picture_times >= tap
    motion = np.abs(np.diff(places, prepend=0)) + rng.uniform(0, 0.002, len(places))
    sound_times = np.arange(0, taps[-1] + 1, 0.001)
    level = rng.uniform(0, 5, len(sound_times))
    for index, tap in enumerate(taps):
        heard = tap + latency_s + rng.normal(0, jitter_s) + (0.3 if index < wrong else 0)
        since = sound_times - heard
        level += np.where(since >= 0, 3000 * np.exp(-since / 0.02), 0)
    return picture_times, motion, sound_times, level


@pytest.mark.parametrize("event", ["begins", "stops"])
@pytest.mark.parametrize("latency_s", [0.037, 0.0, -0.08, 0.25])
@pytest.mark.parametrize("fps", [15, 30, 60])
def test_the_latency_is_found_finer_than_the_rate_of_pictures(event, latency_s, fps):
    errors = []
    for seed in range(10):
        found = estimate_latency(*recorded(latency_s, event=event, fps=fps, seed=seed, jitter_s=0.001), event=event)
        errors.append(abs(found.latency_s - latency_s))
        assert abs(found.latency_s - latency_s) <= found.resolution_s + 0.004
    assert np.median(errors) < 0.2 / fps + 0.001


def test_sounds_that_belong_to_nothing_do_not_move_it():
    found = estimate_latency(*recorded(0.037, wrong=3), event="begins")
    assert found.latency_s == pytest.approx(0.037, abs=0.008)
    assert len(found.taps) == 7
    assert found.n_heard == 10


@pytest.mark.parametrize(
    ("options", "said"),
    [({"n_taps": 4}, "5 are needed"), ({"jitter_s": 0.2, "n_taps": 12}, "spread|belong together")],
)
def test_too_few_taps_and_taps_that_disagree_are_refused(options, said):
    with pytest.raises(CalibrationError, match=said):
        estimate_latency(*recorded(0.037, **options), event="begins")


def test_silence_and_a_picture_in_which_nothing_moves_are_refused():
    picture_times, motion, sound_times, level = recorded(0.037)
    with pytest.raises(CalibrationError, match="0 sounds"):
        estimate_latency(picture_times, motion, sound_times, np.zeros_like(level))
    with pytest.raises(CalibrationError, match="0 motions"):
        estimate_latency(picture_times, np.zeros_like(motion), sound_times, level)
