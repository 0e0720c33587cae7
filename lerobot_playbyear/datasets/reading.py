"""A whole LeRobotDataset as one tensor per feature, on the device where there is room for it."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.language import LANGUAGE_COLUMNS
from torch import Tensor
from tqdm import tqdm

from lerobot_playbyear.datasets.audio_feature import check_audio_features
from lerobot_playbyear.datasets.columns import episode_bounds
from lerobot_playbyear.datasets.free_memory import available_memory
from lerobot_playbyear.datasets.long_dataset import LongDataset
from lerobot_playbyear.datasets.tensors import read_images, read_values, read_videos

INDEX_KEYS = ("index", "episode_index", "frame_index", "task_index", "timestamp")
"""The columns that every LeRobotDataset has."""

_CAMERA_DTYPES = ("image", "video")
_GPU_SHARE = 0.5  # of the free memory: the network and its gradients need the rest


def read_dataset(
    dataset: LeRobotDataset | LongDataset,
    keys: Iterable[str] | None = None,
    device: str | torch.device | None = None,
    video_backend: str | None = None,
    progress: bool = False,
) -> tuple[dict[str, Tensor], list[int], list[int]]:
    """Read the episodes that a dataset was opened with; arguments and errors as for `EpisodeStore.from_dataset`.

    Returns:
        Each feature as a tensor of N rows, the first frame of each episode, and the frame after its last.
    """
    if len(dataset) == 0:
        raise ValueError(f"The dataset '{dataset.repo_id}' is empty: it has no frames. Record at least one episode.")
    features = _select_features(dataset, keys)
    with_rate = {key: f for key, f in features.items() if "sample_rate" in (f.get("info") or {})}
    check_audio_features(with_rate, dataset.fps)
    device = _choose_device(device, sum(_row_bytes(feature) for feature in features.values()) * len(dataset))

    columns: dict[str, Tensor] = {}
    n_cameras = sum(feature["dtype"] in _CAMERA_DTYPES for feature in features.values())
    bar = tqdm(
        total=n_cameras * len(dataset), desc="Reading frames", unit="frame", disable=not (progress and n_cameras)
    )
    with bar:
        for key, feature in features.items():
            if feature["dtype"] == "video":
                values = read_videos(dataset, key, video_backend, lambda _, n: bar.update(n))
            elif feature["dtype"] == "image":
                values = read_images(dataset, key, lambda _, n: bar.update(n))
            else:
                values = read_values(dataset, key)
            columns[key] = values.to(device)  # one by one, so that a copy never doubles the whole dataset
    starts, ends = _episodes(columns, dataset.repo_id)
    return columns, starts, ends


def _select_features(dataset: LeRobotDataset | LongDataset, keys: Iterable[str] | None) -> dict[str, Any]:
    features = dataset.meta.features
    if keys is None:
        keys = [
            key
            for key, feature in features.items()
            if key not in LANGUAGE_COLUMNS and key not in dataset.meta.depth_keys and feature["dtype"] != "string"
        ]
    keys = list(dict.fromkeys([*keys, *INDEX_KEYS]))
    for key in keys:
        if key not in features:
            raise ValueError(f"The dataset '{dataset.repo_id}' has no '{key}'; it has {sorted(features)}.")
        if key in dataset.meta.depth_keys or features[key]["dtype"] == "string" or key in LANGUAGE_COLUMNS:
            raise ValueError(f"'{key}' ({features[key]['dtype']}) cannot be kept in memory: use lerobot-train for it.")
    return {key: features[key] for key in keys}


def _row_bytes(feature: Mapping[str, Any]) -> int:
    dtype = feature["dtype"]
    itemsize = 1 if dtype in _CAMERA_DTYPES else 4 if dtype.startswith("float") else np.dtype(dtype).itemsize
    return int(np.prod(feature["shape"])) * itemsize


def _choose_device(device: str | torch.device | None, nbytes: int) -> torch.device:
    if device is None:
        fits = torch.cuda.is_available() and nbytes <= _GPU_SHARE * torch.cuda.mem_get_info()[0]
        device = "cuda" if fits else "cpu"
    device = torch.device(device)
    free = available_memory()
    if device.type == "cpu" and nbytes > free:
        raise MemoryError(
            f"The dataset needs {nbytes / 2**30:.1f} GiB in memory, and {free / 2**30:.1f} GiB are free. Choose fewer "
            "episodes (--dataset.episodes), end other programs, or use lerobot-train, which reads from the disk."
        )
    return device


def _episodes(columns: Mapping[str, Tensor], repo_id: str) -> tuple[list[int], list[int]]:
    starts, ends = episode_bounds(columns["episode_index"].cpu().numpy())
    frame_index = columns["frame_index"].cpu()
    for start, end in zip(starts, ends, strict=True):
        if not torch.equal(frame_index[start:end], torch.arange(end - start)):
            raise ValueError(
                f"Episode {int(columns['episode_index'][start])} of '{repo_id}' is incomplete: its {end - start} rows "
                f"are not frames 0 to {end - start - 1}. Remove it with lerobot-edit-dataset, or record it again."
            )
    return starts, ends
