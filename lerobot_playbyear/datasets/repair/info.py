"""What a dataset says about itself in `meta/info.json`, checked, and made anew where it is lost."""

import json
import re
from copy import deepcopy
from pathlib import Path
from typing import Any

from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
from lerobot.datasets.feature_utils import create_empty_dataset_info
from lerobot.datasets.utils import (
    DEFAULT_DATA_PATH,
    DEFAULT_VIDEO_PATH,
    INFO_PATH,
    LEGACY_EPISODES_PATH,
    LEGACY_TASKS_PATH,
    DatasetInfo,
)
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_playbyear.datasets.audio_feature import audio_keys


class DatasetDamagedError(ValueError):
    """A dataset cannot be repaired; nothing was changed."""


def read_info(root: Path, fps: int | None, features: dict[str, dict] | None, findings: list[str]) -> DatasetInfo:
    """Reads `meta/info.json`, or makes it from what the caller knows.

    Args:
        root: The dataset's folder.
        fps: Its frames per second, if the caller knows them.
        features: Its features, if the caller knows them.
        findings: Gets what was found wrong.

    Raises:
        DatasetDamagedError: It is unreadable and the caller does not know the features, or it is of another version.
    """
    try:
        info = DatasetInfo.from_dict(_checked(json.loads((root / INFO_PATH).read_text())))
    except FileNotFoundError:
        return _new_info(root, "is missing", fps, features, findings)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        return _new_info(root, f"is damaged ({error})", fps, features, findings)
    _check_version(root, info, findings)
    for name, wanted in (("data_path", DEFAULT_DATA_PATH), ("video_path", DEFAULT_VIDEO_PATH)):
        is_used = name == "data_path" or any(feature["dtype"] == "video" for feature in info.features.values())
        if is_used and getattr(info, name) != wanted and not _leads_somewhere(root, getattr(info, name)):
            findings.append(f"{INFO_PATH}: {name} was {getattr(info, name)!r}, where nothing is")
            setattr(info, name, wanted)
    return info


def correct_rates(info: DatasetInfo, frame_seconds: float | None, findings: list[str]) -> None:
    """Makes the frame rate agree with the frames' timestamps, and the sample rates with the sound.

    Args:
        info: Is corrected.
        frame_seconds: The time between two frames, as the data have it; None where there are not two frames.
        findings: Gets what was found wrong.
    """
    if frame_seconds and abs(info.fps * frame_seconds - 1) > 0.01:
        fps = round(1 / frame_seconds)
        findings.append(f"{INFO_PATH}: fps was {info.fps}; the frames' timestamps are {fps} per second")
        info.fps = fps
    for key in audio_keys(info.features):
        feature = info.features[key]
        details = feature.get("info") or {}
        if "sample_rate" in details and len(feature["shape"]) == 1:
            rate = feature["shape"][0] * info.fps
            if details["sample_rate"] != rate:
                findings.append(
                    f"{INFO_PATH}: the sample rate of '{key}' was {details['sample_rate']!r}; {feature['shape'][0]} "
                    f"samples per frame at {info.fps} frames per second are {rate} Hz"
                )
                feature["info"] = {**details, "sample_rate": rate}


def _checked(raw: Any) -> dict[str, Any]:
    """What LeRobot relies on without looking.

    Raises:
        ValueError: It is not there.
    """
    if not isinstance(raw, dict):
        raise ValueError("it holds no object")
    for name in ("fps", "total_episodes", "total_frames", "chunks_size"):
        if not isinstance(raw.get(name), int):
            raise ValueError(f"{name} is {raw.get(name)!r}")
    features = raw.get("features")
    if not isinstance(features, dict):
        raise ValueError("it names no features")
    for key in DEFAULT_FEATURES:
        if key not in features:
            raise ValueError(f"the feature '{key}' is missing")
    for key, feature in features.items():
        shape = feature.get("shape")
        if not isinstance(feature.get("dtype"), str) or not isinstance(shape, list):
            raise ValueError(f"the feature '{key}' has no dtype and shape")
        if not all(isinstance(size, int) for size in shape):
            raise ValueError(f"the feature '{key}' has shape {shape}")
    for name in ("data_path", "codebase_version"):
        if not isinstance(raw.get(name), str):
            raise ValueError(f"{name} is {raw.get(name)!r}")
    return raw


def _check_version(root: Path, info: DatasetInfo, findings: list[str]) -> None:
    version = re.fullmatch(r"v(\d+)\.(\d+)(\..*)?", info.codebase_version)
    if version and version[1] == "3":
        return
    has_our_layout = any(root.glob("meta/episodes/*/*.parquet")) or any(root.glob("data/chunk-*/file-*.parquet"))
    is_older = version is not None and int(version[1]) < 3
    if any((root / name).exists() for name in (LEGACY_EPISODES_PATH, LEGACY_TASKS_PATH)) or (
        is_older and not has_our_layout
    ):
        raise DatasetDamagedError(
            f"{root} is a dataset of LeRobot's older format {info.codebase_version}; wanted {CODEBASE_VERSION}. Convert "
            "it with `python -m lerobot.scripts.convert_dataset_v21_to_v30`."
        )
    if version and not is_older:
        raise DatasetDamagedError(
            f"{root} was written by a newer LeRobot (format {info.codebase_version}); wanted {CODEBASE_VERSION}. "
            "Update lerobot."
        )
    findings.append(f"{INFO_PATH}: codebase_version was {info.codebase_version!r}")
    info.codebase_version = CODEBASE_VERSION


def _new_info(
    root: Path, reason: str, fps: int | None, features: dict[str, dict] | None, findings: list[str]
) -> DatasetInfo:
    if not any(root.glob("data/*/*.parquet")):
        raise DatasetDamagedError(f"{root} holds no LeRobotDataset: {INFO_PATH} {reason}, and there is no data.")
    if fps is None or features is None:
        raise DatasetDamagedError(
            f"{root / INFO_PATH} {reason}, and nothing else says what the features are. Put it back from a copy, or "
            "repair with --like=<folder of a dataset that was recorded with the same settings>."
        )
    findings.append(f"{INFO_PATH} {reason}: made anew from the settings of this recording")
    use_videos = any(feature["dtype"] == "video" for feature in features.values())
    return create_empty_dataset_info(CODEBASE_VERSION, fps, {**deepcopy(features), **DEFAULT_FEATURES}, use_videos)


def _leads_somewhere(root: Path, template: str | None) -> bool:
    if not isinstance(template, str):
        return False
    try:
        return any(root.glob(re.sub(r"\{[^{}]*\}", "*", template)))
    except (ValueError, NotImplementedError):
        return False
