"""Checks of what each camera recorded: pictures that repeat while the arm moves, blank ones, damaged ones."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from PIL import Image

from lerobot_playbyear.datasets.findings import Finding, Level, name_episodes
from lerobot_playbyear.datasets.reader import EpisodeRows, SurveyedDataset
from lerobot_playbyear.inspection.motion import check_delay, difference

_BLANK_SPREAD = 2.0  # grey levels, standard deviation within a picture
_LEVELS = np.arange(256.0)
_FREEZE_S = 1.0  # a camera that stands still for so long while the arm moves is an error
_MOVING_SHARE = 0.25  # of a still span; by definition the arm "moves" in half of all frames
# Of the pictures taken while the arm moves. A video codec drops small changes: LeRobot's own settings (AV1, crf 30,
# every second picture predicted) make every tenth picture of a slow 84-pixel scene equal to the one before.
_TOLERATED_SHARE = {"image": 0.01, "video": 0.25}


@dataclass
class _Watched:
    """What one camera recorded in one episode."""

    episode: int
    n_pictures: int = 0
    n_blank: int = 0
    n_moving: int = 0  # taken while the arm moved
    n_repeated: int = 0  # of those
    longest_freeze: int = 0
    problem: str = ""
    motion: list[float] = field(default_factory=list)  # of each picture, against the one before


class PictureChecks:
    """Looks at every picture as it passes by, and judges when all have passed.

    Args:
        dataset: The dataset.
    """

    def __init__(self, dataset: SurveyedDataset) -> None:
        self._dataset = dataset
        self._watched: dict[str, list[_Watched]] = {key: [] for key in dataset.cameras}
        self._moves = _moving_frames(dataset)

    def watch(self, episode: EpisodeRows, camera: str, pictures: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
        """Passes an episode's pictures (H, W, 3) on; one that cannot be read ends them, and is noted."""
        found, moves = _Watched(episode.index), self._moves[episode.rows]
        self._watched[camera].append(found)
        before: np.ndarray | None = None
        still = still_moving = 0
        try:
            for picture in pictures:
                found.n_blank += _spread(picture) < _BLANK_SPREAD
                repeated = before is not None and np.array_equal(picture, before)
                found.motion.append(0.0 if before is None else difference(picture, before))
                moving = bool(moves[found.n_pictures])
                found.n_moving += moving
                found.n_repeated += repeated and moving
                still, still_moving = (still + 1, still_moving + moving) if repeated else (0, 0)
                if still_moving >= _MOVING_SHARE * still:
                    found.longest_freeze = max(found.longest_freeze, still)
                before = picture
                found.n_pictures += 1
                yield picture
        except Exception as error:
            found.problem = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"

    def findings(self) -> Iterator[Finding]:
        """One line per check and camera."""
        if not self._watched:
            yield Finding("pictures", "info", "no camera")
        for key, watched in self._watched.items():
            n_pictures = sum(each.n_pictures for each in watched)
            wrong = [each.episode for each in watched if each.problem]
            if wrong:
                reason = next(each.problem for each in watched if each.problem)
                message = f"{name_episodes(wrong)}: pictures cannot be read ({reason})"
                yield Finding("pictures", "error", message, key, wrong)
            else:
                yield Finding("pictures", "ok", f"{n_pictures:,} read", key, figures={"pictures": n_pictures})
            if n_pictures:
                yield self._judge_repeats(key, watched)
                yield _judge_blank(key, watched)
        motion = {key: [each.motion for each in watched] for key, watched in self._watched.items()}
        yield from check_delay(self._dataset, motion)

    def _judge_repeats(self, key: str, watched: list[_Watched]) -> Finding:
        n_repeated = sum(each.n_repeated for each in watched)
        share = n_repeated / max(sum(each.n_moving for each in watched), 1)
        freeze_s = max(each.longest_freeze for each in watched) / self._dataset.fps
        figures = {"repeated_while_moving": n_repeated, "share": share, "longest_freeze_s": freeze_s}
        if not n_repeated:
            return Finding("frames that repeat", "ok", "none while the arm moves", key, figures=figures)
        tolerated = _TOLERATED_SHARE[self._dataset.features[key]["dtype"]]
        level: Level = "error" if freeze_s >= _FREEZE_S else "warning" if share > tolerated else "ok"
        repeating = [each.episode for each in watched if each.n_repeated]
        message = (
            f"{n_repeated} pictures equal the one before while the arm moves ({share:.1%} of those), for up to "
            f"{freeze_s:.3g} s; {name_episodes(repeating)}"
        )
        return Finding("frames that repeat", level, message, key, repeating, figures)


def _judge_blank(key: str, watched: list[_Watched]) -> Finding:
    blank = [each.episode for each in watched if each.n_blank]
    if blank:
        return Finding("blank pictures", "warning", f"{name_episodes(blank)}: pictures of one colour", key, blank)
    return Finding("blank pictures", "ok", "none", key)


def _spread(picture: np.ndarray) -> float:
    """Standard deviation of all values of a picture (H, W, 3) uint8, from how often each occurs: no copies as floats."""
    counts = np.array(Image.fromarray(picture).histogram()).reshape(-1, 256).sum(axis=0)
    mean = counts @ _LEVELS / picture.size
    return float(np.sqrt(counts @ np.square(_LEVELS - mean) / picture.size))


def _moving_frames(dataset: SurveyedDataset) -> np.ndarray:
    """Frames before which the arm moved more than it does before half of all frames, (N,) bool.

    Without a state the action tells; without either, all frames.
    """
    key = next((key for key in ("observation.state", "action") if key in dataset.numbers), None)
    if key is None:
        return np.ones(len(dataset), bool)
    values = np.nan_to_num(dataset.values(key).reshape(len(dataset), -1).astype(np.float64))  # (N, D)
    change = np.abs(np.diff(values, axis=0, prepend=values[:1])) / (values.std(axis=0) + 1e-12)
    size = change.max(axis=1)  # (N,)
    moving = size > np.median(size)
    for episode in dataset.episodes:
        moving[episode.start] = False
    return moving
