"""What a dataset says about itself in `meta/info.json`, checked, and made anew where it is lost."""

import dataclasses
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
from lerobot_playbyear.datasets.confines import is_template
from lerobot_playbyear.datasets.files import is_listed, list_files, naming

_KEPT: dict[str, type] = {"robot_type": str, "splits": dict, "tools": list}  # where the rest is made anew


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
        OSError: It cannot be read now.
    """
    if not is_listed(root, INFO_PATH):
        return _new_info(root, "is missing", fps, features, findings)
    with naming(root / INFO_PATH):
        data = (root / INFO_PATH).read_bytes()
    try:
        info = _known(_checked(json.loads(data)))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        return _new_info(root, f"is damaged ({error})", fps, features, findings)
    _check_version(root, info, findings)
    for name, wanted in (("data_path", DEFAULT_DATA_PATH), ("video_path", DEFAULT_VIDEO_PATH)):
        is_used = name == "data_path" or any(feature["dtype"] == "video" for feature in info.features.values())
        if is_used and getattr(info, name) != wanted and not _leads_somewhere(root, getattr(info, name)):
            findings.append(f"{INFO_PATH}: {name} was {getattr(info, name)!r}, where nothing is")
            setattr(info, name, wanted)
    return info


def own_info(root: Path) -> dict[str, Any]:
    """Everything that `meta/info.json` holds, as far as it is JSON; LeRobot's reader leaves unknown fields out.

    Raises:
        OSError: It cannot be read now.
    """
    if not is_listed(root, INFO_PATH):
        return {}
    with naming(root / INFO_PATH):
        data = (root / INFO_PATH).read_bytes()
    try:
        raw = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return raw if isinstance(raw, dict) else {}


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


def _known(raw: dict[str, Any]) -> DatasetInfo:
    """As `DatasetInfo.from_dict`, without its warning that other fields are lost: here they are not."""
    return DatasetInfo(
        **{field.name: raw[field.name] for field in dataclasses.fields(DatasetInfo) if field.name in raw}
    )


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
    has_our_layout = any(
        list_files(root, name) for name in ("meta/episodes/*/*.parquet", "data/chunk-*/file-*.parquet")
    )
    is_older = version is not None and int(version[1]) < 3
    if any(is_listed(root, name) for name in (LEGACY_EPISODES_PATH, LEGACY_TASKS_PATH)) or (
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
    if not list_files(root, "data/*/*.parquet"):
        raise DatasetDamagedError(f"{root} holds no LeRobotDataset: {INFO_PATH} {reason}, and there is no data.")
    if fps is None or features is None:
        raise DatasetDamagedError(
            f"{root / INFO_PATH} {reason}, and nothing else says what the features are. Put it back from a copy, or "
            "repair with --like=<folder of a dataset that was recorded with the same settings>."
        )
    use_videos = any(feature["dtype"] == "video" for feature in features.values())
    info = create_empty_dataset_info(CODEBASE_VERSION, fps, {**deepcopy(features), **DEFAULT_FEATURES}, use_videos)
    old = own_info(root)
    for name, kind in _KEPT.items():
        if isinstance(old.get(name), kind):
            setattr(info, name, old[name])
    rest = "; robot_type, splits and all other fields are those that it had" if old else ""
    findings.append(
        f"{INFO_PATH} {reason}: made anew from the settings of this recording"
        f"{rest or '; robot_type, splits, and what else it held besides them, is lost'}"
    )
    return info


def _leads_somewhere(root: Path, template: str | None) -> bool:
    if not isinstance(template, str) or not is_template(template):
        return False
    try:
        return bool(list_files(root, re.sub(r"\{[^{}]*\}", "*", template)))
    except ValueError:  # no name of a file, for example one with a null byte
        return False
