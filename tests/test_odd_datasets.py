"""Datasets that others made: what cannot be learned from is refused by its name before anything is learned, the rest trains."""

import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from dataset_factory import CAMERA, dataset_features, make_dataset
from PIL import Image
from support.old_layout import OLD
from support.recording import edit_column, edit_info
from support.shared import ENV, TINY, run_in_process

from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.datasets.frame_rate import exact_rate
from lerobot_playbyear.datasets.reader import EpisodeRows, SurveyedDataset
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.datasets.video_files import picture_times
from lerobot_playbyear.hub.dataset_card import film_preview
from lerobot_playbyear.inspection.inspect import InspectConfig, InspectDatasetConfig, inspect
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.repair.repair import RepairConfig, repair
from lerobot_playbyear.scripts import commands
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


@pytest.mark.parametrize("mode", ["L", "RGBA", "P"])
def test_pictures_of_8_bits_train_whatever_their_channels(root, tmp_path, mode):
    """They are seen as what they show: grey as grey, and nothing of what is transparent."""
    file = io.BytesIO()
    Image.fromarray(np.arange(256, dtype=np.uint8).reshape(16, 16)).convert(mode).save(file, "PNG")
    edit_column(frames(root), CAMERA, lambda values: [{"bytes": file.getvalue(), "path": None} for _ in values])
    seen = next(SurveyedDataset.open("a/b", root).pictures(CAMERA, EpisodeRows(0, 0, 1)))
    assert np.array_equal(seen, np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=2))
    assert trained(root, tmp_path) is None


@pytest.mark.parametrize("n_channels", [1, 2, 4])
def test_cameras_without_three_channels_are_refused(root, tmp_path, n_channels):
    edit_info(root, lambda info: info["features"][CAMERA].update(shape=[16, 16, n_channels]))
    said = trained(root, tmp_path)
    assert f"'{CAMERA}' has shape (16, 16, {n_channels}); wanted three channels" in said
    assert f"remove_feature '--operation.feature_names=[\"{CAMERA}\"]'" in said


STATE = {"dtype": "float32", "shape": (2,), "names": None}


@pytest.mark.parametrize(
    ("key", "changes"),
    [
        ("observation.state", {"shape": (1,)}),
        pytest.param("observation.state", {"names": {"motors": ["shoulder", "elbow"]}}, marks=pytest.mark.slow),
        pytest.param("observation.count", {"dtype": "int64"}, marks=pytest.mark.slow),
        pytest.param("observation.load", {"dtype": "float64"}, marks=pytest.mark.slow),
        ("note", {"dtype": "string", "shape": (1,)}),
    ],
)
def test_other_columns_train(tmp_path, key, changes):
    make_dataset(tmp_path / "odd", (5,), features={**dataset_features(image_size=16), key: STATE | changes})
    assert trained(tmp_path / "odd", tmp_path) is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"dtype": "string", "shape": (1,)}, "has dtype string"), ({"shape": (2, 3)}, "has shape (2, 3)")],
)
def test_observations_that_no_policy_takes_are_refused(tmp_path, changes, said):
    make_dataset(
        tmp_path / "odd", (5,), features={**dataset_features(image_size=16), "observation.odd": STATE | changes}
    )
    told = trained(tmp_path / "odd", tmp_path)
    assert f"'observation.odd' {said}" in told
    assert "\n" not in told


@pytest.mark.parametrize("fps", [20.0])
def test_a_whole_rate_may_be_a_float(root, tmp_path, fps):
    edit_info(root, lambda info: info.update(fps=fps))
    assert trained(root, tmp_path) is None


def test_where_no_dataset_is_that_is_said_in_one_line(tmp_path):
    said = trained(tmp_path / "not/there", tmp_path)
    assert said.startswith(
        f"error: There is no LeRobotDataset in '{tmp_path / 'not/there'}': it does not exist, and 'test/odd' could"
    )
    assert "\n" not in said


# Frame rates

RATES = [(12.5, 16000), (29.97, 14985), (30000 / 1001, 30000)]  # with sample rates that they divide


_SOME = [pytest.param(RATES[0], marks=pytest.mark.slow), RATES[1], pytest.param(RATES[2], marks=pytest.mark.slow)]


