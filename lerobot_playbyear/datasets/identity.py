"""What a dataset holds, as digests of its files: the same for a copy of it, another one after any change."""

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_playbyear.datasets.info import file_inside
from lerobot_playbyear.datasets.parquet import column_to_numpy

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

    from lerobot_playbyear.datasets.long_dataset import LongDataset

_KNOWN = "digests.json"
_SETTLED_S = 2.0
"""A file that changed later than this before it was read may change again without another time of change."""


def dataset_identity(
    dataset: "LeRobotDataset | LongDataset", features: Mapping[str, Any], folder: Path
) -> dict[str, Any]:
    """Everything that the values of some features depend on, as JSON takes it.

    Every file is read for its digest, once: its size and its times say whether it was seen before.

    Args:
        dataset: The dataset; its episodes count, in their order.
        features: The features that matter.
        folder: Where the digests are kept for the next time.

    Raises:
        ValueError: A file lies outside the dataset's folder.
        OSError: A file cannot be read.
    """
    root, meta = Path(dataset.root), dataset.meta
    episodes = np.unique(column_to_numpy(dataset.hf_dataset.data.column("episode_index"))).tolist()
    cameras = [key for key, feature in features.items() if feature["dtype"] == "video"]
    names = {str(meta.get_data_file_path(episode)) for episode in episodes}
    names |= {str(meta.get_video_file_path(episode, key)) for episode in episodes for key in cameras}
    if any(feature["dtype"] == "image" for feature in features.values()):
        names |= {path.relative_to(root).as_posix() for path in root.glob("images/**/*") if path.is_file()}
    return {
        "features": json.loads(json.dumps(features, default=str)),
        "fps": meta.fps,
        "tolerance_s": dataset.tolerance_s,
        "episodes": episodes,
        "video_starts": {
            key: [meta.episodes[episode][f"videos/{key}/from_timestamp"] for episode in episodes] for key in cameras
        },
        "files": _digests(root, sorted(names), folder / _KNOWN),
    }


def _digests(root: Path, names: Iterable[str], known: Path) -> dict[str, str]:
    try:
        seen = json.loads(known.read_text())
    except (OSError, ValueError):
        seen = {}
    digests: dict[str, str] = {}
    for name in names:
        path = file_inside(root, name)
        details = path.stat()
        # The time of change (ctime) cannot be set: who writes new content and restores the other times changes it.
        stamp = [details.st_size, details.st_mtime_ns, details.st_ctime_ns, details.st_ino, details.st_dev]
        entry = seen.get(str(path), [])
        if entry[:-1] != stamp:
            began = time.time()
            with path.open("rb") as file:
                entry = [*stamp, hashlib.file_digest(file, "blake2b").hexdigest()]
            if began - details.st_ctime > _SETTLED_S:
                seen[str(path)] = entry
        digests[name] = entry[-1]
    with contextlib.suppress(OSError):  # then they are read again
        known.parent.mkdir(parents=True, exist_ok=True)
        new = known.with_name(f"{known.name}.{os.getpid()}")
        new.write_text(json.dumps(seen))
        new.replace(known)
    return digests
