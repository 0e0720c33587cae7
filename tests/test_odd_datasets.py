"""Datasets that others made: what cannot be learned from is refused by its name before anything is learned, the rest trains."""

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from dataset_factory import CAMERA, dataset_features, make_dataset
from PIL import Image
from support.recording import edit_column, edit_info
from support.shared import TINY, run_in_process

from lerobot_playbyear.scripts.commands import train

pytestmark = pytest.mark.usefixtures("one_thread")


def trained(root: Path, folder: Path, *options: str) -> Any:
    """What `playbyear-train` ends with: None, or what it says."""
    data = ("--dataset.repo_id=test/odd", f"--dataset.root={root}", "--steps=2", f"--output_dir={folder / 'out'}")
    return run_in_process(train, *TINY, *data, *options)


@pytest.fixture
def root(noise, tmp_path) -> Path:
    return Path(shutil.copytree(noise, tmp_path / "noise"))


def frames(root: Path) -> Path:
    (path,) = root.glob("data/*/*.parquet")
    return path


def test_a_dataset_without_a_state_trains_with_all_that_the_presets_predict(root, tmp_path):
    state = "observation.state"
    edit_info(root, lambda info: info["features"].pop(state))
    stats = json.loads((root / "meta/stats.json").read_text())
    (root / "meta/stats.json").write_text(json.dumps({key: own for key, own in stats.items() if key != state}))
    for path in (frames(root), *root.glob("meta/episodes/*/*.parquet")):
        table = pq.read_table(path)
        kept = [name for name in table.column_names if state not in name]
        pq.write_table(table.select(kept).replace_schema_metadata({}), path)
    predicted = ("--policy.auxiliary_onset=0.3", "--policy.auxiliary_balance=0.3", "--policy.auxiliary_way=0.3")
    assert trained(root, tmp_path, *predicted) is None


@pytest.mark.parametrize("shape", [(1,), (3,)])
def test_truth_values_are_refused_by_name(tmp_path, shape):
    touch = {"dtype": "bool", "shape": shape, "names": None}
    make_dataset(tmp_path / "odd", features={**dataset_features(image_size=16), "observation.touch": touch})
    assert "'observation.touch' has dtype bool" in trained(tmp_path / "odd", tmp_path)


@pytest.mark.parametrize("names", [None, [], ["height", "width"]])
def test_pictures_without_names_of_their_dimensions_are_refused(root, tmp_path, names):
    edit_info(root, lambda info: info["features"][CAMERA].update(names=names))
    assert f"'{CAMERA}' has names {names}; wanted" in trained(root, tmp_path)


@pytest.mark.parametrize(("dtype", "kind"), [(np.uint16, "PNG"), (np.uint16, "TIFF"), (np.float32, "TIFF")])
def test_pictures_of_more_than_8_bits_are_not_seen_as_white(root, tmp_path, dtype, kind):
    file = io.BytesIO()
    Image.fromarray((np.arange(256).reshape(16, 16) * 200).astype(dtype)).save(file, kind)
    edit_column(frames(root), CAMERA, lambda values: [{"bytes": file.getvalue(), "path": None} for _ in values])
    said = trained(root, tmp_path)
    assert f"'{CAMERA}': a picture of mode" in said
    assert "remove_feature" in said


@pytest.mark.parametrize("fps", [20.0])
def test_a_whole_rate_may_be_a_float(root, tmp_path, fps):
    edit_info(root, lambda info: info.update(fps=fps))
    assert trained(root, tmp_path) is None


def test_where_no_dataset_is_that_is_said_in_one_line(tmp_path):
    said = trained(tmp_path / "not/there", tmp_path)
    assert said.startswith(f"error: There is no dataset in '{tmp_path / 'not/there'}'")
    assert "\n" not in said