@pytest.fixture(params=_SOME, ids=["12.5", "29.97", "30000/1001"])
def fractional(request, tmp_path) -> tuple[Path, float, int]:
    """A dataset whose frame rate is no whole number, as LeRobot makes it, and its rates."""
    fps, rate = request.param
    make_dataset(tmp_path / "odd", fps=fps, sample_rate=rate, image_size=16)
    return tmp_path / "odd", fps, rate


@pytest.mark.slow
def test_frame_rates_that_are_not_whole_are_inspected_filmed_and_not_damaged(fractional, tmp_path):
    root, fps, rate = fractional
    options = InspectConfig(InspectDatasetConfig("a/b", str(root)), html=tmp_path / "page.html")
    found = inspect(options)
    assert not [each for each in found if each.level == "error"]
    assert f"{rate:,} Hz / {fps} Hz" in str(next(each for each in found if each.check == "sample rate"))
    assert repair(RepairConfig(root)).survey.is_undamaged
    dataset = SurveyedDataset.open("a/b", root)
    film_preview(dataset, tmp_path / "film.mp4")
    assert np.allclose(np.diff(picture_times(tmp_path / "film.mp4")), 1 / fps, atol=1e-4)


def test_a_policy_learns_at_a_frame_rate_that_is_not_whole(fractional, tmp_path):
    root, fps, _ = fractional
    assert trained(root, tmp_path) is None
    config = json.loads((tmp_path / "out/checkpoints/000002/pretrained_model/config.json").read_text())
    assert config["fps"] == fps
    refused = trained(root, tmp_path / "more", "--policy.fps=20")
    assert f"give --policy.fps={fps}, or" in refused


@pytest.mark.parametrize(
    ("fps", "wanted"),
    [(12.5, 16000), (29.97, 14985), (30000 / 1001, 30000), (20.0, 16000)],
    ids=["12.5", "29.97", "ntsc", "20.0"],
)
def test_sound_and_its_pictures_are_attached_at_any_frame_rate(tmp_path, fps, wanted):
    root, sounds = tmp_path / "deaf", tmp_path / "heard"
    make_dataset(root, (9,), fps=fps, image_size=16, microphones=())
    edit_info(root, lambda info: info.update(fps=fps))
    sounds.mkdir()
    noise = np.random.default_rng(0).normal(0, 300, (16000, 1)).astype(np.int16)
    write_audio(sounds / "0.wav", noise, 16000)
    data = ("--dataset.repo_id=a/b", f"--dataset.root={root}", f"--files={sounds}/{{episode}}.wav")
    given = (*data, "--output.repo_id=a/c", f"--output.root={tmp_path / 'out'}")
    if wanted != 16000:
        assert f"--sample_rate={wanted}." in str(run_in_process(commands.attach_audio, *given))
        said = str(run_in_process(commands.attach_audio, *given, "--sample_rate=16000"))
        assert f"a multiple of {exact_rate(fps).numerator} Hz, such as {wanted}" in said
    assert run_in_process(commands.attach_audio, *given, f"--sample_rate={wanted}") is None
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert (info["fps"], type(info["fps"])) == (fps, int if fps == 20 else float)
    pictured = ("--dataset.repo_id=a/c", f"--dataset.root={tmp_path / 'out'}", "--output.repo_id=a/d", "--seconds=0.4")
    assert run_in_process(commands.attach_spectrogram, *pictured, f"--output.root={tmp_path / 'seen'}") is None
    assert survey(tmp_path / "seen").is_undamaged


# What is no whole dataset


def elsewhere(root: Path) -> None:
    (root / "videos").rename(root / "movies")


def unsaved(root: Path) -> None:
    """As LeRobot leaves it, killed in the first episode."""
    for name in ("data", "videos", "meta/episodes"):
        shutil.rmtree(root / name)
    (root / "images").mkdir(exist_ok=True)
    edit_info(root, lambda info: info.update(total_episodes=0, total_frames=0))


