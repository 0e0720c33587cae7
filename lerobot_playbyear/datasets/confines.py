"""Pictures in a dataset's columns, which may be a stranger's: they lie in it, or in files of its folder."""

import io
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from lerobot_playbyear.datasets.info import OutsideError, real_path

PICTURE_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF")
"""Of the pictures that are read; others have readers that start programs."""


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
        if name is None or not real_path(root / name).is_relative_to(root.resolve()):
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
