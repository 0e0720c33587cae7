"""Whether a dataset's features and its data files agree, and who is right where they do not."""

import contextlib
import io
import itertools
import json
from copy import deepcopy
from pathlib import Path

import pyarrow as pa
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.utils import DatasetInfo
from lerobot.utils.constants import DEFAULT_FEATURES
from PIL import Image

from lerobot_playbyear.datasets.files import list_files
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, open_checked, parsing
from lerobot_playbyear.datasets.repair.info import DatasetDamagedError


def settle_features(root: Path, info: DatasetInfo, features: dict[str, dict] | None, findings: list[str]) -> None:
    """Makes the features agree with what the data files hold, where the caller knows better or a picture tells.

    Args:
        root: The dataset's folder.
        info: Is corrected.
        features: The features as the caller knows them; None if it does not.
        findings: Gets what was found wrong.

    Raises:
        DatasetDamagedError: The files hold other columns than the features say, and nobody knows better.
        OSError: A file cannot be read now.
    """
    known = {**features, **DEFAULT_FEATURES} if features else None
    schemas = [schema for path in list_files(root, "data/*/*.parquet") if (schema := _own_schema(path)) is not None]
    reasons = [_disagreement(schema, info.features) for schema in schemas]
    if (reasons and all(reasons)) or (not reasons and _disagreement(None, info.features)):
        if known is None or any(_disagreement(schema, known) for schema in schemas):
            raise DatasetDamagedError(
                f"{root / 'meta/info.json'} and the data files disagree: {(reasons or ['its features'])[0]}. Put the "
                "file back from a copy, or repair with --like=<folder of a dataset recorded with the same settings>."
            )
        what = reasons[0] if reasons else "it names a feature that LeRobot does not know"
        findings.append(f"meta/info.json: {what}; the features are now those of this recording")
        info.features = deepcopy(known)
    for key, feature in info.features.items():
        size = _picture_size(root, key) if feature["dtype"] == "image" else None
        if size and not set(itertools.pairwise(feature["shape"])) & {size}:
            findings.append(f"meta/info.json: '{key}' had shape {tuple(feature['shape'])}; its pictures are {size}")
            feature["shape"] = (*size, feature["shape"][-1])


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


def _own_schema(path: Path) -> pa.Schema | None:
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


def _picture_size(root: Path, key: str) -> tuple[int, int] | None:
    """Height and width of the first picture of a camera."""
    for path in list_files(root, "data/*/*.parquet"):
        data = _first_picture(path, key)
        with contextlib.suppress(OSError, SyntaxError, ValueError, Image.DecompressionBombError):
            if data is not None:
                with Image.open(io.BytesIO(data)) as image:
                    return image.height, image.width
    return None


def _first_picture(path: Path, key: str) -> bytes | None:
    """The first picture of a file, encoded; None where there is none, or damage."""
    try:
        with open_checked(path) as file, parsing(path):
            picture = file.read_row_group(0, columns=[key]).column(key)[0].as_py()
            return picture["bytes"]
    except (ParquetDamageError, TypeError):
        return None