INCOMPLETE: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no folder": (shutil.rmtree, r"There is no LeRobotDataset in '{root}': it does not exist"),
    "the folder above": (
        lambda root: shutil.move(root, root.parent / "x") and shutil.copytree(root.parent / "x", root / "films"),
        r"There is no LeRobotDataset in '{root}': it has no meta/info.json; there is one in '{root}/films'. C",
    ),
    "other files": (
        lambda root: (shutil.rmtree(root), root.mkdir(), (root / "thesis.tex").touch()),
        r"There is no LeRobotDataset in '{root}': it has no meta/info.json; it holds thesis.tex. C",
    ),
    "no films": (
        lambda root: shutil.rmtree(root / "videos"),
        rf"'{{root}}' has no films of '{CAMERA}', which meta/info",
    ),
    "films elsewhere": (
        elsewhere,
        rf"has no films of '{CAMERA}'.* There are films in '{{root}}/movies/{CAMERA}/chunk-000'",
    ),
    "no meta/episodes": (
        lambda root: shutil.rmtree(root / "meta/episodes"),
        r"'{root}' has no meta/episodes/\*/\*.parquet.*from the frames: playbyear-repair --root={root}$",
    ),
    "layout 2.1": (
        lambda root: edit_info(root, lambda info: info.update(OLD)),
        r"{root} is a dataset of LeRobot's older format v2.1; wanted v3.0. Convert it: python -m lerobot",
    ),
    "nothing saved": (unsaved, r"The dataset in '{root}' is empty: no episode was saved"),
}

NAMED = ("--dataset.repo_id=a/b", "--dataset.root={root}")
ATTACHED = ("--output.repo_id=a/c", "--output.root={out}")
DEMOS = (
    "--dataset.repo_id=a/b",
    "--dataset.root={root}",
    "--interventions.repo_id=a/i",
    "--interventions.root={out}/i",
)
TOLD: dict[str, tuple[Callable[[], Any], tuple[str, ...]]] = {
    "inspect": (commands.inspect, NAMED),
    "repair": (commands.repair, ("--root={root}",)),
    "attach-audio": (commands.attach_audio, (*NAMED, *ATTACHED, "--files={out}/{{episode}}.wav")),
    "attach-spectrogram": (commands.attach_spectrogram, (*NAMED, *ATTACHED)),
    "train": (commands.train, (*TINY, *NAMED, "--output_dir={out}")),
    "dagger": (commands.dagger, (*ENV, "--policy.path={policy}", *DEMOS, "--output_dir={out}/run")),
    "push": (commands.push, NAMED),
    "record": (commands.record, (*ENV, *NAMED, "--resume=true", "--num_workers=0")),
}
GOES_ON = {
    ("repair", "no meta/episodes"),
    ("repair", "nothing saved"),
    ("record", "no folder"),
    ("record", "nothing saved"),
}
"""A repair makes the table, a recorder begins a dataset."""


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> Path:
    return Path(make_dataset(tmp_path_factory.mktemp("filmed") / "films", (5, 4), image_size=16, use_videos=True).root)


@pytest.fixture(scope="module")
def trained_config(tmp_path_factory) -> Path:
    """A policy of which no more than its options is read before the dataset."""
    folder = tmp_path_factory.mktemp("policy")
    PlaybyearConfig(device="cpu", push_to_hub=False).save_pretrained(folder)
    return folder


@pytest.mark.parametrize("case", INCOMPLETE)
@pytest.mark.parametrize("command", TOLD)
def test_what_is_no_whole_dataset_is_told_in_one_line(filmed, trained_config, tmp_path, capsys, command, case):
    if (command, case) in GOES_ON:
        pytest.skip("it goes on")
    root = Path(shutil.copytree(filmed, tmp_path / "films"))
    damage, wanted = INCOMPLETE[case]
    damage(root)
    main, options = TOLD[command]
    places = {"root": root, "out": tmp_path / "out", "policy": trained_config}
    ended = run_in_process(main, *(option.format(**places) for option in options))
    said = str(ended) if command != "inspect" else capsys.readouterr().err
    assert re.search(wanted.replace("{root}", re.escape(str(root))), said.strip())
    assert said.strip().count("\n") == 0
    assert not list((tmp_path / "out").rglob("*"))
