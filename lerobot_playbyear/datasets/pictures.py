"""Pictures in columns and in films: opened, walked through, shrunk, and encoded."""

import contextlib
import io
import itertools
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, BinaryIO

import av
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from PIL import Image

from lerobot_playbyear.datasets.features import Features, is_depth
from lerobot_playbyear.datasets.files import INFO_PATH
from lerobot_playbyear.datasets.info import OutsideError, list_folder, ordinary, real_path
from lerobot_playbyear.datasets.parquet import DataFile
from lerobot_playbyear.datasets.remedies import repair_command, without_feature

PICTURE_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF")
"""Of the pictures that are read; others have readers that start programs."""

_FILMS = {"format_whitelist": "mov,matroska"}  # what a film holds decides; a playlist would have other files opened


@contextlib.contextmanager
def open_film(file: str | BinaryIO) -> Iterator[av.container.InputContainer]:
    """Opens a film of a dataset, MP4 or Matroska, whose pictures can be decoded.

    Raises:
        av.FFmpegError: It is none, or of a codec that nobody knows, with which PyAV 15.1 ends in a segmentation fault.
    """
    with av.open(file, "r", options=_FILMS, metadata_errors="ignore") as container:
        if not container.streams.video or getattr(container.streams.video[0], "codec_context", None) is None:
            raise av.InvalidDataError(0, "it has no pictures that can be decoded", str(getattr(file, "name", file)))
        yield container


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
        OutsideError: `path` leads out of the folder, or to a pipe.
        ValueError: The picture is missing, has another size than the feature says, or more than 8 bits a value.
        OSError: It is no picture.
    """
    if row is None:
        raise ValueError(f"'{key}': a picture is missing. Repair the dataset: {repair_command(root)}")
    data, name = row["bytes"], row["path"]
    if data is None and (name is None or not real_path(root / name).is_relative_to(root.resolve())):
        raise OutsideError(
            f"'{key}': a picture is not in the dataset but in the file {name!r}, outside its folder '{root}', and is "
            "not read. Record it again, or ask who made the dataset for one with its pictures."
        )
    image = Image.open(ordinary(root / str(name)) if data is None else io.BytesIO(data), formats=PICTURE_FORMATS)
    if image.mode.startswith(("I", "F")) and not is_depth(feature):
        mode = image.mode
        image.close()
        raise ValueError(
            f"'{key}': a picture of mode {mode}, with more than 8 bits a value, as depth cameras give it, would be seen as "
            f"white; wanted 8 bits. Leave the camera out: {without_feature(root, key)}"
        )
    if not has_shape(image.height, image.width, feature["shape"]):
        size = f"{image.width} x {image.height}"
        image.close()
        raise ValueError(f"'{key}': a picture of {size} pixels; {INFO_PATH} gives the shape {tuple(feature['shape'])}")
    return image


def named_pictures(root: Path, files: Iterable[DataFile], features: Features) -> set[str]:
    """The files below `images` that rows name in place of pictures; the others there are of episodes that were not saved.

    Args:
        root: The dataset's folder.
        files: Its data files; what is damaged in them names nothing.
        features: Its features.

    Raises:
        OSError: They cannot be read now.
    """
    if not list_folder(root / "images"):  # as nearly always
        return set()
    keys = [key for key, feature in features.items() if feature["dtype"] == "image"]
    tables = (table for file in files for key in keys for _, table in file.row_groups([f"{key}.path"]))
    columns = (pc.struct_field(table.column(0), "path") for table in tables if isinstance(table, pa.Table))
    return {os.path.normpath(name) for column in columns for name in pc.unique(column).to_pylist() if name}


def is_unsaved(name: PurePath, named: Collection[str]) -> bool:
    """Whether a file of a dataset is what an episode was written through, or left behind: it lies below `images`.

    Args:
        name: Its name in the dataset's folder.
        named: From `named_pictures`.
    """
    return name.parts[0] == "images" and (str(name) not in named or name.parts[1].startswith("."))


def encode_picture(picture: Image.Image, is_depth: bool, compress_level: int) -> bytes:
    """The file that LeRobot makes of a picture: PNG, or TIFF for distances."""
    file = io.BytesIO()
    how = {"format": "TIFF", "compression": "raw"} if is_depth else {"format": "PNG", "compress_level": compress_level}
    picture.save(file, **how)
    return file.getvalue()


def decode_picture(data: bytes) -> np.ndarray:
    """The pixels of such a file, (H, W, C): of colours uint8, of distances as they were."""
    with Image.open(io.BytesIO(data), formats=PICTURE_FORMATS) as picture:
        pixels = np.asarray(picture if picture.format == "TIFF" else picture.convert("RGB"))
    return pixels[..., None] if pixels.ndim == 2 else pixels


def video_pictures(
    path: Path, times: Sequence[float], tolerance_s: float, key: str = "", shape: Sequence[int] | None = None
) -> Iterator[np.ndarray]:
    """Decodes the pictures that are shown at these times, one after the other, with two of them in memory.

    They are those that LeRobot's `decode_video_frames` gives with PyAV, which holds all of them.

    Args:
        path: The video.
        times: When [s], in order.
        tolerance_s: How far a picture's time may be from the one wanted [s], in addition to the rounding of LeRobot's
            timestamps to 32 bits.
        key: The camera, for the message.
        shape: Its feature's; None: pictures of any size are decoded.

    Returns:
        For each time a picture, (H, W, 3) uint8.

    Raises:
        ValueError: There is no picture at one of these times; or the pictures have another size than the feature says, and
            none of that size is taken out of the video.
    """
    if not times:
        return
    with open_film(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.time_base is not None
        _check_size(path, key, shape, stream.height, stream.width)
        container.seek(round(times[0] / stream.time_base) - 1, backward=True, any_frame=False, stream=stream)
        frames = ((frame.time, frame) for frame in container.decode(stream) if frame.time is not None)
        before = after = next(frames, None)
        for time in times:
            while after is not None and after[0] < time:
                before, after = after, next(frames, None)
            near = [timed for timed in (before, after) if timed is not None]
            if not near:
                raise ValueError(f"{path} has no picture that can be decoded at {time:.4f} s or after it.")
            shown, frame = min(near, key=lambda timed: abs(timed[0] - time))
            if abs(shown - time) >= tolerance_s + float(np.spacing(np.float32(time))):
                raise ValueError(
                    f"{path} has no picture at {time:.4f} s (tolerance {tolerance_s:g} s); the nearest one is at "
                    f"{shown:.4f} s."
                )
            _check_size(path, key, shape, frame.height, frame.width)  # which may change on the way
            yield frame.to_ndarray(format="rgb24")


def _check_size(path: Path, key: str, shape: Sequence[int] | None, height: int, width: int) -> None:
    if shape is not None and not has_shape(height, width, shape):
        raise ValueError(
            f"'{key}': the pictures of '{path}' have {width} x {height} pixels; meta/info.json gives the shape "
            f"{tuple(shape)}. Correct the shape, or record the dataset again."
        )


def shrunk_size(height: int, width: int, image_size: int) -> tuple[int, int]:
    """The height and width at which pictures are kept: at most `image_size` each [pixels]."""
    return min(height, image_size), min(width, image_size)


def kept_shape(shape: Sequence[int], image_size: int | None) -> tuple[int, int, int]:
    """The channels, height and width of a camera's pictures where they are kept.

    Args:
        shape: Of the feature, (C, H, W) or (H, W, C).
        image_size: Largest height and width kept [pixels]; None: as they are recorded.
    """
    channels, height, width = shape if shape[0] in (1, 3) else (shape[2], *shape[:2])
    if image_size is not None:
        height, width = shrunk_size(height, width, image_size)
    return channels, height, width


def shrink(pictures: np.ndarray, image_size: int) -> np.ndarray:
    """Shrinks pictures as the policy `playbyear` does: every pixel is the weighted mean of those that it covers.

    Args:
        pictures: (n, C, H, W) uint8.
        image_size: Largest height and width wanted [pixels].

    Returns:
        (n, C, h, w) uint8, `pictures` themselves where they are no larger. They differ from what the policy makes of the
        recorded ones by rounding, one level of 255.
    """
    import torch
    from torch.nn import functional

    height, width = pictures.shape[-2:]
    size = shrunk_size(height, width, image_size)
    if size == (height, width):
        return pictures
    values = torch.from_numpy(np.ascontiguousarray(pictures.transpose(0, 2, 3, 1))).permute(0, 3, 1, 2)
    return functional.interpolate(values, size, mode="bilinear", align_corners=False, antialias=True).numpy()
