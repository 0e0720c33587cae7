"""Checks of what was done and what it sounded like: actions, interventions, success; how much later sound comes than pictures.

Sudden sounds. A sudden sound is a moment at which the level of 5 ms of sound rises more than 12 dB above its median in the
episode, after 50 ms in which it did not. (Training's onsets, `policy/auxiliary.py`, are steps of the policy's spectrogram.)

Sound and picture. A contact is heard as a sudden sound, and seen as a motion that ends: the difference of a picture from
the one before, which stood out, no longer does. A picture shows that something moved since the one before, not when, so
each contact allows delays of one picture's time. The delay is the middle of what most contacts allow, which is finer than
that. Where too few contacts agree, nothing is said.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from lerobot_playbyear.datasets.features import INTERVENTION
from lerobot_playbyear.datasets.findings import Finding, Level, name_episodes
from lerobot_playbyear.datasets.frame_rate import sample_rate_of
from lerobot_playbyear.datasets.reader import EpisodeRows, SurveyedDataset
from lerobot_playbyear.inspection.sound import FULL_SCALE, heard, runs

SUCCESS = "next.success"

_ACTION = "action"
_NORMALISED_SHARE = 0.9  # of all values in [-1, 1]: then the actions are taken to be normalised

STEP_S = 0.005
"""How finely sudden sounds are placed [s]."""

_RISE_DB = 12.0
_QUIET_BEFORE_S = 0.05
_POWER_FLOOR = 1e-12

_FEWEST = 5  # contacts
_AGREEING = 2 / 3  # of the contacts, at least
_QUIET_S = 0.25  # between two contacts, at least: of sound, and of motion
_FARTHEST_S = 0.6  # from a sound to the motion that belongs to it
_STANDS_OUT = 3.0  # times the usual difference of two pictures: a motion's largest
_SHARE_OF_PEAK = 0.15  # of a motion's largest difference, above which something moves
_JITTER_S = STEP_S / 2 + 0.001  # by which single sounds are off
_WIDEST = 160  # pixels that are looked at; a hand is larger


def check_actions(dataset: SurveyedDataset, bounds: Sequence[float] | None = None) -> Iterator[Finding]:
    """Actions stay in their range, and each of their dimensions is used.

    Args:
        dataset: The dataset.
        bounds: Lowest and highest value allowed; beyond them is an error. None: where nine values in ten lie in
            [-1, 1] that range is taken to be meant, and beyond it is a warning.
    """
    if _ACTION not in dataset.numbers:
        if _ACTION not in dataset.unreadable:
            yield Finding("actions", "warning", f"no '{_ACTION}' column: nothing can be learned from this dataset")
        return
    actions = dataset.values(_ACTION).reshape(len(dataset), -1)
    finite: np.ndarray = np.where(np.isfinite(actions), actions, 0)  # (N, D)
    low, high = bounds if bounds is not None else (-1.0, 1.0)
    outside = np.abs(finite - np.clip(finite, low, high)).max(axis=1) > 0  # (N,)
    normalised = bool((np.abs(finite) <= 1).mean() >= _NORMALISED_SHARE)
    seen = f"{finite.min():.4g} to {finite.max():.4g}"
    figures = {"min": float(finite.min()), "max": float(finite.max()), "frames_outside": int(outside.sum())}
    if bounds is None and not normalised:
        message = f"{actions.shape[1]} dimensions, {seen}; say the range allowed to have it checked (--action_range)"
        yield Finding("action range", "info", message, _ACTION, figures={**figures, "frames_outside": None})
    elif outside.any():
        episodes = [e.index for e in dataset.episodes if outside[e.rows].any()]
        level: Level = "error" if bounds is not None else "warning"
        message = f"{int(outside.sum())} frames outside [{low:g}, {high:g}] ({name_episodes(episodes)}): {seen}"
        yield Finding("action range", level, message, _ACTION, episodes, figures)
    else:
        yield Finding("action range", "ok", f"{seen}, inside [{low:g}, {high:g}]", _ACTION, figures=figures)
    constant = np.flatnonzero(np.ptp(finite, axis=0) == 0)
    if len(constant) and len(dataset) > 1:
        message = f"dimension{'s' if len(constant) > 1 else ''} {', '.join(map(str, constant))} never changes"
        yield Finding("actions used", "warning", message, _ACTION, figures={"constant": constant.tolist()})
    else:
        yield Finding("actions used", "ok", f"all {actions.shape[1]} dimensions change", _ACTION)


def check_interventions(dataset: SurveyedDataset) -> Iterator[Finding]:
    """How much of the dataset the expert acted in."""
    if INTERVENTION not in dataset.numbers:
        if INTERVENTION not in dataset.unreadable:
            yield Finding("interventions", "info", f"no '{INTERVENTION}' column")
        return
    tagged = dataset.values(INTERVENTION).astype(bool)
    spans = sum(len(runs(tagged[episode.rows])) for episode in dataset.episodes)
    share = float(tagged.mean())
    without = [episode.index for episode in dataset.episodes if not tagged[episode.rows].any()]
    figures = {"share": share, "spans": spans, "episodes_without": len(without)}
    if share == 1:
        message = "the expert was in control throughout: demonstrations"
    elif share == 0:
        message = "the expert never acted: rollouts"
    else:
        message = f"the expert acted in {share:.1%} of the frames, in {spans} spans"
        message += f"; not at all in {name_episodes(without)}" if without else "; in every episode"
    yield Finding("interventions", "ok", message, INTERVENTION, without if 0 < share < 1 else (), figures)


def check_success(dataset: SurveyedDataset) -> Iterator[Finding]:
    """How many episodes reached the task's goal."""
    if SUCCESS not in dataset.numbers:
        if SUCCESS not in dataset.unreadable:
            yield Finding("success", "info", f"no '{SUCCESS}' column")
        return
    failed = [episode.index for episode in dataset.episodes if first_success(dataset, episode) == -1]
    n_episodes = len(dataset.episodes)
    n_succeeded = n_episodes - len(failed)
    message = f"{n_succeeded} of {n_episodes} episodes succeeded"
    figures = {"succeeded": n_succeeded, "episodes": n_episodes}
    yield Finding("success", "ok" if n_succeeded else "warning", message, SUCCESS, failed, figures)


