"""What a dataset may refer to, and how much it may claim: it may be a stranger's.

Pictures lie in the dataset, or in files of its folder; so do the files that the templates in `meta/info.json` name. A
feature claims no more values a row than the data files hold. Whoever opens, copies or uploads a dataset checks it here.
"""

import io
import itertools
import json
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePath, PureWindowsPath
from typing import Any

import pyarrow.parquet as pq
from PIL import Image

from lerobot_playbyear.datasets.files import DEFAULT_DATA_PATH, DEFAULT_VIDEO_PATH, INFO_PATH, entries_below, fits

PICTURE_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF")
"""Of the pictures that are read; others have readers that start programs."""

_TEMPLATE = re.compile(r"(?:[^{}]|\{(?:video_key|(?:chunk|file)_index(?::0?\d?d)?)\})*")
_FOLDERS = ("data", "data/*", "meta", "meta/episodes", "meta/episodes/*", "videos", "videos/*", "videos/*/*")
_MOST_FPS = 1000
_TOLERANCE = 4  # times as much as is there; less than that is damage, which the checks and the repair name


class OutsideError(ValueError):
    """A dataset refers to something outside its folder."""


class ClaimError(ValueError):
    """A dataset claims to hold what its files do not."""


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
            raise OutsideError(
                f"'{path}' is a link to a folder, whose files would be left out. Put the folder itself there."
            )


def check_links_out(root: Path) -> None:
    """As `check_links` for a page, which reads through links: those to folders within the dataset's are allowed."""
    for path in entries_below(root):
        if path.is_symlink() and not _is_at_home(path, root):
            raise OutsideError(
                f"'{path}' is a link to '{_real(path)}', outside the dataset's folder. Put the file itself there if it "
                "belongs to the dataset, or remove the link."
            )


def check_info(root: Path, footers: Iterable[pq.FileMetaData], n_episodes: int) -> None:
    """Refuses a dataset whose `meta/info.json` names files outside its folder, or claims far more than its files hold.

    What is damaged otherwise is not looked for.

    Args:
        root: The dataset's folder.
        footers: Of its data files.
        n_episodes: The rows of its `meta/episodes`.

    Raises:
        OutsideError: A template, or a feature's name that it is filled with, leads out of the folder.
        ClaimError: A shape, a rate or a number of episodes is out of all proportion.
    """
    try:
        info = json.loads((root / INFO_PATH).read_text())
    except (OSError, ValueError):
        return  # for the repair
    features = info.get("features") if isinstance(info, dict) else None
    if not isinstance(features, dict) or not all(isinstance(feature, dict) for feature in features.values()):
        return
    check_templates(root, info)
    fps = info.get("fps")
    if isinstance(fps, int | float) and fps > _MOST_FPS:
        raise ClaimError(f"{root / INFO_PATH}: fps is {fps:,}; wanted at most {_MOST_FPS:,}. Correct it.")
    held = _values_held(footers, list(features))
    for key, feature in features.items():
        shape = feature.get("shape")
        if key not in held or not isinstance(shape, list) or not all(isinstance(size, int) for size in shape):
            continue
        claimed = math.prod(shape)
        if claimed > _TOLERANCE * held[key]:
            raise ClaimError(
                f"{root / INFO_PATH}: '{key}' has shape {shape}, {claimed:,} values a row, but the data files "
                f"hold {held[key]:,.4g} a row. Correct the shape."
            )
    total = info.get("total_episodes")
    if isinstance(total, int) and total > _TOLERANCE * max(n_episodes, 1):
        raise ClaimError(
            f"{root / INFO_PATH}: total_episodes is {total:,}, but meta/episodes has {n_episodes:,}. "
            f"Repair it: playbyear-repair --root={root}"
        )


