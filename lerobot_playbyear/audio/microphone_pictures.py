"""Which cameras of a dataset are microphones: those in whose pictures a timecode stands."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from lerobot_playbyear.audio.sample_strip import read_timecode
from lerobot_playbyear.audio.sound_picture import PICTURE_PREFIX
from lerobot_playbyear.datasets.features import AUDIO_PREFIX, MICROPHONE
from lerobot_playbyear.datasets.info import file_inside
from lerobot_playbyear.datasets.parquet import open_checked, row_group_parts
from lerobot_playbyear.datasets.pictures import open_picture, video_pictures

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

_LOOKED_AT = 3  # pictures


def audio_key_of(picture: str) -> str:
    """The sound of a microphone whose pictures are `observation.images.<mic>`."""
    return AUDIO_PREFIX + picture.removeprefix(PICTURE_PREFIX)


def microphone_pictures(meta: "LeRobotDatasetMetadata") -> list[str]:
    """The features of a dataset that are a microphone's pictures; those whose files are not here are not looked at."""
    found = []
    for key, feature in meta.features.items():
        if feature["dtype"] in ("image", "video") and tuple(feature["shape"])[-1] == 3:
            is_noted = MICROPHONE in (feature.get("info") or {})
            if is_noted or any(read_timecode(picture) for picture in _first_pictures(meta, key)):
                found.append(key)
    return found


def _first_pictures(meta: "LeRobotDatasetMetadata", key: str) -> Iterator[np.ndarray]:
    """The first episode's first pictures, (H, W, C) uint8; none where they cannot be read, which others say better."""
    feature, n = meta.features[key], _LOOKED_AT
    try:
        root = Path(meta.root)
        if feature["dtype"] == "video":
            first_s = float(meta.episodes[0][f"videos/{key}/from_timestamp"])
            times = [first_s + i / meta.fps for i in range(min(n, int(meta.episodes[0]["length"])))]
            path = file_inside(root, meta.get_video_file_path(0, key))
            yield from video_pictures(path, times, 1e-4, key, feature["shape"])
            return
        with open_checked(file_inside(root, meta.get_data_file_path(0))) as file:
            rows = next(row_group_parts(file, 0, [key])).slice(0, n).column(key).to_pylist()
        for row in rows:
            with open_picture(row, root, key, feature) as image:
                yield np.asarray(image.convert("RGB"))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, Image.DecompressionBombError):
        return
