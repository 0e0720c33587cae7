"""Checks of what each camera recorded: pictures that repeat while the arm moves, blank ones, damaged ones."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from lerobot.utils.constants import ACTION, OBS_STATE
from PIL import Image

from lerobot_playbyear.inspection.source import DatasetSource, Episode
from lerobot_playbyear.inspection.verdict import Level, Verdict, name_episodes

_BLANK_SPREAD = 2.0  # grey levels, standard deviation within a picture
_LEVELS = np.arange(256.0)
_FREEZE_S = 1.0  # a camera that stands still for so long while the arm moves is an error
_MOVING_SHARE = 0.25  # of a still span; by definition the arm "moves" in half of all frames
# Of the pictures taken while the arm moves. A video codec drops small changes: LeRobot's own settings (AV1, crf 30,
# every second picture predicted) make every tenth picture of a slow 84-pixel scene equal to the one before.
_TOLERATED_SHARE = {"image": 0.01, "video": 0.25}


@dataclass
class _Camera:
    n_pictures: int = 0
    n_repeated: int = 0
    n_moving: int = 0
    longest_freeze: int = 0
    repeating: list[int] = field(default_factory=list)
    frozen: list[int] = field(default_factory=list)
    blank: list[int] = field(default_factory=list)
    wrong: list[int] = field(default_factory=list)
    reason: str = ""


class PictureChecks:
    """Looks at every picture as it passes by, and judges when all have passed.

    Args:
        source: The dataset.
    """

    def __init__(self, source: DatasetSource) -> None:
        self._source = source
        self._cameras = {key: _Camera() for key in source.cameras}
        self._moves = _moving_frames(source)

    def watch(self, episode: Episode, camera: str, pictures: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
        """Passes an episode's pictures (H, W, 3) on; one that cannot be read ends them, and is noted."""
        found, moves = self._cameras[camera], self._moves[episode.rows]
        before: np.ndarray | None = None
        n = n_blank = n_repeated = still = still_moving = longest = 0
        try:
            for picture in pictures:
                n_blank += _spread(picture) < _BLANK_SPREAD
                repeated = before is not None and np.array_equal(picture, before)
                n_repeated += repeated and bool(moves[n])
                found.n_moving += bool(moves[n])
                still, still_moving = (still + 1, still_moving + bool(moves[n])) if repeated else (0, 0)
                if still_moving >= _MOVING_SHARE * still:
                    longest = max(longest, still)
                before = picture
                n += 1
                yield picture
        except Exception as error:
            found.reason = found.reason or f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
            found.wrong.append(episode.index)
        found.n_pictures += n
        found.n_repeated += n_repeated
        found.longest_freeze = max(found.longest_freeze, longest)
        if n_repeated:
            found.repeating.append(episode.index)
        if longest >= _FREEZE_S * self._source.fps:
            found.frozen.append(episode.index)
        if n_blank:
            found.blank.append(episode.index)

    def verdicts(self) -> Iterator[Verdict]:
        """One line per check and camera."""
        if not self._cameras:
            yield Verdict("pictures", "info", "no camera")
        for key, found in self._cameras.items():
            yield self._judge_files(key, found)
            if found.n_pictures:
                yield self._judge_repeats(key, found)
                yield self._judge_blank(key, found)

    def _judge_files(self, key: str, found: _Camera) -> Verdict:
        if found.wrong:
            message = f"{name_episodes(found.wrong)}: pictures cannot be read ({found.reason})"
            return Verdict("pictures", "error", message, key, found.wrong)
        return Verdict("pictures", "ok", f"{found.n_pictures:,} read", key, figures={"pictures": found.n_pictures})

    def _judge_repeats(self, key: str, found: _Camera) -> Verdict:
        share = found.n_repeated / max(found.n_moving, 1)
        freeze_s = found.longest_freeze / self._source.fps
        figures = {"repeated_while_moving": found.n_repeated, "share": share, "longest_freeze_s": freeze_s}
        tolerated = _TOLERATED_SHARE[self._source.features[key]["dtype"]]
        level: Level = "error" if found.frozen else "warning" if share > tolerated else "ok"
        if not found.n_repeated:
            return Verdict("frames that repeat", "ok", "none while the arm moves", key, figures=figures)
        message = (
            f"{found.n_repeated} pictures equal the one before while the arm moves ({share:.1%} of those), for up to "
            f"{freeze_s:.3g} s; {name_episodes(found.repeating)}"
        )
        return Verdict("frames that repeat", level, message, key, found.repeating, figures)

    def _judge_blank(self, key: str, found: _Camera) -> Verdict:
        if found.blank:
            message = f"{name_episodes(found.blank)}: pictures of one colour"
            return Verdict("blank pictures", "warning", message, key, found.blank)
        return Verdict("blank pictures", "ok", "none", key)


def _spread(picture: np.ndarray) -> float:
    """Standard deviation of all values of a picture (H, W, 3) uint8, from how often each occurs: no copies as floats."""
    counts = np.array(Image.fromarray(picture).histogram()).reshape(-1, 256).sum(axis=0)
    mean = counts @ _LEVELS / picture.size
    return float(np.sqrt(counts @ np.square(_LEVELS - mean) / picture.size))


def _moving_frames(source: DatasetSource) -> np.ndarray:
    """Frames before which the arm moved more than it does before half of all frames, (N,) bool.

    Without a state the action tells; without either, all frames.
    """
    key = next((key for key in (OBS_STATE, ACTION) if key in source.numbers), None)
    moving = np.ones(len(source), bool)
    if key is None:
        return moving
    values = np.nan_to_num(source.values(key).reshape(len(source), -1).astype(np.float64))
    change = np.abs(np.diff(values, axis=0, prepend=values[:1])) / (values.std(axis=0) + 1e-12)
    size = change.max(axis=1)  # (N,)
    moving = size > np.median(size)
    for episode in source.episodes:
        moving[episode.start] = False
    return moving