def check_templates(root: Path, info: Mapping[str, Any]) -> None:
    """Refuses templates of file names that lead out of a dataset, as LeRobot fills them in.

    Args:
        root: The dataset's folder.
        info: What `meta/info.json` holds, with its features.

    Raises:
        OutsideError: Naming the template.
    """
    keys = [key for key, feature in info["features"].items() if feature.get("dtype") == "video"]
    for name, default in (("data_path", DEFAULT_DATA_PATH), ("video_path", DEFAULT_VIDEO_PATH)):
        template = info.get(name)
        if not isinstance(template, str):
            continue
        if not is_template(template):
            raise OutsideError(f"{root / INFO_PATH}: {name} is {template!r}; wanted something like {default!r}.")
        for key in keys or [""]:
            file_inside(root, template.format(video_key=key, chunk_index=0, file_index=0))


def is_template(text: str) -> bool:
    """Whether a text is a template of a file's name that can be filled in, with nothing but what LeRobot fills in."""
    return _TEMPLATE.fullmatch(text) is not None


def file_inside(root: Path, name: str | PurePath) -> Path:
    """A file that a dataset names.

    Raises:
        OutsideError: The name leads out of the folder.
    """
    windows = PureWindowsPath(name)
    if windows.anchor or PurePath(name).is_absolute() or ".." in (*windows.parts, *PurePath(name).parts):
        raise OutsideError(f"The dataset in '{root}' names the file '{name}', which is not in its folder.")
    return root / name


def has_shape(height: int, width: int, shape: Sequence[int]) -> bool:
    """Whether a picture has the size that a feature's shape says, (C, H, W) or (H, W, C)."""
    return (height, width) in itertools.pairwise(shape)


def open_picture(row: Mapping[str, Any] | None, root: Path, key: str, feature: Mapping[str, Any]) -> Image.Image:
    """Opens one picture of an image column; it is not decoded yet.

    Args:
        row: `bytes`, an image file, or None; and then `path`, its name in the dataset's folder. None where it is missing.
        root: The dataset's folder.
        key: The camera, for the message.
        feature: Its feature.

    Raises:
        OutsideError: `path` leads out of the folder.
        ValueError: The picture is missing, or has another size than the feature says.
        OSError: It is no picture.
    """
    if row is None:
        raise ValueError(f"'{key}': a picture is missing. Repair the dataset: playbyear-repair --root={root}")
    data, name = row["bytes"], row["path"]
    if data is None:
        if name is None or not _real(root / name).is_relative_to(root.resolve()):
            raise OutsideError(
                f"'{key}': a picture is not in the dataset but in the file {name!r}, outside its folder '{root}', and is "
                "not read. Record it again, or ask who made the dataset for one with its pictures."
            )
        source: Any = root / name
    else:
        source = io.BytesIO(data)
    image = Image.open(source, formats=PICTURE_FORMATS)
    if not has_shape(image.height, image.width, feature["shape"]):
        size = f"{image.width} x {image.height}"
        image.close()
        raise ValueError(
            f"'{key}': a picture of {size} pixels; meta/info.json gives the shape {tuple(feature['shape'])}"
        )
    return image


def _is_at_home(path: Path, root: Path) -> bool:
    home = root.resolve()
    if home.parent.name == "snapshots" and home.parent.parent.name.startswith("datasets--"):
        home = home.parent.parent  # the Hub's cache of this dataset: its files lie in blobs/
    return _real(path).is_relative_to(home)


def _real(path: Path) -> Path:
    """Where a path leads; `Path.resolve` raises where a link leads to itself."""
    return Path(os.path.realpath(path))


def _values_held(footers: Iterable[pq.FileMetaData], keys: list[str]) -> dict[str, float]:
    """How many values of each feature of numbers a row has on average; those of pictures and text are left out."""
    n_values: dict[str, int] = {}
    n_rows = 0
    for footer in footers:
        n_rows += footer.num_rows
        for group in (footer.row_group(index) for index in range(footer.num_row_groups)):
            for column in (group.column(index) for index in range(group.num_columns)):
                key = max(
                    (key for key in keys if f"{column.path_in_schema}.".startswith(f"{key}.")), key=len, default=None
                )
                if key is not None and column.physical_type != "BYTE_ARRAY":
                    n_values[key] = n_values.get(key, 0) + column.num_values
    return {key: count / n_rows for key, count in n_values.items()} if n_rows else {}
