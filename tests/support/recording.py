"""Datasets that are recorded with `DurableWriter`, and what is left of them on the disk."""

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.configs.video import RGBEncoderConfig
from recording_factory import FEATURES, FILM, FPS, REPO_ID, differences, episode_frames, load

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.inspection import Finding, SurveyedDataset, check_numbers

ENCODER = RGBEncoderConfig(vcodec="h264", preset="ultrafast")


def writer(root: Path, features: dict[str, Any] = FEATURES, **options: Any) -> DurableWriter:
    """One that goes on with the dataset in `root`, or begins it."""
    return DurableWriter(REPO_ID, root, FPS, features, **{"rgb_encoder": ENCODER, "resume": True, **options})


def add_episode(target: DurableWriter, number: int) -> None:
    for frame in episode_frames(number, target.features):
        target.add_frame(frame)


def write_episode(target: DurableWriter, number: int) -> int:
    add_episode(target, number)
    return target.save_episode()


def write(root: Path, numbers: Sequence[int], features: dict[str, Any] = FEATURES, **options: Any) -> None:
    with writer(root, features, **options) as target:
        for number in numbers:
            write_episode(target, number)


def assert_recorded(root: Path, numbers: Sequence[int], features: dict[str, Any] = FEATURES) -> None:
    """Plain LeRobot reads these episodes, bit for bit, and nothing is wrong with the dataset."""
    dataset = load(root)
    assert dataset.num_episodes == len(numbers)
    known = {key: feature for key, feature in features.items() if key != FILM + "2"}
    assert not differences(dataset, dict(enumerate(numbers)), known)
    assert int(dataset.meta.stats["action"]["count"][0]) == dataset.num_frames
    assert survey(root).is_undamaged


def errors_in(root: Path) -> list[Finding]:
    """What `playbyear-inspect` finds to be wrong with a dataset."""
    return [each for each in check_numbers(SurveyedDataset.open(REPO_ID, root)) if each.level == "error"]


def edit_info(root: Path, change: Callable[[dict[str, Any]], object], name: str = "info.json") -> None:
    info = json.loads((root / "meta" / name).read_text())
    change(info)
    (root / "meta" / name).write_text(json.dumps(info))


def edit_column(path: Path, column: str, change: Callable[[list], list]) -> None:
    """Gives a table's column other values, of its type where they can be."""
    table = pq.read_table(path)
    field, values = table.schema.field(column), change(table.column(column).to_pylist())
    try:
        array = pa.array(values, field.type)
    except (pa.ArrowInvalid, pa.ArrowTypeError):
        array = pa.array([float(each) for each in values])
    pq.write_table(table.set_column(table.column_names.index(column), field.with_type(array.type), array), path)


def everything(folder: Path) -> dict[str, Any]:
    """All files, with their times, and all links below a folder, but locks."""
    return {
        str(path.relative_to(folder)): os.readlink(path)
        if path.is_symlink()
        else (path.read_bytes(), path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if (path.is_symlink() or path.is_file()) and path.name != ".lock"
    }
