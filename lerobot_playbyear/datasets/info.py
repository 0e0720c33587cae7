"""What a dataset says about itself in `meta/info.json`, and what it may refer to and claim: it may be a stranger's.

Files that it names lie in its folder. Whoever opens, copies or uploads a dataset reads it through this module. LeRobot, which
takes seconds to import, is not needed for that.
"""

import glob
import os
import re
from collections.abc import Mapping
from pathlib import Path, PurePath, PureWindowsPath
from typing import Any

import numpy as np
from huggingface_hub.constants import HF_HUB_CACHE

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import (
    DEFAULT_DATA_PATH,
    DEFAULT_VIDEO_PATH,
    EPISODES_DIR,
    HF_LEROBOT_HOME,
    INFO_PATH,
    entries_below,
    fits,
    is_listed,
    is_special,
    list_files,
    parse_json,
)
from lerobot_playbyear.datasets.frame_rate import frame_rate
from lerobot_playbyear.datasets.remedies import convert_command, repair_command

Info = Mapping[str, Any]
"""The fields of `meta/info.json`."""

STATS_PATH = "meta/stats.json"
DOWNLOADED = ".cache/huggingface"  # is in the folder of what came from the Hub

INDEX_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""That every dataset of LeRobot's has."""

_PATHS = {"data_path": DEFAULT_DATA_PATH, "video_path": DEFAULT_VIDEO_PATH}
_TEMPLATE = re.compile(r"(?:[^{}]|\{(?:video_key|(?:chunk|file)_index(?::0?\d?d)?)\})*")
_FOLDERS = ("data", "data/*", "meta", "meta/episodes", "meta/episodes/*", "videos", "videos/*", "videos/*/*")
_READ = (INFO_PATH, "meta/*.json", "meta/*.parquet", f"{EPISODES_DIR}/*/*.parquet", "data/*/*.parquet", "videos/*/*/*")
_MOST_NAMED = 4  # files of a folder
_LEAST_FPS, _MOST_FPS = 0.01, 1000


class InfoError(InputError):
    """A dataset's `meta/info.json` says what cannot be right."""


class OutsideError(InfoError):
    """A dataset refers to something outside its folder."""


def read_info(root: Path) -> dict[str, Any]:
    """Reads `meta/info.json`.

    Args:
        root: The dataset's folder.

    Returns:
        All its fields. What LeRobot relies on is there and of the right kind; no template leads out of the folder. A frame
        rate that is whole is an int.

    Raises:
        InfoError: A field is missing or cannot be right, or the dataset is of another version of LeRobot's format.
        OutsideError: A template, or a feature's name that it is filled with, leads out of the folder; or a pipe or a device
            stands in place of a file.
        FileNotFoundError: There is none.
        OSError: It cannot be read now.
    """
    for path in (path for pattern in _READ for path in list_files(root, pattern)):
        ordinary(path)  # a reader would wait for another, or read without end
    path = root / INFO_PATH
    try:
        info = parse_json(path.read_bytes())
        if not isinstance(info, dict):
            raise ValueError("it holds no fields")
        _check_version(root, info.get("codebase_version"))
        _check_fields(info)
    except InfoError:
        raise
    except ValueError as error:
        raise InfoError(
            f"{path} is damaged: {error}. Put it back from a copy, or let it be made again: {repair_command(root)} "
            "--like=<folder of a dataset that was recorded with the same settings>."
        ) from error
    _check_templates(root, info)
    return {**info, "fps": frame_rate(info["fps"])}


def parse_stats(data: bytes) -> dict[str, dict[str, Any]]:
    """What `meta/stats.json` says: of each feature its statistics, numbers or lists of them.

    Raises:
        ValueError: It says something else.
    """
    stats = parse_json(data)
    if not isinstance(stats, dict):
        raise ValueError("it holds no features")
    for key, own in stats.items():
        if not isinstance(own, dict) or not all(map(are_numbers, own.values())):
            raise ValueError(f"the entries of {key} are not numbers")
    return stats


def are_numbers(value: Any) -> bool:
    """Whether a statistic is one: a number, or a list of them."""
    try:
        return np.array(value).dtype.kind in "fiub"
    except ValueError:  # lists of different lengths
        return False


