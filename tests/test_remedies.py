"""What messages advise about a dataset is a whole command: run as it is printed, it puts the dataset right."""

import io
import json
import re
import runpy
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from dataset_factory import CAMERA, MICROPHONE, dataset_features, make_dataset
from lerobot.scripts import lerobot_edit_dataset
from PIL import Image
from support.old_layout import as_v21
from support.recording import edit_column, edit_info
from support.shared import TINY, run_in_process

from lerobot_playbyear.datasets.reader import check_dataset_files
from lerobot_playbyear.datasets.remedies import recompute_command, without_episodes
from lerobot_playbyear.inspection.inspect import InspectConfig, InspectDatasetConfig, inspect
from lerobot_playbyear.scripts.commands import repair, train

pytestmark = pytest.mark.usefixtures("one_thread")

_COMMAND = re.compile(r"(?:lerobot-edit-dataset|playbyear-repair|python -m lerobot\.scripts\.\w+)\s.*")
_MAINS = {"lerobot-edit-dataset": lerobot_edit_dataset.main, "playbyear-repair": repair}


def advised(said: str) -> list[str]:
    """The words of the command that a message ends with."""
    return shlex.split(_COMMAND.search(said)[0].split(" (it writes ")[0])


def follow(said: str, root: Path) -> Path:
    """Runs it. Returns the folder of the dataset that is right then."""
    command, *options = advised(said)
    if command == "python":
        run_in_process(lambda: runpy.run_module(options[1], run_name="__main__"), *options[2:])
        return root
    assert run_in_process(_MAINS[command], *options) in (None, 0)
    given = dict(option.partition("=")[::2] for option in options)
    return Path(given.get("--new_root", f"{root}_repaired" if command == "playbyear-repair" else root))


def complaints(root: Path) -> list[str]:
    """What `playbyear-inspect` warns of, without what it measures in noise."""
    found = inspect(InspectConfig(InspectDatasetConfig("a/b", str(root))))
    checks = ("files", "rows", "times", "tasks", "statistics", "columns", "info")
    return [str(each) for each in found if each.level in ("warning", "error") and each.check in checks]


@pytest.fixture
def root(noise, tmp_path) -> Path:
    """Its name is one that a shell would take apart."""
    return Path(shutil.copytree(noise, tmp_path / "my noise"))


def frames(root: Path) -> Path:
    (path,) = root.glob("data/*/*.parquet")
    return path


def of_training(root: Path) -> str:
    data = ("--dataset.repo_id=a/b", f"--dataset.root={root}", "--steps=1", f"--output_dir={root.parent / 'out'}")
    return str(run_in_process(train, *TINY, *data))


def of_inspection(root: Path) -> str:
    (said,) = complaints(root)
    return said


def set_stats(key: str, **values: Any) -> Callable[[Path], None]:
    return lambda root: edit_info(root, lambda stats: stats[key].update(values), "stats.json")


def ten_percent_off(root: Path) -> None:
    edit_info(
        root, lambda stats: stats["action"].update(std=[1.1 * std for std in stats["action"]["std"]]), "stats.json"
    )


def rename_task(root: Path) -> None:
    table = pq.read_table(root / "meta/tasks.parquet").to_pandas()
    table.index = ["Another."]
    table.index.name = "task"
    table.to_parquet(root / "meta/tasks.parquet")


def lose_a_picture(root: Path) -> None:
    edit_column(frames(root), CAMERA, lambda values: [None, *values[1:]])


def skip_a_frame(root: Path) -> None:
    edit_column(frames(root), "frame_index", lambda values: [*values[:3], values[3] + 1, *values[4:]])


def truncate(root: Path) -> None:
    frames(root).write_bytes(frames(root).read_bytes()[:-50])


def depth(root: Path) -> None:
    edit_info(root, lambda info: info["features"][CAMERA].update(info={"is_depth_map": True}))


def white(root: Path) -> None:
    file = io.BytesIO()
    Image.fromarray((np.arange(256).reshape(16, 16) * 200).astype(np.uint16)).save(file, "PNG")
    edit_column(frames(root), CAMERA, lambda values: [{"bytes": file.getvalue(), "path": None} for _ in values])


DAMAGE: dict[str, tuple[Callable[[Path], Any], Callable[[Path], str]]] = {
    "a std that is 10 % off": (ten_percent_off, of_inspection),
    "a std that is NaN": (set_stats("action", std=[float("nan")] * 4), of_inspection),
    "a mean of other data": (set_stats("observation.state", mean=[3.0] * 7), of_inspection),
    "statistics of sound": (set_stats(MICROPHONE, std=[1.0] * 800), of_inspection),
    "no statistics of a column": (
        lambda root: edit_info(root, lambda stats: stats.pop("next.reward"), "stats.json"),
        of_inspection,
    ),
    "a task with another text": (rename_task, of_inspection),
    "no table of episodes": (lambda root: shutil.rmtree(root / "meta/episodes"), of_training),
    "a file without its end": (truncate, of_training),
    "a copy of frames": (
        lambda root: shutil.copy(frames(root), frames(root).with_name("file-001.parquet")),
        of_training,
    ),
    "too many episodes claimed": (
        lambda root: edit_info(root, lambda info: info.update(total_episodes=99)),
        of_training,
    ),
    "a frame is skipped": (skip_a_frame, of_training),
    "a picture is missing": (lose_a_picture, of_training),
    "the layout 2.1": (as_v21, of_training),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_the_command_that_a_message_prints_puts_the_dataset_right(root, damage):
    make, ask = DAMAGE[damage]
    make(root)
    said = ask(root)
    assert "\n" not in said
    mended = follow(said, root)
    assert not complaints(mended)
    check_dataset_files("a/b", mended)


@pytest.mark.parametrize("make", [depth, white])
def test_what_is_trained_on_without_a_camera_is_the_copy_that_is_named(root, make):
    make(root)
    said = of_training(root)
    assert f"'{CAMERA}'" in said
    copy = follow(said, root)
    assert str(copy) in said.split("(it writes ")[1]
    assert complaints(copy) == []
    data = ("--dataset.repo_id=a/b", f"--dataset.root={copy}", "--steps=1", f"--output_dir={root.parent / 'again'}")
    assert run_in_process(train, *TINY, *data, "--policy.use_vision=false") is None


def test_episodes_are_left_out(root):
    copy = follow(without_episodes(root, [1]), root)
    assert not complaints(copy)
    assert json.loads((copy / "meta/info.json").read_text())["total_episodes"] == 2


@pytest.mark.parametrize("length", [17, pytest.param(400, marks=pytest.mark.slow)])
@pytest.mark.parametrize("value", [0.1, 100.3, -3333.3])
def test_statistics_that_lerobot_rounds_are_no_fault(tmp_path, value, length):
    """It takes the small difference of two large sums of 32 bits; what its own command computes is the same."""
    features = {key: dataset_features(state_size=2)[key] for key in ("observation.state", "action")}
    constant = np.full(2, value, np.float32)
    still = {
        "frame_of": lambda _, step, frame: {**frame, "observation.state": constant * np.float32(1 + 1e-7 * (step % 2))}
    }
    make_dataset(tmp_path / "still", (length, length), features=features, **still)
    assert not complaints(tmp_path / "still")
    follow(recompute_command(tmp_path / "still"), tmp_path / "still")
    assert not complaints(tmp_path / "still")


def test_the_pages_advise_the_same():
    page = " ".join((Path(__file__).parents[1] / "docs/reference/dataset_format.md").read_text().split())
    assert f"`{recompute_command(Path('outputs/heard'))}`".replace("local/", "me/") in page
