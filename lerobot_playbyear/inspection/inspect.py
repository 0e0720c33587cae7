"""`playbyear-inspect`: all checks over a dataset, told to a person or a program, and the page."""

import json
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lerobot_playbyear.datasets.errors import InputError, printable
from lerobot_playbyear.datasets.findings import Finding, summary, worst
from lerobot_playbyear.datasets.info import OutsideError, check_links_out
from lerobot_playbyear.datasets.reader import DatasetPlace, SurveyedDataset
from lerobot_playbyear.datasets.remedies import repair_command
from lerobot_playbyear.inspection.motion import check_actions, check_interventions, check_success
from lerobot_playbyear.inspection.pictures import PictureChecks
from lerobot_playbyear.inspection.sound import check_sound
from lerobot_playbyear.inspection.structure import check_sample_rates, check_structure, facts, finite

_COLOURS = {"ok": "32", "info": "36", "warning": "33", "error": "31;1"}


@dataclass
class InspectDatasetConfig(DatasetPlace):
    """The dataset.

    Args:
        repo_id: Name of the dataset, `user/name`.
        root: Its folder. None: the one in LeRobot's cache, or else the Hub.
        episodes: Only these episodes, such as `[0, 1, 2]`. None: all.
    """

    episodes: list[int] | None = None


@dataclass
class InspectConfig:
    """Options of `playbyear-inspect`.

    Args:
        dataset: The dataset to check.
        json: Print the findings as JSON and nothing else.
        html: Also write an HTML page to this file.
        action_range: Lowest and highest allowed action, such as `[-1, 1]`. An action beyond it is an error. None: a warning, if
            the actions look normalised to [-1, 1].
        picture_height: Largest height of the page's videos [pixels]. A smaller one makes a smaller file.
    """

    dataset: InspectDatasetConfig
    json: bool = False
    html: Path | None = None
    action_range: list[float] | None = None
    picture_height: int = 240


def inspect(cfg: InspectConfig) -> list[Finding]:
    """Checks a dataset, prints the findings, and writes the page where one is asked for.

    Args:
        cfg: The options.

    Returns:
        All findings.

    Raises:
        InputError: There is no dataset, or an option is out of range, or the page cannot be written, or would hold
            what is not in the dataset's folder.
    """
    _check_options(cfg)
    dataset = SurveyedDataset.open(cfg.dataset.repo_id, cfg.dataset.root, cfg.dataset.episodes, damaged=True)
    if cfg.html is not None:
        _check_links(dataset.root)
    findings = check_numbers(dataset, cfg.action_range)
    try:
        findings = _watch_pictures(cfg, dataset, findings)
    except OSError as error:
        raise InputError(f"The page cannot be written to '{cfg.html}': {error}") from error
    if cfg.json:
        print(as_json(dataset, findings))
        return findings
    print(as_text(dataset, findings, colour=sys.stdout.isatty()))
    if cfg.html is not None:
        print(f"Page: {printable(cfg.html)} ({cfg.html.stat().st_size / 1e6:.1f} MB). Open it in a browser.")
    return findings


def check_numbers(dataset: SurveyedDataset, action_range: Sequence[float] | None = None) -> list[Finding]:
    """All checks that need no picture, in the order in which a person reads them.

    Args:
        dataset: The dataset.
        action_range: Lowest and highest action allowed; None: see `check_actions`.
    """
    return [
        *check_structure(dataset),
        *check_actions(dataset, action_range),
        *check_interventions(dataset),
        *check_success(dataset),
        *check_sample_rates(dataset),
        *(finding for key in dataset.timed_microphones for finding in check_sound(dataset, key)),
    ]


def _watch_pictures(cfg: InspectConfig, dataset: SurveyedDataset, findings: list[Finding]) -> list[Finding]:
    """Reads every picture once, for the checks and for the page."""
    from lerobot_playbyear.inspection.page import PageWriter

    checks = PictureChecks(dataset)
    with PageWriter(cfg.html, dataset, cfg.picture_height) if cfg.html is not None else nullcontext() as page:
        for episode in tqdm(dataset.episodes, desc="Looking", unit="episode", disable=None):
            pictures: dict[str, Iterator[np.ndarray]] = {
                camera: checks.watch(episode, camera, dataset.pictures(camera, episode)) for camera in dataset.cameras
            }
            if page is not None:
                page.add(episode, pictures)
            for stream in pictures.values():
                deque(stream, maxlen=0)
        findings = [*findings, *checks.findings()]
        if page is not None:
            page.finish(findings)
    return findings


def _check_links(root: Path) -> None:
    """A page is sent to others: it holds no film, sound or number that a stranger's link leads to."""
    try:
        check_links_out(root)
    except OutsideError as error:
        raise InputError(
            f"No page is written, because it would show what a link leads to: {error} If the dataset is on another disk, keep "
            "its whole folder there and name it with --dataset.root. Without --html it is checked as it is."
        ) from error
    except OSError as error:
        raise InputError(f"The dataset in '{root}' cannot be read: {error}") from error


def _check_options(cfg: InspectConfig) -> None:
    bounds = cfg.action_range
    if bounds is not None and not (len(bounds) == 2 and bounds[0] < bounds[1]):
        raise InputError(f"action_range={bounds}: give the lowest and the highest action, like [-1, 1].")
    if cfg.picture_height < 16:
        raise InputError(f"picture_height={cfg.picture_height}: give at least 16 pixels.")


# What is told of it


def as_text(dataset: SurveyedDataset, findings: Sequence[Finding], colour: bool = False) -> str:
    """One line per finding, between a head and a summary."""
    known = facts(dataset)
    name_width = max(len(finding.check) for finding in findings)
    lines = [
        _line(f"{known['repo_id']} in {known['root']}"),
        f"{known['episodes']} episodes, {known['frames']:,} frames, {known['seconds']:,.1f} s at {known['fps']} Hz; "
        f"cameras: {_line(_names(dataset.cameras))}; microphones: {_line(_names(dataset.microphones))}",
        "",
    ]
    for finding in findings:
        level = f"\033[{_COLOURS[finding.level]}m{finding.level:<7}\033[0m" if colour else f"{finding.level:<7}"
        feature = f"{finding.feature}: " if finding.feature else ""
        lines.append(f"{level}  {finding.check:<{name_width}}  {_line(feature + str(finding))}")
    lines += ["", summary(findings)]
    if dataset.survey.damage:
        lines.append(f"A repaired copy: {_line(repair_command(dataset.root))}")
    return "\n".join(lines)


def as_json(dataset: SurveyedDataset, findings: Sequence[Finding]) -> str:
    """The same for a program."""
    verdicts = [finding.to_dict() for finding in findings]
    report = {"dataset": facts(dataset), "worst": worst(findings), "verdicts": verdicts}
    return json.dumps(finite(report), indent=2, allow_nan=False)


def _names(keys: Sequence[str]) -> str:
    return ", ".join(key.split(".", 2)[-1] for key in keys) or "none"


def _line(text: object) -> str:
    return printable(text, kept="")
