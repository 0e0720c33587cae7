"""Checks of what was done: actions, interventions, success."""

from collections.abc import Iterator, Sequence

import numpy as np
from lerobot.utils.constants import ACTION

from lerobot_playbyear.inspection.source import INTERVENTION, SUCCESS, DatasetSource
from lerobot_playbyear.inspection.verdict import Level, Verdict, name_episodes
from lerobot_playbyear.inspection.waveform import runs

_NORMALISED_SHARE = 0.9  # of all values in [-1, 1]: then the actions are taken to be normalised


def check_actions(source: DatasetSource, bounds: Sequence[float] | None = None) -> Iterator[Verdict]:
    """Actions stay in their range, and each of their dimensions is used.

    Args:
        source: The dataset.
        bounds: Lowest and highest value allowed; beyond them is an error. None: where nine values in ten lie in
            [-1, 1] that range is taken to be meant, and beyond it is a warning.
    """
    if ACTION in source.unreadable:
        return
    if ACTION not in source.numbers:
        yield Verdict("actions", "warning", f"no '{ACTION}' column: nothing can be learned from this dataset")
        return
    actions = source.values(ACTION).reshape(len(source), -1)
    finite: np.ndarray = np.where(np.isfinite(actions), actions, 0)  # (N, D)
    low, high = bounds if bounds is not None else (-1.0, 1.0)
    outside = np.abs(finite - np.clip(finite, low, high)).max(axis=1) > 0  # (N,)
    normalised = bool((np.abs(finite) <= 1).mean() >= _NORMALISED_SHARE)
    seen = f"{finite.min():.4g} to {finite.max():.4g}"
    figures = {"min": float(finite.min()), "max": float(finite.max()), "frames_outside": int(outside.sum())}
    if bounds is None and not normalised:
        message = f"{actions.shape[1]} dimensions, {seen}; say the range allowed to have it checked (--action_range)"
        yield Verdict("action range", "info", message, ACTION, figures={**figures, "frames_outside": None})
    elif outside.any():
        episodes = [e.index for e in source.episodes if outside[e.rows].any()]
        level: Level = "error" if bounds is not None else "warning"
        message = f"{int(outside.sum())} frames outside [{low:g}, {high:g}] ({name_episodes(episodes)}): {seen}"
        yield Verdict("action range", level, message, ACTION, episodes, figures)
    else:
        yield Verdict("action range", "ok", f"{seen}, inside [{low:g}, {high:g}]", ACTION, figures=figures)
    constant = np.flatnonzero(np.ptp(finite, axis=0) == 0)
    if len(constant) and len(source) > 1:
        message = f"dimension{'s' if len(constant) > 1 else ''} {', '.join(map(str, constant))} never changes"
        yield Verdict("actions used", "warning", message, ACTION, figures={"constant": constant.tolist()})
    else:
        yield Verdict("actions used", "ok", f"all {actions.shape[1]} dimensions change", ACTION)


def check_interventions(source: DatasetSource) -> Iterator[Verdict]:
    """How much of the dataset the expert acted in."""
    if INTERVENTION in source.unreadable:
        return
    if INTERVENTION not in source.numbers:
        yield Verdict("interventions", "info", f"no '{INTERVENTION}' column")
        return
    tagged = source.values(INTERVENTION).astype(bool)
    spans = sum(len(runs([tagged[episode.rows]])) for episode in source.episodes)
    share = float(tagged.mean())
    without = [episode.index for episode in source.episodes if not tagged[episode.rows].any()]
    figures = {"share": share, "spans": spans, "episodes_without": len(without)}
    if share == 1:
        message = "the expert was in control throughout: demonstrations"
    elif share == 0:
        message = "the expert never acted: rollouts"
    else:
        message = f"the expert acted in {share:.1%} of the frames, in {spans} spans"
        message += f"; not at all in {name_episodes(without)}" if without else "; in every episode"
    yield Verdict("interventions", "ok", message, INTERVENTION, without if 0 < share < 1 else (), figures)


def check_success(source: DatasetSource) -> Iterator[Verdict]:
    """How many episodes reached the task's goal."""
    if SUCCESS in source.unreadable:
        return
    if SUCCESS not in source.numbers:
        yield Verdict("success", "info", f"no '{SUCCESS}' column")
        return
    failed = [episode.index for episode in source.episodes if source.succeeded(episode) == -1]
    n_episodes = len(source.episodes)
    n_succeeded = n_episodes - len(failed)
    message = f"{n_succeeded} of {n_episodes} episodes succeeded"
    figures = {"succeeded": n_succeeded, "episodes": n_episodes}
    yield Verdict("success", "ok" if n_succeeded else "warning", message, SUCCESS, failed, figures)
