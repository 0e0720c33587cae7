"""Pictures of sound in a dataset: as images in its data files, or as video beside them."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.utils import DEFAULT_VIDEO_PATH
from lerobot.datasets.video_utils import encode_video_frames, get_video_info
from PIL import Image
from tqdm import tqdm

from lerobot_playbyear.audio.attached_copy import DatasetChange
from lerobot_playbyear.audio.attached_pictures import EpisodePictures
from lerobot_playbyear.datasets.files import scratch_folder
from lerobot_playbyear.datasets.info import read_info
from lerobot_playbyear.datasets.statistics import Stats

_COMPRESS_LEVEL = 3  # of 9: for noise both smaller and faster than the usual 6


class ImageColumn:
    """One microphone's pictures as a column of images, without loss.

    Args:
        pictures: The pictures.
    """

    def __init__(self, pictures: EpisodePictures) -> None:
        self._pictures = pictures
        self.keys = [pictures.how.feature]
        self.rows_at_once = pictures.rows_at_once

    def columns(self, runs: Sequence[tuple[int, int, int]], schema: pa.Schema) -> list[pa.Array]:
        """The pictures of some frames: of an episode, from one frame to before another. Raises as `pictures` of them."""
        values = [{"bytes": _png(one), "path": None} for run in runs for one in self._pictures.pictures(*run)]
        return [pa.array(values, schema.field(self.keys[0]).type)]


def images_change(pictures: Sequence[EpisodePictures]) -> DatasetChange:
    """What a dataset gets whose pictures are stored as images."""
    added = {own.how.feature: _feature(own, "image", {}) for own in pictures}
    return DatasetChange(added, _stats(pictures), [ImageColumn(own) for own in pictures])


def make_encoder(vcodec: str | None, crf: int | None) -> RGBEncoderConfig:
    """LeRobot's encoder of pictures, with another codec or quality where they are given.

    Raises:
        ValueError: LeRobot does not know the codec, or it is not there.
    """
    given = {name: value for name, value in (("vcodec", vcodec), ("crf", crf)) if value is not None}
    return RGBEncoderConfig(**given)


def video_change(
    pictures: Sequence[EpisodePictures], source: Path, target: Path, encoder: RGBEncoderConfig
) -> DatasetChange:
    """What a dataset gets whose pictures are stored as video: one file per episode, encoded here by LeRobot.

    Args:
        pictures: The pictures.
        source: The dataset that it is made from.
        target: The new dataset's folder.
        encoder: Codec and quality.

    Raises:
        OSError: A file cannot be written.
    """
    info = read_info(source)
    template = info.get("video_path") or DEFAULT_VIDEO_PATH
    chunk_size = int(info["chunks_size"])
    added: dict[str, dict[str, Any]] = {}
    rows: dict[str, list] = {}
    for own in pictures:
        key, fps = own.how.feature, own.how.fps
        paths = []
        for episode, n_frames in enumerate(tqdm(own.n_frames, f"Encoding {key}", unit="episode")):
            chunk, file = divmod(episode, chunk_size)
            paths.append(target / template.format(video_key=key, chunk_index=chunk, file_index=file))
            _encode(own, episode, paths[-1], encoder)
            place = {"chunk_index": chunk, "file_index": file, "from_timestamp": 0.0, "to_timestamp": n_frames / fps}
            for name, value in place.items():
                rows.setdefault(f"videos/{key}/{name}", []).append(value)
        added[key] = _feature(own, "video", get_video_info(paths[0], video_encoder=encoder))
    return DatasetChange(added, _stats(pictures), episode_columns=rows, info={"video_path": template})


def _feature(pictures: EpisodePictures, dtype: str, info: dict[str, Any]) -> dict[str, Any]:
    how = pictures.how
    shape, names = (how.height, how.width, 3), ["height", "width", "channels"]
    return {"dtype": dtype, "shape": shape, "names": names, "info": {**info, **how.as_info()}}


def _stats(pictures: Sequence[EpisodePictures]) -> list[Stats]:
    episodes = range(len(pictures[0].n_frames))
    return [{key: own for one in pictures for key, own in one.stats(episode).items()} for episode in episodes]


def _png(picture: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", compress_level=_COMPRESS_LEVEL)
    return file.getvalue()


def _encode(pictures: EpisodePictures, episode: int, path: Path, encoder: RGBEncoderConfig) -> None:
    """Writes an episode's pictures as one video."""
    with scratch_folder() as folder:
        for number, picture in enumerate(pictures.pictures(episode, 0, pictures.n_frames[episode])):
            Image.fromarray(picture).save(Path(folder) / f"frame-{number:06d}.png", compress_level=1)
        encode_video_frames(folder, path, pictures.how.fps, encoder)