def first_success(dataset: SurveyedDataset, episode: EpisodeRows) -> int | None:
    """The first frame, counted from the episode's start, with success; -1 without success, None if not known."""
    if SUCCESS not in dataset.numbers:
        return None
    frames = np.flatnonzero(dataset.values(SUCCESS, episode))
    return int(frames[0]) if len(frames) else -1


def block_levels(samples: np.ndarray, size: int) -> np.ndarray:
    """Level of every `size` samples (n,), without the mean of all, (n // size,) [dBFS]; -120 for nothing at all."""
    blocks = (samples - samples.mean(dtype=np.float64).astype(np.float32))[: len(samples) // size * size]
    power = np.square(blocks.reshape(-1, size) / FULL_SCALE, dtype=np.float64).mean(axis=1)
    return 10 * np.log10(power + _POWER_FLOOR)


def sudden_sounds(samples: np.ndarray, sample_rate: float) -> np.ndarray:
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


def difference(picture: np.ndarray, before: np.ndarray) -> float:
    """How much a picture (H, W, 3) uint8 differs from the one before, in grey levels."""
    step = max(picture.shape[1] // _WIDEST, 1)
    small = [image[::step, ::step].astype(np.int16) for image in (picture, before)]
    return float(np.abs(small[0] - small[1]).mean())


def check_delay(dataset: SurveyedDataset, motion: Mapping[str, Sequence[Sequence[float]]]) -> Iterator[Finding]:
    """How much later the sound of each microphone comes than each camera's pictures, where contacts tell it.

    Args:
        dataset: The dataset.
        motion: Of each camera and episode how much every picture differs from the one before (`difference`).
    """
    for key in dataset.timed_microphones:
        rate = sample_rate_of(dataset.features[key]["shape"][0], dataset.fps)
        # Row i ends with picture i: the first row was heard before the first picture.
        onsets = (sudden_sounds(heard(dataset, key, episode), rate) for episode in dataset.episodes)
        sounds = [_apart(times) + STEP_S / 2 - 1 / dataset.fps for times in onsets]
        for camera, episodes in motion.items():
            seen = [_motion_ends(np.asarray(each), dataset.fps) for each in episodes]
            contacts = np.concatenate([np.zeros((0, 2)), *map(_delays, sounds, seen)])  # (k, 2) [s]
            if len(contacts) >= _FEWEST:
                yield from _told(contacts, key, camera)


def _apart(times_s: np.ndarray) -> np.ndarray:
    """Those [s] that come after a time without one."""
    return times_s[np.diff(times_s, prepend=-np.inf) > _QUIET_S]


def _motion_ends(motion: np.ndarray, fps: float) -> np.ndarray:
    """Between which times motions end, (k, 2) [s]."""
    floor = float(np.median(motion)) if len(motion) else 0.0
    peak = float(np.sort(motion)[-5:].mean()) if len(motion) else 0.0  # a single disturbed picture does not set it
    if not peak > _STANDS_OUT * floor:
        return np.zeros((0, 2))
    moving = np.flatnonzero(motion > floor + _SHARE_OF_PEAK * (peak - floor))
    last = moving[np.diff(moving, append=np.inf) > _QUIET_S * fps]
    # What stopped in the first part of a picture's time has moved too little to be seen in it.
    return (np.stack([last - 1, last], axis=1) + _SHARE_OF_PEAK) / fps


def _delays(heard: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The least and the largest delay [s] that each contact allows, (k, 2): to a sound belongs the nearest motion."""
    if len(heard) == 0 or len(seen) == 0:
        return np.zeros((0, 2))
    away = np.abs(heard[:, None] - seen.mean(axis=1))  # (sounds, motions)
    nearest = away.argmin(axis=1)
    own = (away[:, nearest].argmin(axis=0) == np.arange(len(heard))) & (away.min(axis=1) <= _FARTHEST_S)
    return (heard[:, None] - seen[nearest, ::-1])[own]


def _told(contacts: np.ndarray, microphone: str, camera: str) -> Iterator[Finding]:
    lows, highs = contacts[:, 0] - _JITTER_S, contacts[:, 1] + _JITTER_S
    tried = np.arange(lows.min(), highs.max(), 0.0005)
    votes = ((tried[:, None] >= lows) & (tried[:, None] <= highs)).sum(axis=1)
    delay = float(np.median(tried[votes == votes.max()]))
    agreeing = contacts[(lows <= delay) & (delay <= highs)].mean(axis=1)
    if len(agreeing) < max(_FEWEST, _AGREEING * len(contacts)):
        return
    spread = float(np.median(np.abs(agreeing - np.median(agreeing))))
    side = "after" if delay >= 0 else "before"
    message = (
        f"sound comes {abs(delay) * 1000:.0f} ms {side} the picture of {camera} (spread {spread * 1000:.0f} ms, "
        f"{len(agreeing)} contacts)"
    )
    figures = {"delay_s": round(delay, 4), "spread_s": round(spread, 4), "contacts": len(agreeing)}
    yield Finding("sound and picture", "info", message, microphone, figures=figures)
