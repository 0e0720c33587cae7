"""What a dataset says about itself in `meta/info.json`: checked, held against its data files, and made anew where lost."""

import dataclasses
import json
import re
from copy import deepcopy
from pathlib import Path
from typing import Any

import pyarrow as pa
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
from lerobot.datasets.feature_utils import create_empty_dataset_info, get_hf_features_from_features
from lerobot.datasets.utils import (
    DEFAULT_DATA_PATH,
    DEFAULT_VIDEO_PATH,
    INFO_PATH,
    LEGACY_EPISODES_PATH,
    LEGACY_TASKS_PATH,
    DatasetInfo,
)
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_playbyear.datasets.features import audio_keys
from lerobot_playbyear.datasets.files import is_listed, list_files, read_listed
from lerobot_playbyear.datasets.info import _TEMPLATE
from lerobot_playbyear.datasets.parquet import ParquetDamageError, open_checked, parsing
from lerobot_playbyear.datasets.repair.report import DatasetDamagedError, RepairReport

_TOLERANCE = 0.01  # of rates
_MOST_FPS = 1_000_000  # timestamps that are closer are none
_KEPT: dict[str, type] = {"robot_type": str, "splits": dict, "tools": list}  # where the rest is made anew


def read_info(
    report: RepairReport, fps: int | None, features: dict[str, dict] | None
) -> tuple[DatasetInfo, dict[str, Any]]:
    """Reads `meta/info.json`, or makes it from what the caller knows.

    Args:
        report: Of the dataset; what is wrong is added.
        fps: Its frames per second, if the caller knows them.
        features: Its features, if the caller knows them.

    Returns:
        What it says, made good as far as it is proven; and all fields that it has, also those of other tools, which
        LeRobot's reader leaves out.

    Raises:
        DatasetDamagedError: It is unreadable and the caller does not know the features, or it is of another version.
        OSError: It cannot be read now.
    """
    root = report.root
    data = read_listed(root, INFO_PATH)
    if data is None:
        return _new_info(report, {}, "is missing", fps, features)
    fields: dict[str, Any] = {}
    try:
        raw = json.loads(data)
        fields = raw if isinstance(raw, dict) else {}
        info = _checked(fields)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        return _new_info(report, fields, f"is damaged ({error})", fps, features)
    _check_version(report, info)
    for name, wanted in (("data_path", DEFAULT_DATA_PATH), ("video_path", DEFAULT_VIDEO_PATH)):
        own = getattr(info, name)
        is_used = name == "data_path" or any(feature["dtype"] == "video" for feature in info.features.values())
        if not is_used or own == wanted or _leads_somewhere(root, own):
            continue
        said = f"{INFO_PATH}: {name} was {own!r}, where nothing is"
        if _leads_somewhere(root, wanted):
            report.findings.append(said)
        else:
            report.undecided.append(f"{said}, nor at {wanted!r}. Put the files, or the right path, there")
        info = dataclasses.replace(info, **{name: wanted})
    return info, fields


def check_rates(report: RepairReport, info: DatasetInfo, frame_seconds: float | None) -> float:
    """Holds the frame rate against the frames' timestamps, and the sample rates against the sound.

    Args:
        report: Of the dataset; what is wrong is added.
        info: What the dataset says about itself.
        frame_seconds: The time between two frames, as the data have it; None where there are not two frames.

    Returns:
        The frames per second: as the dataset says where its frames' timestamps agree with it, otherwise theirs.
    """
    fps: float = info.fps
    rate = 1 / frame_seconds if frame_seconds and frame_seconds > 0 else 0
    if 0 < rate < _MOST_FPS and abs(info.fps / rate - 1) > _TOLERANCE:
        fps = round(rate) or rate
        report.undecided.append(
            f"{INFO_PATH}: fps is {info.fps}, but the frames' timestamps are {fps:g} per second. Write {fps:g} there if "
            "they are right"
        )
    for key in audio_keys(info.features):
        feature = info.features[key]
        heard = (feature.get("info") or {}).get("sample_rate")
        if heard is not None and len(feature["shape"]) == 1 and heard != feature["shape"][0] * fps:
            report.undecided.append(
                f"{INFO_PATH}: the sample rate of '{key}' is {heard!r}, but {feature['shape'][0]} samples per frame at "
                f"{fps:g} frames per second are {feature['shape'][0] * fps:g} Hz. Write there what it was recorded at"
            )
    return fps


def _checked(raw: dict[str, Any]) -> DatasetInfo:
    """As `DatasetInfo.from_dict`, without its warning that other fields are lost: here they are not.

    Raises:
        ValueError: What LeRobot relies on without looking is not there.
    """
    wanted: dict[str, type] = dict.fromkeys(("fps", "total_episodes", "total_frames", "chunks_size"), int)
    for name, kind in {**wanted, "data_path": str, "codebase_version": str}.items():
        if not isinstance(raw.get(name), kind):
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
    return DatasetInfo(
        **{field.name: raw[field.name] for field in dataclasses.fields(DatasetInfo) if field.name in raw}
    )


def _check_version(report: RepairReport, info: DatasetInfo) -> None:
    root = report.root
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
    report.undecided.append(
        f"{INFO_PATH}: codebase_version is {info.codebase_version!r}, which LeRobot does not open; the files are named as "
        f"in {CODEBASE_VERSION}. Write that there if it is the dataset's format"
    )


