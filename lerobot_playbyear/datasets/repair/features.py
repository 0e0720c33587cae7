"""Whether a dataset's features and its data files agree."""

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.utils import DatasetInfo
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_playbyear.datasets.files import list_files
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, open_checked, parsing
from lerobot_playbyear.datasets.repair.report import DatasetDamagedError, RepairReport


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
        info = replace(info, features=deepcopy(known))
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
