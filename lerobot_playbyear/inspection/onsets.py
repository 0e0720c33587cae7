"""Sudden sounds, and whether they come when the arm's motion changes.

Method. A sudden sound is a moment at which the level of 5 ms of sound rises more than 12 dB above its
median in the episode, after 50 ms in which it did not. A change of motion is a frame in which the second difference of
`observation.state` (or of `action`, in a dataset without a state) is, in any dimension measured in that dimension's
standard deviation, among the largest tenth of the dataset. Both coincide when they are at most one frame apart.
Chance is the share of frames that are so close to a change of motion. The same count with the sound moved by up to
half a second says where the two fit best. Contact is one reason for both, so in most datasets they coincide more often
than chance would have it; a command that is heard later (a hand that takes time to close) shows as a lag. It is
information, not a verdict: whether the motion must be heard is the task's business.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from lerobot.utils.constants import OBS_STATE

from lerobot_playbyear.inspection.source import DatasetSource, Episode
from lerobot_playbyear.inspection.verdict import Verdict
from lerobot_playbyear.inspection.waveform import Samples, block_levels

STEP_S = 0.005
"""How finely sudden sounds are placed [s]."""

_RISE_DB = 12.0
_QUIET_BEFORE_S = 0.05
_LARGEST = 0.1  # share of the frames that count as changes of motion
_SEARCH_S = 0.5
_MIN_ONSETS = 5


def sudden_sounds(samples: Samples, sample_rate: float) -> np.ndarray:
    """When sudden sounds begin in an episode, (k,) seconds from its first sample.

    Args:
        samples: (n,) in steps of 16-bit PCM.
        sample_rate: [Hz].
    """
    step = max(round(STEP_S * sample_rate), 1)
    levels = block_levels(samples, step)
    if len(levels) == 0:
        return np.empty(0)
    loud = levels > np.median(levels) + _RISE_DB
    quiet_steps = round(_QUIET_BEFORE_S / STEP_S)
    recent = np.convolve(loud, np.ones(quiet_steps + 1))[: len(loud)] - loud  # loud steps just before
    return np.flatnonzero(loud & (recent == 0)) * step / sample_rate


def check_alignment(source: DatasetSource, microphones: Sequence[str]) -> Iterator[Verdict]:
    """How often sudden sounds and changes of motion coincide, for each of these microphones."""
    motion_key = source.motion_key
    if motion_key is None:
        return
    motion = _motion_changes(source, motion_key)
    for key in microphones:
        onsets = [_onset_frames(source, key, episode) for episode in source.episodes]
        n_onsets = sum(len(frames) for frames in onsets)
        if n_onsets < _MIN_ONSETS:
            message = f"{n_onsets} sudden sounds: too few to compare them with the arm's motion"
            yield Verdict("sound and motion", "info", message, key, figures={"sudden_sounds": n_onsets})
            continue
        search = round(_SEARCH_S * source.fps)
        shares = {shift: _coincidence(onsets, motion, shift) for shift in range(-search, search + 1)}
        chance = float(np.mean([_near(changes).mean() for changes in motion]))
        best = max(shares, key=lambda shift: (shares[shift], -abs(shift)))
        message = (
            f"{n_onsets} sudden sounds; {shares[0]:.0%} come within a frame of a change of motion ({motion_key}), "
            f"by chance {chance:.0%} would"
        )
        if best != 0 and shares[best] > shares[0]:
            moment = "after" if best > 0 else "before"
            message += f"; {shares[best]:.0%} come {abs(best) / source.fps:.3g} s {moment} one"
        figures = {
            "sudden_sounds": n_onsets,
            "coincide": shares[0],
            "by_chance": chance,
            "best_lag_s": best / source.fps,
        }
        yield Verdict("sound and motion", "info", message, key, figures=figures)


def _onset_frames(source: DatasetSource, key: str, episode: Episode) -> np.ndarray:
    """The frames, from the episode's start, at which a sudden sound had been heard."""
    sound = source.sound(key, episode)
    times = sudden_sounds(sound, sound.samples_per_frame * source.fps)
    # Row i ends with picture i, so a sound inside row i is seen, at the earliest, in picture i.
    return np.minimum((times * source.fps).astype(int), len(episode) - 1)


def _motion_changes(source: DatasetSource, key: str) -> list[np.ndarray]:
    """For every episode the frames of large changes, (n,) bool."""
    order = 2 if key == OBS_STATE else 1
    values = np.nan_to_num(source.rows(key))
    changes = []
    for episode in source.episodes:
        change = np.zeros((len(episode), values.shape[1]))
        if len(episode) > 2:
            change[1 : len(episode) - order + 1] = np.abs(np.diff(values[episode.rows], n=order, axis=0))
        changes.append(change)
    scale = np.concatenate(changes).std(axis=0) + 1e-12
    sizes = [(change / scale).max(axis=1) for change in changes]
    threshold = np.quantile(np.concatenate(sizes), 1 - _LARGEST)
    return [size > threshold for size in sizes]


def _coincidence(onsets: list[np.ndarray], motion: list[np.ndarray], shift: int) -> float:
    """Share of the sounds that, moved `shift` frames earlier, come within a frame of a change of motion."""
    hits = n = 0
    for frames, changes in zip(onsets, motion, strict=True):
        moved = frames - shift
        inside = moved[(moved >= 0) & (moved < len(changes))]
        hits += int(_near(changes)[inside].sum())
        n += len(frames)
    return hits / n


def _near(changes: np.ndarray) -> np.ndarray:
    """Frames at most one frame from a True one, (n,) bool."""
    near = changes.copy()
    near[1:] |= changes[:-1]
    near[:-1] |= changes[1:]
    return near