def _new_info(
    report: RepairReport, old: dict[str, Any], reason: str, fps: int | None, features: dict[str, dict] | None
) -> tuple[DatasetInfo, dict[str, Any]]:
    root = report.root
    if not list_files(root, "data/*/*.parquet"):
        raise DatasetDamagedError(f"{root} holds no LeRobotDataset: {INFO_PATH} {reason}, and there is no data.")
    if fps is None or features is None:
        raise DatasetDamagedError(
            f"{root / INFO_PATH} {reason}, and nothing else says what the features are. Put it back from a copy, or "
            "repair with --like=<folder of a dataset that was recorded with the same settings>."
        )
    use_videos = any(feature["dtype"] == "video" for feature in features.values())
    info = create_empty_dataset_info(CODEBASE_VERSION, fps, {**deepcopy(features), **DEFAULT_FEATURES}, use_videos)
    for name, kind in _KEPT.items():
        if isinstance(old.get(name), kind):
            setattr(info, name, old[name])
    rest = (
        "robot_type, splits and all other fields are those that it had"
        if old
        else "robot_type, splits, and what else it held besides them, is lost"
    )
    report.findings.append(f"{INFO_PATH} {reason}: made anew from the settings of this recording; {rest}")
    return info, old


def _leads_somewhere(root: Path, template: str | None) -> bool:
    if not isinstance(template, str) or not _TEMPLATE.fullmatch(template):
        return False
    try:
        return bool(list_files(root, re.sub(r"\{[^{}]*\}", "*", template)))
    except ValueError:  # no name of a file, for example one with a null byte
        return False


def settle_features(report: RepairReport, info: DatasetInfo, features: dict[str, dict] | None) -> DatasetInfo:
    """Holds the features against what the data files hold. Where these differ, the caller's may be right.

    Args:
        report: Of the dataset; what is wrong is added.
        info: What the dataset says about itself.
        features: The features as the caller knows them; None if it does not.

    Returns:
        The same, with the features of the data files.

    Raises:
        DatasetDamagedError: The files hold other columns than the features say, and nobody knows better.
        OSError: A file cannot be read now.
    """
    known = {**features, **DEFAULT_FEATURES} if features else None
    paths = list_files(report.root, "data/*/*.parquet")
    schemas = [schema for path in paths if (schema := own_schema(path)) is not None]
    reasons = [_disagreement(schema, info.features) for schema in schemas]
    if (reasons and all(reasons)) or (not reasons and _disagreement(None, info.features)):
        if known is None or any(_disagreement(schema, known) for schema in schemas):
            raise DatasetDamagedError(
                f"{report.root / 'meta/info.json'} and the data files disagree: {(reasons or ['its features'])[0]}. Put the "
                "file back from a copy, or repair with --like=<folder of a dataset recorded with the same settings>."
            )
        what = reasons[0] if reasons else "it names a feature that LeRobot does not know"
        report.findings.append(f"meta/info.json: {what}; the features are now those of this recording")
        info = dataclasses.replace(info, features=deepcopy(known))
    return info


def check_columns(found: pa.Schema, wanted: pa.Schema) -> str | None:
    """What is wrong with a data file's columns, or None."""
    if set(found.names) != set(wanted.names):
        differing = sorted(set(found.names) ^ set(wanted.names))
        return f"its columns are not the dataset's features: {', '.join(differing)}"
    for field in wanted:
        if not _agree(found.field(field.name).type, field.type):
            return f"its column '{field.name}' is {found.field(field.name).type}; wanted {field.type}"
    return None


def _agree(found: pa.DataType, wanted: pa.DataType) -> bool:
    """Whether a column can be read as its feature says: other tools write lists without their length, for example."""
    found, wanted = (kind.storage_type if isinstance(kind, pa.BaseExtensionType) else kind for kind in (found, wanted))
    if pa.types.is_fixed_size_list(found) and pa.types.is_fixed_size_list(wanted):
        return found.list_size == wanted.list_size and _agree(found.value_type, wanted.value_type)
    if pa.types.is_nested(wanted) or pa.types.is_nested(found):
        return pa.types.is_nested(wanted) == pa.types.is_nested(found)
    return True


def own_schema(path: Path) -> pa.Schema | None:
    """A data file's columns, if its end is whole: what it says twice, to Arrow and to `datasets`, must agree."""
    try:
        with open_checked(path) as file, parsing(path):
            schema = file.schema_arrow
            described = json.loads((schema.metadata or {}).get(b"huggingface", b"{}"))
            names = described.get("info", {}).get("features", dict.fromkeys(schema.names))
            return schema if set(names) == set(schema.names) else None
    except (ParquetDamageError, AttributeError, TypeError):
        return None


def _disagreement(schema: pa.Schema | None, features: dict[str, dict]) -> str | None:
    """What a file's columns and a dataset's features disagree in; without a file, whether LeRobot knows them."""
    try:
        wanted = get_hf_features_from_features(features).arrow_schema
        return None if schema is None else check_columns(schema, wanted)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        return f"a feature is unknown to LeRobot ({error})"