def ordinary(path: Path) -> Path:
    """A path that is to be opened.

    Raises:
        OutsideError: A pipe or a device is there, or a link leads to one.
    """
    if is_special(path):
        raise OutsideError(f"'{path}' leads to '{real_path(path)}', which is not an ordinary file. Remove it.")
    return path


def file_inside(root: Path, name: str | PurePath) -> Path:
    """A file that a dataset names.

    Raises:
        OutsideError: The name leads out of the folder, or to a pipe or a device.
    """
    windows = PureWindowsPath(name)
    if windows.anchor or PurePath(name).is_absolute() or ".." in (*windows.parts, *PurePath(name).parts):
        raise OutsideError(f"The dataset in '{root}' names the file '{name}', which is not in its folder.")
    return ordinary(root / name)


def nothing_in(root: Path) -> str:
    """Says why a folder holds no dataset, and what is there instead; without a full stop."""
    if not root.exists():
        problem = "it does not exist"
    elif not root.is_dir():
        problem = "it is not a folder"
    else:
        names, below = list_folder(root), list_files(root, f"*/{INFO_PATH}")
        held = f"it holds {', '.join(names[:_MOST_NAMED])}{', ...' if len(names) > _MOST_NAMED else ''}"
        if below:
            held = f"there is one in '{below[0].parents[1]}'"
        problem = f"it has no {INFO_PATH}; {held}" if names else "it is empty"
    return f"There is no LeRobotDataset in '{root}': {problem}"


def check_there(root: Path) -> None:
    """Refuses a folder that holds nothing of a dataset.

    Raises:
        InputError: Saying what it holds.
    """
    if not (root.is_dir() and (is_listed(root, INFO_PATH) or list_files(root, "data/*/*.parquet"))):
        raise InputError(f"{nothing_in(root)}. Correct the folder.")


def list_folder(root: Path) -> list[str]:
    """The names in a folder, in order, but hidden ones; none where it is not a folder."""
    return sorted(each.name for each in root.iterdir() if not each.name.startswith(".")) if root.is_dir() else []


def check_parts(root: Path, can_be_repaired: bool = False) -> None:
    """Refuses a dataset of which a whole part is missing: frames, films of a camera, or the table of episodes.

    Args:
        root: The dataset's folder.
        can_be_repaired: Whether a table of episodes that is missing is no reason.

    Raises:
        InputError: Naming what is missing, and what to do.
        Exception: As `read_info`.
    """
    info = read_info(root)
    if not list_files(root, "data/*/*.parquet"):
        raise InputError(
            f"The dataset in '{root}' is empty: no episode was saved, for it has no data/*/*.parquet, and {INFO_PATH} counts "
            f"{info['total_episodes']} episodes. Record at least one, or put them back from a copy."
        )
    if not can_be_repaired and not list_files(root, f"{EPISODES_DIR}/*/*.parquet"):
        raise InputError(
            f"The dataset in '{root}' has no {EPISODES_DIR}/*/*.parquet, which says where its episodes are. It can be made "
            f"from the frames: {repair_command(root)}"
        )
    for key, feature in info["features"].items():
        if feature["dtype"] != "video":
            continue
        pattern = PurePath(info["video_path"].format(video_key=key, chunk_index=0, file_index=0))
        if not list_files(root, f"{glob.escape(str(pattern.parent.parent))}/*/*{pattern.suffix}"):
            films = [path for path in entries_below(root) if path.suffix == pattern.suffix]
            films.sort(key=lambda path: key not in path.parts)
            remedy = "Put them back"
            if films:
                remedy = f"There are films in '{films[0].parent}': if they are these, move them there"
            raise InputError(
                f"The dataset in '{root}' has no films of '{key}', which {INFO_PATH} says to be in '{root / pattern.parent}'. "
                f"{remedy}, or correct video_path."
            )


def check_links(root: Path) -> None:
    """Refuses links that lead out of a dataset's folder: a copy or an upload would hold what they lead to.

    Args:
        root: The dataset's folder, also a snapshot in the Hub's cache, whose files are links to the cache's.

    Raises:
        OutsideError: Naming the link; or one to a folder where the dataset's files lie, which would be left out.
    """
    check_links_out(root)
    for path in entries_below(root):
        name = path.relative_to(root)
        if path.is_symlink() and path.is_dir() and fits(name, *_FOLDERS):
            raise OutsideError(f"'{path}' is a link to a folder, whose files would be left out. Put the folder there.")


