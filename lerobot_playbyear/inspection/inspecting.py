"""`playbyear-inspect`: all checks over a dataset, and the page. LeRobot is imported when its files have been looked at."""

import sys
from collections import deque
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lerobot_playbyear.datasets.info import OutsideError, check_links_out
from lerobot_playbyear.inspection.source import DatasetSource, InspectionError
from lerobot_playbyear.inspection.verdict import Verdict


@dataclass
class InspectDatasetConfig:
    """The dataset.

    Args:
        repo_id: Its name, `user/name`.
        root: Its folder. None: LeRobot's cache, or else the Hub.
        episodes: Only these. None: all.
        video_backend: LeRobot's video decoder, "pyav" or "torchcodec".
    """

    repo_id: str
    root: str | None = None
    episodes: list[int] | None = None
    video_backend: str = "pyav"


@dataclass
class InspectConfig:
    """Options of `playbyear-inspect`.

    Args:
        dataset: What to look at.
        json: Print the verdicts as JSON, and nothing else.
        html: Also write a page to this file.
        action_range: Lowest and highest action allowed, `[-1, 1]`; beyond it is an error. None: it is a warning where
            the actions look normalised to [-1, 1].
        picture_height: Of the page's films [pixels], at most; less makes a smaller file.
    """

    dataset: InspectDatasetConfig
    json: bool = False
    html: Path | None = None
    action_range: list[float] | None = None
    picture_height: int = 240


def inspect(cfg: InspectConfig) -> list[Verdict]:
    """Checks a dataset, prints the verdicts, and writes the page where one is asked for.

    Args:
        cfg: The options.

    Returns:
        All verdicts.

    Raises:
        InspectionError: There is no dataset, or an option is out of range, or the page cannot be written, or would hold
            what is not in the dataset's folder.
    """
    _check_options(cfg)
    options = cfg.dataset
    source = DatasetSource.open(options.repo_id, options.root, options.episodes, options.video_backend)
    if cfg.html is not None:
        _check_links(Path(source.dataset.root))
    from lerobot_playbyear.inspection.checking import check_numbers
    from lerobot_playbyear.inspection.report import as_json, as_text

    verdicts = check_numbers(source, cfg.action_range)
    try:
        verdicts = _watch_pictures(cfg, source, verdicts)
    except OSError as error:
        raise InspectionError(f"The page cannot be written to '{cfg.html}': {error}") from error
    if cfg.json:
        print(as_json(source, verdicts))
        return verdicts
    print(as_text(source, verdicts, colour=sys.stdout.isatty()))
    if cfg.html is not None:
        print(f"Page: {cfg.html} ({cfg.html.stat().st_size / 1e6:.1f} MB). Open it in a browser.")
    return verdicts


def _watch_pictures(cfg: InspectConfig, source: DatasetSource, verdicts: list[Verdict]) -> list[Verdict]:
    """Reads every picture once, for the checks and for the page."""
    from lerobot_playbyear.inspection.page_writer import PageWriter
    from lerobot_playbyear.inspection.picture_checks import PictureChecks

    checks = PictureChecks(source)
    with PageWriter(cfg.html, source, cfg.picture_height) if cfg.html is not None else nullcontext() as page:
        for episode in tqdm(source.episodes, desc="Looking", unit="episode", disable=None):
            pictures: dict[str, Iterator[np.ndarray]] = {
                camera: checks.watch(episode, camera, source.pictures(episode, camera)) for camera in source.cameras
            }
            if page is not None:
                page.add(episode, pictures)
            for stream in pictures.values():
                deque(stream, maxlen=0)
        verdicts = [*verdicts, *checks.verdicts()]
        if page is not None:
            page.finish(verdicts)
    return verdicts


def _check_links(root: Path) -> None:
    """A page is sent to others: it holds no film, sound or number that a stranger's link leads to."""
    try:
        check_links_out(root)
    except OutsideError as error:
        raise InspectionError(
            f"No page is written, since it would hold what a link leads to: {error} Of a dataset that lies on another disk, "
            "let the whole folder lie there, and name it with --dataset.root. Without --html it is checked as it is."
        ) from error
    except OSError as error:
        raise InspectionError(f"The dataset in '{root}' cannot be read: {error}") from error


def _check_options(cfg: InspectConfig) -> None:
    bounds = cfg.action_range
    if bounds is not None and not (len(bounds) == 2 and bounds[0] < bounds[1]):
        raise InspectionError(f"action_range={bounds}: give the lowest and the highest action, like [-1, 1].")
    if cfg.picture_height < 16:
        raise InspectionError(f"picture_height={cfg.picture_height}: give at least 16 pixels.")