def check_links_out(root: Path) -> None:
    """As `check_links` for a page, which reads through links: those to folders within the dataset's are allowed."""
    home = root.resolve()
    if home.parent.name == "snapshots" and home.parent.parent.name.startswith(("datasets--", "models--")):
        home = home.parent.parent  # the Hub's cache of it: its files lie in blobs/
    for path in entries_below(root):
        real = real_path(path)
        if path.is_symlink() and not real.is_relative_to(home):
            raise OutsideError(
                f"'{path}' is a link to '{real}', outside its folder. Put the file itself there, or remove the link."
            )


def real_path(path: Path) -> Path:
    """Where a path leads; `Path.resolve` raises where a link leads to itself."""
    return Path(os.path.realpath(path))


def _check_version(root: Path, version: Any) -> None:
    found = re.fullmatch(r"v(\d+)\..*", version) if isinstance(version, str) else None
    if found is None:
        raise ValueError(f"codebase_version is {version!r}; wanted 'v3.0'")
    if int(found[1]) < 3:
        raise InfoError(
            f"{root} is a dataset of LeRobot's older format {version}; wanted v3.0. Convert it: {convert_command(root)}"
        )
    if int(found[1]) > 3:
        raise InfoError(f"{root} was written by a newer LeRobot (format {version}); wanted v3.0. Update lerobot.")


def _check_fields(info: Info) -> None:
    """Raises a ValueError that names a field, what it is, and what is wanted."""
    for name in ("total_episodes", "total_frames", "chunks_size"):
        if not _is_count(info.get(name)):
            raise ValueError(f"{name} is {info.get(name)!r}; wanted a whole number")
    if info["chunks_size"] == 0:
        raise ValueError("chunks_size is 0; wanted 1 or more, such as 1000")
    fps = info.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not _LEAST_FPS <= fps <= _MOST_FPS:
        raise ValueError(f"fps is {fps!r}; wanted a number from {_LEAST_FPS} to {_MOST_FPS:,}")
    features = info.get("features")
    if not isinstance(features, dict):
        raise ValueError(f"features is {features!r}; wanted a dtype and a shape for each")
    for key in INDEX_COLUMNS:
        own, kind = features.get(key), "float" if key == "timestamp" else "int"
        if not (isinstance(own, dict) and own.get("shape") == [1] and str(own.get("dtype")).startswith(kind)):
            raise ValueError(f"the feature '{key}' is missing, or not one {kind} in each frame")
    for key, feature in features.items():
        if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
            raise ValueError(f"the feature '{key}' has no dtype")
        shape = feature.get("shape")
        if not isinstance(shape, list) or not all(map(_is_count, shape)):
            raise ValueError(f"the feature '{key}' has shape {shape!r}; wanted a list of whole numbers")
        for name in ("info", "video_info"):
            if not isinstance(feature.get(name) or {}, dict):
                raise ValueError(f"the feature '{key}' has {name} {feature[name]!r}; wanted fields such as sample_rate")
    for name, default in _PATHS.items():
        is_needed = name == "data_path" or any(feature["dtype"] == "video" for feature in features.values())
        if is_needed and not isinstance(info.get(name), str):
            raise ValueError(f"{name} is {info.get(name)!r}; wanted {default!r}")


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _check_templates(root: Path, info: Info) -> None:
    keys = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
    for name, default in _PATHS.items():
        template = info.get(name)
        if template is None and not keys:
            continue
        ending = PurePath(default).suffix
        if not isinstance(template, str) or not _TEMPLATE.fullmatch(template) or not template.endswith(ending):
            raise OutsideError(f"{root / INFO_PATH}: {name} is {template!r}; wanted something like {default!r}.")
        for key in keys or [""]:
            file_inside(root, template.format(video_key=key, chunk_index=0, file_index=0))


def came_from_the_hub(root: Path) -> bool:
    """Whether a dataset's folder is one that LeRobot or the Hub's client downloaded, or a copy of one."""
    caches = [Path(HF_HUB_CACHE).resolve(), (HF_LEROBOT_HOME / "hub").resolve()]
    is_in_cache = any(root.resolve().is_relative_to(cache) for cache in caches)
    return is_in_cache or (root / DOWNLOADED).exists()
