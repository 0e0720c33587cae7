"""What strangers send writes, removes, reads and runs nothing outside its own folder."""

import json
import os
import re
import shutil
import threading
from pathlib import Path

import av
import lerobot.policies
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dagger_factory import FINISHED, QUICK, command, dagger, state
from dataset_factory import CAMERA, MICROPHONE, make_dataset
from support.recording import edit_column, edit_info
from support.shared import ENV, TINY, run_in_process

from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.audio.attach_audio import AttachAudioConfig, DatasetPlace, attach_audio
from lerobot_playbyear.datasets.checkpoint_steps import RUN_PROGRAMS, check_steps, check_type
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import FolderLockedError, new_file, new_folder, write_atomically
from lerobot_playbyear.datasets.pictures import video_pictures
from lerobot_playbyear.datasets.reader import DatasetReader, SurveyedDataset, check_dataset_files
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.datasets.video_files import picture_times
from lerobot_playbyear.hub.push import PushOptions, push_policy
from lerobot_playbyear.inspection.inspect import InspectConfig, InspectDatasetConfig, inspect
from lerobot_playbyear.repair.repair import RepairConfig, repair
from lerobot_playbyear.scripts.commands import dagger as dagger_command
from lerobot_playbyear.scripts.commands import train, video
from lerobot_playbyear.training import EpisodeStore

pytestmark = pytest.mark.usefixtures("one_thread")

SECRET = "what nobody else may read or change"


ODD_STATES = (
    *('{"policy_path": "x", "made": "000002"}', '{"policy_path": "x", "next_seed": -3}'),
    *('{"policy_path": "x", "best": {"checkpoint": 5}}', '{"policy_path": "x", "best": {"seeds": [1, 2]}}'),
)


@pytest.fixture
def secret(tmp_path):
    """A file of this machine."""
    path = tmp_path / "home/.bashrc"
    path.parent.mkdir()
    path.write_text(SECRET)
    yield path
    assert path.read_text() == SECRET
    assert [each.name for each in path.parent.iterdir()] == [".bashrc"]


def film(path: Path, size: int = 16) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=20)
        stream.width = stream.height = size
        for _ in range(5):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((size, size, 3), np.uint8), "rgb24")))
        container.mux(stream.encode(None))


# Links


@pytest.mark.parametrize("name", [".page.html.partial", "page.html"])
def test_a_page_is_written_through_no_link(noise, tmp_path, secret, name):
    (tmp_path / name).symlink_to(secret)
    inspect(InspectConfig(InspectDatasetConfig("a/b", str(noise)), html=tmp_path / "page.html"))
    assert "<html" in (tmp_path / "page.html").read_text()


@pytest.mark.parametrize("make", [write_atomically, lambda path, text: _write(path, text)])
@pytest.mark.parametrize("name", ["info.json.partial", "info.json"])
def test_a_file_is_written_through_no_link(tmp_path, secret, make, name):
    (tmp_path / name).symlink_to(secret)
    make(tmp_path / "info.json", "new")
    assert (tmp_path / "info.json").read_text() == "new"
    assert not (tmp_path / "info.json").is_symlink()


def _write(path: Path, text: str) -> None:
    with new_file(path) as partial:
        partial.write_text(text)


@pytest.mark.parametrize("name", ["checkpoints", "metrics.jsonl", "eval", "attempts"])
def test_a_run_goes_on_through_no_link(finished, tmp_path, secret, name):
    """Neither `playbyear-dagger`, which removes checkpoints that it no longer needs, nor `playbyear-train`."""
    run = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True)) / "out"
    if (run / name).is_dir():
        shutil.rmtree(run / name)
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(secret.parent if name != "metrics.jsonl" else secret)
    with pytest.raises(InputError, match=f"{name}' is a link to .*nothing is written or removed"):
        command("--resume=true", f"--output_dir={run}")


@pytest.mark.parametrize(
    "name", ["checkpoints/000004", "checkpoints/000004/pretrained_model", "metrics.jsonl", "eval/videos"]
)
def test_training_writes_through_no_link(recorded, trained, tmp_path, secret, name):
    run = Path(shutil.copytree(trained.parents[2], tmp_path / "run", symlinks=True))
    (run / name).unlink(missing_ok=True)
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).symlink_to(secret.parent if name != "metrics.jsonl" else secret)
    config = run / "checkpoints/000002/pretrained_model/train_config.json"
    saved = json.loads(config.read_text())
    config.write_text(json.dumps({**saved, "output_dir": str(run)}))
    said = run_in_process(train, "--resume=true", f"--config_path={config}", "--steps=4")
    assert f"{Path(name).name}' is a link to" in str(said)


def test_what_goes_up_after_a_training_is_of_its_run(trained, tmp_path, here):
    run = Path(shutil.copytree(trained.parents[2], tmp_path / "run", symlinks=True))
    shutil.copytree(trained.parent, tmp_path / "elsewhere")
    (run / "checkpoints/last").unlink()
    (run / "checkpoints/last").symlink_to(tmp_path / "elsewhere")
    resumed = ("--resume=true", f"--config_path={run / 'checkpoints/000002/pretrained_model/train_config.json'}")
    pushed = (f"--output_dir={run}", "--policy.push_to_hub=true", "--policy.repo_id=me/stranger")
    assert "its last checkpoint is a link to" in str(run_in_process(train, *resumed, *pushed))
    assert not here.arrivals


def test_dagger_removes_only_checkpoints_of_its_own(tmp_path):
    dagger(tmp_path, *QUICK, *FINISHED, "--num_episodes=2")
    first = state(tmp_path)["checkpoint"]
    checkpoints = tmp_path / "out/checkpoints"
    for name in ("holiday_pictures", "000000"):
        (checkpoints / name).mkdir()
    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--num_episodes=3")
    last = state(tmp_path)["checkpoint"]
    assert last != first
    names = {path.name for path in checkpoints.iterdir()}
    assert names == {"holiday_pictures", "000000", "last", "best", *state(tmp_path)["made"]}
    assert last in names


@pytest.mark.parametrize("field", ["made", "milestones", "checkpoint", "best"])
@pytest.mark.parametrize("name", ["../../../home", "{home}", "..", "", "last", "best"])
def test_a_runs_state_names_no_folder_elsewhere(finished, tmp_path, secret, field, name):
    """Or else the folder that it says was made by the run would be removed."""
    run, name = (
        Path(shutil.copytree(finished, tmp_path / "run", symlinks=True)) / "out",
        name.format(home=secret.parent),
    )
    saved = json.loads((run / "dagger_state.json").read_text())
    best = {**saved["best"], "checkpoint": name}
    saved[field] = {"made": [name], "milestones": [name], "checkpoint": name, "best": best}[field]
    (run / "dagger_state.json").write_text(json.dumps(saved))
    with pytest.raises(InputError, match="names the checkpoint"):
        command("--resume=true", f"--output_dir={run}")


@pytest.mark.parametrize("file", ["train_config.json", "playbyear_train_config.json"])
def test_training_goes_on_in_its_own_folder(trained, tmp_path, file):
    """Also where the folder was moved since."""
    run = Path(shutil.copytree(trained.parents[2], tmp_path / "run", symlinks=True))
    config = run / "checkpoints/000002/pretrained_model/train_config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "output_dir": str(run)}))
    options = json.loads(config.with_name(file).read_text())
    config.with_name(file).write_text(json.dumps({**options, "output_dir": str(tmp_path / "home")}))
    said = run_in_process(train, "--resume=true", f"--config_path={config}", "--steps=3")
    assert not (tmp_path / "home").exists()
    if file == "train_config.json":
        assert f"is another folder. Give --output_dir={run} to go on there" in said
    else:  # where only options of ours are read
        assert (run / "checkpoints/000003").is_dir()


@pytest.mark.parametrize("text", ["[]", '{"step": "x"}', '{"step": 1e400}', "[" * 9999])
def test_a_damaged_number_of_updates_is_named(trained, tmp_path, text):
    run = Path(shutil.copytree(trained.parents[2], tmp_path / "run", symlinks=True))
    config = run / "checkpoints/000002/pretrained_model/train_config.json"
    (run / "checkpoints/000002/training_state/training_step.json").write_text(text)
    said = run_in_process(train, "--resume=true", f"--config_path={config}", f"--output_dir={run}", "--steps=3")
    assert "training_step.json is damaged" in said


@pytest.mark.parametrize("text", [SECRET, "[1]", '{"a": 1}\n', "[" * 9999])
def test_attempts_are_appended_to_no_other_file(finished, tmp_path, text):
    """Which the options of a stranger's run may name."""
    run = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True)) / "out"
    (tmp_path / "other").write_text(text)
    saved = json.loads((run / "dagger_config.json").read_text())
    saved["env"]["attempts_file"] = str(tmp_path / "other")
    (run / "dagger_config.json").write_text(json.dumps(saved))
    said = run_in_process(dagger_command, "--resume=true", f"--output_dir={run}", "--num_episodes=4")
    assert "it holds something else than attempts" in said
    assert (tmp_path / "other").read_text() == text


@pytest.mark.parametrize("text", ["{", "[]", "5", "[" * 9999])
def test_damaged_options_are_named(finished, trained, tmp_path, text):
    run = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True)) / "out"
    (run / "dagger_config.json").write_text(text)
    said = run_in_process(dagger_command, "--resume=true", f"--output_dir={run}")
    assert said.startswith(f"error: {run / 'dagger_config.json'} is damaged")
    policy = Path(shutil.copytree(trained, tmp_path / "policy"))
    (policy / "config.json").write_text(text)
    said = run_in_process(video, *ENV, f"--policy.path={policy}", f"--output={tmp_path / 'film.mp4'}")
    assert said.startswith(f"error: {policy / 'config.json'} is damaged")


def test_another_programs_options_in_the_working_directory_are_not_looked_at(tmp_path, monkeypatch):
    (tmp_path / "config.json").write_text("[")
    monkeypatch.chdir(tmp_path)
    said = run_in_process(
        train, *TINY, "--dataset.repo_id=a/b", f"--dataset.root={tmp_path}", f"--output_dir={tmp_path / 'out'}"
    )
    assert said.startswith(f"error: There is no LeRobotDataset in '{tmp_path}'")


@pytest.mark.parametrize("text", ["{", "[]", '{"evil": 1}', "[" * 9999, *ODD_STATES])
def test_a_damaged_state_of_a_run_is_named(finished, tmp_path, text):
    run = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True)) / "out"
    (run / "dagger_state.json").write_text(text)
    with pytest.raises(InputError, match=r"dagger_state\.json is damaged"):
        command("--resume=true", f"--output_dir={run}")


def test_lines_of_figures_that_say_nothing_are_dropped(finished, tmp_path):
    run = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True)) / "out"
    before = (run / "metrics.jsonl").read_text()
    odd = ['{"kind": "x"}', "[1]", '{"kind": ["eval"], "round": 0}', '{"kind": "attempt", "attempt": "a"}', "[" * 9999]
    (run / "metrics.jsonl").write_text("\n".join([*odd, before]) + '{"kind": "attempt", "attempt": 1}\n')
    config = run / "dagger_config.json"  # the original's attempts may be locked by another test's run
    config.write_text(config.read_text().replace(str(finished), str(run.parent)))
    command("--resume=true", f"--output_dir={run}")
    assert (run / "metrics.jsonl").read_text().startswith(before)


# Files that lead to others


@pytest.mark.parametrize("kind", ["hls", "concat"])
def test_a_playlist_is_no_film(tmp_path, secret, kind):
    other, path = tmp_path / "other.mp4", tmp_path / "file-000.mp4"
    film(other)
    lists = {
        "hls": f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{other}\n#EXT-X-ENDLIST\n",
        "concat": f"ffconcat version 1.0\nfile {other}\n",
    }
    path.write_text(lists[kind])
    for read in (picture_times, lambda path: list(video_pictures(path, [0.0], 0.1))):
        with pytest.raises(av.FFmpegError):
            read(path)
    assert len(picture_times(other)) == 5


@pytest.mark.parametrize("codec", [b"zzzz", b"\0\0\0\0", b"mp4a"])
def test_a_film_of_a_codec_that_nobody_knows_is_none(tmp_path, codec):
    path = tmp_path / "file-000.mp4"
    film(path)
    path.write_bytes(path.read_bytes().replace(b"avc1\0", codec + b"\0"))
    for read in (picture_times, lambda path: list(video_pictures(path, [0.0], 0.1))):
        with pytest.raises(av.FFmpegError):
            read(path)


def test_a_name_in_a_film_may_be_no_text(tmp_path):
    path = tmp_path / "file-000.mp4"
    film(path)
    path.write_bytes(path.read_bytes().replace(b"VideoHandler", b"Video\xc6andler"))
    assert len(picture_times(path)) == 5


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("video_path", "videos/{video_key}/{file_index}.m3u8"),
        ("video_path", "videos/{video_key}/{file_index}"),
        ("data_path", "data/{file_index}.csv"),
    ],
)
def test_the_files_of_a_dataset_end_as_lerobots_do(noise, tmp_path, name, value):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    edit_info(root, lambda info: info.update({name: value}))
    with pytest.raises(InputError, match=f"{name} is"):
        check_dataset_files("a/b", root)


@pytest.mark.parametrize("name", ["meta/stats.json", "meta/info.json", "meta/episodes/chunk-000/file-009.parquet"])
@pytest.mark.parametrize("target", ["pipe", "/dev/zero"])
def test_pipes_and_devices_are_not_read(noise, tmp_path, name, target):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (root / name).unlink(missing_ok=True)
    if target == "pipe":
        os.mkfifo(root / name)
    else:
        (root / name).symlink_to(target)
    for read in (check_dataset_files, lambda _, root: survey(root)):
        with pytest.raises(InputError, match="not an ordinary file"):
            read("a/b", root)


@pytest.mark.parametrize("target", ["pipe", "/dev/zero"])
@pytest.mark.parametrize("kind", ["picture", "film"])
def test_pictures_are_read_from_no_pipe_or_device(tmp_path, kind, target):
    root = tmp_path / "set"
    make_dataset(root, (6, 5), use_videos=kind == "film", image_size=16)
    name = f"seen/{CAMERA}/0.mp4" if kind == "film" else "seen/0.png"
    edit_info(root, lambda info: info.update(video_path="seen/{video_key}/{file_index}.mp4"))
    if kind == "picture":
        (path,) = root.glob("data/*/*.parquet")
        edit_column(path, CAMERA, lambda values: [{"bytes": None, "path": name} for _ in values])
    (root / name).parent.mkdir(parents=True)
    if target == "pipe":
        os.mkfifo(root / name)
    else:
        (root / name).symlink_to(target)
    with pytest.raises(InputError, match=r"not an ordinary file|outside its folder"):
        _look(root)


def _look(root: Path) -> None:
    dataset = SurveyedDataset("a/b", survey(root))
    list(dataset.pictures(CAMERA, dataset.episodes[0]))


@pytest.mark.parametrize("name", ["file-001.parquet", "backup.parquet", "file-000 (copy).parquet"])
def test_a_copy_of_frames_beside_them_is_named(noise, tmp_path, name):
    """LeRobot reads every file in `data/`: a row would be another than the one that is asked for."""
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (path,) = root.glob("data/*/*.parquet")
    shutil.copy(path, path.with_name(name))
    said = re.escape(f"data/chunk-000/{name}")
    with pytest.raises(InputError, match=rf"{said}: 38 frames belong to no episode"):
        check_dataset_files("a/b", root)
    assert re.search(rf"{said}: 38 frames belong to no episode", str(survey(root)))
    repair(RepairConfig(root))
    check_dataset_files("a/b", tmp_path / "noise_repaired")


@pytest.mark.parametrize("name", ["dataset_from_index", "dataset_to_index", "length"])
def test_rows_that_number_other_frames_are_refused(noise, tmp_path, name):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (path,) = root.glob("meta/episodes/*/*.parquet")
    edit_column(path, name, lambda values: values[::-1])
    with pytest.raises(InputError, match="the row of episode 0 in meta/episodes is wrong"):
        check_dataset_files("a/b", root)
    assert not survey(root).is_undamaged


@pytest.mark.parametrize(
    "text", ["[]", "5", "{", "[" * 9999, '{"action": 5}', '{"action": {"min": "x"}}', '{"action": {"min": {}}}']
)
def test_statistics_that_are_none_are_named(noise, tmp_path, text):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (root / "meta/stats.json").write_text(text)
    with pytest.raises(InputError, match=r"stats\.json cannot be read: .*playbyear-repair"):
        check_dataset_files("a/b", root)
    findings = inspect(InspectConfig(InspectDatasetConfig("a/b", str(root))))
    assert [each.check for each in findings if each.level == "error"] == ["statistics"]


@pytest.mark.parametrize(("name", "value"), [("chunks_size", 0), ("chunks_size", -1), ("features", 5)])
def test_what_a_dataset_cannot_say_of_itself_is_named(noise, tmp_path, name, value):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    edit_info(root, lambda info: info.update({name: value}))
    with pytest.raises(InputError, match=rf"info\.json is damaged: {name} is {value}"):
        survey(root)


@pytest.mark.parametrize(("name", "value"), [("video_info", 5), ("info", "x"), ("shape", "x")])
def test_what_a_dataset_cannot_say_of_a_camera_is_named(noise, tmp_path, name, value):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    edit_info(root, lambda info: info["features"][CAMERA].update({name: value}))
    with pytest.raises(InputError, match=f"the feature '{CAMERA}' has {name} {value!r}"):
        survey(root)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        *(("timestamp", {"dtype": "int64"}), ("index", {"dtype": "string"}), ("task_index", {"dtype": "float32"})),
        *(("frame_index", {"shape": [2]}), ("episode_index", {"dtype": None})),
    ],
)
def test_what_numbers_the_frames_is_one_number_in_each(noise, tmp_path, name, changes):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    edit_info(root, lambda info: info["features"][name].update(changes))
    with pytest.raises(InputError, match=f"the feature '{name}' is missing, or not one"):
        survey(root)


def test_lists_longer_than_there_can_be_are_refused(noise, tmp_path):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    edit_info(root, lambda info: info["features"]["action"].update(shape=[2**31]))
    with pytest.raises(InputError, match="LeRobot knows no such feature"):
        survey(root)


@pytest.mark.parametrize("name", ["index", "task_index"])
def test_numbers_of_frames_that_are_not_whole_are_refused(noise, tmp_path, name):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (path,) = root.glob("data/*/*.parquet")
    edit_column(path, name, lambda values: [float("nan"), *values[1:]])
    assert f"its column '{name}' is double; wanted int64" in str(survey(root))


def test_columns_that_only_look_like_statistics_are_left_alone(noise, tmp_path):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (path,) = root.glob("meta/episodes/*/*.parquet")
    table = pq.read_table(path)
    pq.write_table(table.append_column("stats/x", pa.array(["x"] * len(table))), path)
    assert survey(root).is_undamaged
    (root / "meta/stats.json").unlink()
    repair(RepairConfig(root))
    assert survey(tmp_path / "noise_repaired").is_undamaged


@pytest.mark.parametrize("key", ["observation.state", "action", MICROPHONE])
@pytest.mark.parametrize("kind", [pa.large_string(), pa.binary(), pa.time64("us"), pa.list_(pa.float32())])
def test_columns_without_numbers_are_not_reckoned_with(noise, tmp_path, key, kind):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    value: dict[str, tuple[object, list[int]]] = {
        "binary": (b"x", [1]),
        "time64[us]": (5, [1]),
        "large_string": ("x", [1]),
    }
    one, shape = value.get(str(kind), ([], [0]))
    dtype = str(kind) if shape == [1] else "float32"
    edit_info(root, lambda info: info["features"][key].update(dtype=dtype, shape=shape))
    (path,) = root.glob("data/*/*.parquet")
    table = pq.read_table(path).replace_schema_metadata({})
    column = pa.array([one] * len(table), kind)
    pq.write_table(table.set_column(table.column_names.index(key), key, column), path)
    findings = inspect(InspectConfig(InspectDatasetConfig("a/b", str(root))))
    assert ([each.feature for each in findings if each.check == "columns"] == [key]) is (key == MICROPHONE)


@pytest.mark.parametrize("number", [-1, 7])
def test_frames_of_a_task_without_a_text_are_refused_before_they_are_learned_from(noise, tmp_path, number):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (path,) = root.glob("data/*/*.parquet")
    edit_column(path, "task_index", lambda values: [number, *values[1:]])
    with pytest.raises(InputError, match=f"are of task {number}, which has no text"):
        EpisodeStore.from_dataset(DatasetReader("a/b", root), device="cpu", keys=["action"])


def test_a_data_file_that_may_not_be_read_is_one_error_of_training(noise, tmp_path, monkeypatch):
    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("lerobot_playbyear.datasets.survey.DataFile", refuse)
    options = ("--dataset.repo_id=a/b", f"--dataset.root={noise}", f"--output_dir={tmp_path / 'out'}")
    assert "Permission denied" in str(run_in_process(train, *TINY, *options))


@pytest.mark.parametrize("name", ["index", "timestamp", "task_index"])
def test_texts_in_place_of_numbers_are_refused(noise, tmp_path, name):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (path,) = root.glob("data/*/*.parquet")
    table = pq.read_table(path).replace_schema_metadata({})
    texts = pa.array([str(value) for value in table.column(name).to_pylist()])
    pq.write_table(table.set_column(table.column_names.index(name), name, texts), path)
    with pytest.raises(InputError, match=f"its column '{name}' is string; wanted"):
        check_dataset_files("a/b", root)
    assert f"its column '{name}' is string; wanted" in str(survey(root))


def test_two_columns_of_one_name_are_refused(noise, tmp_path):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (path,) = root.glob("data/*/*.parquet")
    table = pq.read_table(path).replace_schema_metadata({})
    pq.write_table(table.append_column("action", table.column("action")), path)
    with pytest.raises(InputError, match="one comes twice"):
        check_dataset_files("a/b", root)
    assert "one comes twice" in str(survey(root))


@pytest.mark.parametrize("name", ["episode_index", "length", "dataset_to_index", "data/file_index"])
@pytest.mark.parametrize("value", [None, "x"])
def test_rows_without_whole_numbers_are_refused(noise, tmp_path, name, value):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (path,) = root.glob("meta/episodes/*/*.parquet")
    table = pq.read_table(path).replace_schema_metadata({})
    values = pa.array([value] * len(table), pa.string() if value else pa.int64())
    pq.write_table(table.set_column(table.column_names.index(name), name, values), path)
    said = {"episode_index": "names no episode", "data/file_index": "its frames are in .*, not in None"}
    wrong = said.get(name, f"its {name} is {value!r}; wanted 12")
    with pytest.raises(InputError, match=rf"meta/episodes.* {wrong}.*playbyear-repair"):
        check_dataset_files("a/b", root)
    assert not survey(root).is_undamaged


# What a checkpoint runs


FETCHES = {"registry_name": "action_tokenizer_processor", "config": {"action_tokenizer_name": "stranger/evil"}}


@pytest.mark.parametrize(("file", "step"), [("policy_preprocessor.json", None), ("policy_postprocessor.json", FETCHES)])
def test_a_checkpoint_runs_no_program(recorded, trained, tmp_path, file, step):
    """Neither one that it names, nor one that LeRobot's step for tokens would fetch from the Hub."""
    checkpoint, ran = Path(shutil.copytree(trained, tmp_path / "policy")), tmp_path / "ran"
    saved = json.loads((checkpoint / file).read_text())
    saved["steps"].insert(0, step or {"class": "subprocess.Popen", "config": {"args": ["touch", str(ran)]}})
    (checkpoint / file).write_text(json.dumps(saved))
    data = ("--dataset.repo_id=tests/demos", f"--dataset.root={recorded}", "--steps=1")
    resumed = (f"--policy.path={checkpoint}", "--policy.push_to_hub=false", f"--output_dir={tmp_path / 'out'}")
    filmed = (*ENV, f"--policy.path={checkpoint}", f"--output={tmp_path / 'film.mp4'}")
    for said in (run_in_process(train, *data, *resumed, "--num_workers=0"), run_in_process(video, *filmed)):
        assert "names a class to import or runs programs from the Hub" in str(said)
    assert not ran.exists()


def test_policies_that_fetch_programs_are_known():
    folder = Path(lerobot.policies.__file__).parent
    found = [path for path in folder.rglob("*.py") if re.search(r"trust_remote_code\W+True", path.read_text())]
    assert {path.relative_to(folder).parts[0] for path in found} == set(RUN_PROGRAMS)
    with pytest.raises(InputError, match="type groot run programs from the Hub; nothing was loaded"):
        check_type("groot")


def test_a_checkpoint_that_cannot_be_had_now_is_not_one_without_processors(hub):
    hub.fault = lambda *_: "cut"
    with pytest.raises(InputError, match=r"cannot be had from the Hub now .*: nothing was loaded"):
        check_steps("tester/policy")


@pytest.mark.parametrize("text", ["{", "[]", "[" * 9999, '{"steps": [1]}'])
def test_damaged_processors_are_named(trained, tmp_path, text):
    checkpoint = Path(shutil.copytree(trained, tmp_path / "policy"))
    (checkpoint / "policy_preprocessor.json").write_text(text)
    with pytest.raises(InputError, match=r"policy_preprocessor\.json is not a processor of LeRobot's"):
        check_steps(checkpoint)


def test_pipes_in_a_checkpoint_or_a_run_hold_nobody_up(trained, finished, tmp_path):
    checkpoint = Path(shutil.copytree(trained, tmp_path / "policy"))
    state = next(checkpoint.glob("policy_preprocessor_*.safetensors"))
    state.unlink()
    os.mkfifo(state)
    run = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True)) / "out"
    (run / "metrics.jsonl").unlink(missing_ok=True)
    os.mkfifo(run / "metrics.jsonl")
    with pytest.raises(InputError, match=f"{state.name}' is a pipe or a device; nothing was loaded"):
        check_steps(checkpoint)
    with pytest.raises(InputError, match=r"metrics\.jsonl' is a pipe or a device, no file"):
        command("--resume=true", f"--output_dir={run}")


def test_what_is_no_part_of_a_checkpoint_is_not_uploaded(trained, tmp_path, here):
    checkpoint = Path(shutil.copytree(trained, tmp_path / "policy"))
    for name in ("notes.json", "notes.yaml", "secret.safetensors"):
        (checkpoint / name).write_text(SECRET)
    push_policy(checkpoint, "me/policy", PushOptions())
    names = set(here.model("me/policy").files())
    assert {"config.json", "model.safetensors", "policy_preprocessor.json", "train_config.json"} <= names
    assert not [name for name in names if "notes" in name or "secret" in name]


# Two at once, and copies


def test_two_commands_do_not_write_one_output(tmp_path):
    target = tmp_path / "out"
    with new_folder(target) as first:
        (first / "data").write_text("first")
        with pytest.raises(FolderLockedError, match=f"Another process is writing {target}"), new_folder(target):
            pass
        assert (first / "data").read_text() == "first"
    assert (target / "data").read_text() == "first"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_many_that_want_one_output_make_it_once(tmp_path):
    made, start = [], threading.Barrier(4)

    def write(number: int) -> None:
        start.wait()
        try:
            with new_folder(tmp_path / "out") as folder:
                for name in range(20):
                    (folder / str(name)).write_text(str(number))
            made.append(number)
        except (OSError, FolderLockedError):  # the others come at the same time, or later
            pass

    for _ in range(10):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        made.clear()
        threads = [threading.Thread(target=write, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(made) == 1
        assert {path.read_text() for path in (tmp_path / "out").iterdir()} == {str(made[0])}
        assert len(list((tmp_path / "out").iterdir())) == 20


def test_a_copy_shares_no_file_with_its_original(tmp_path):
    """LeRobot may write into a film that is there: where its folder for new ones is on another disk."""
    root = tmp_path / "set"
    make_dataset(root, (6, 5), use_videos=True, image_size=16)
    for episode in range(2):
        write_audio(tmp_path / f"{episode}.wav", np.zeros(16000, np.int16), 16000)
    places = DatasetPlace("a/b", str(root)), DatasetPlace("a/c", str(tmp_path / "copy"))
    attach_audio(AttachAudioConfig(*places, files=str(tmp_path / "{episode}.wav"), microphone="new"))
    (root / "meta/stats.json").unlink()
    repair(RepairConfig(root))
    originals = {path.stat().st_ino for path in root.rglob("*") if path.is_file()}
    for copy in (tmp_path / "copy", tmp_path / "set_repaired"):
        assert list(copy.rglob("*.mp4"))
        assert not [path for path in copy.rglob("*") if path.stat().st_ino in originals]


# Small files that ask for everything


def test_small_tables_of_many_rows_take_no_memory(noise, tmp_path):
    """Half a million equal rows of episodes fill a megabyte, and 4 GiB once they are read."""
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (path,) = root.glob("meta/episodes/*/*.parquet")
    table = pq.read_table(path).slice(0, 1)
    small = table.select([name for name in table.column_names if not name.startswith("stats/")])
    pq.write_table(small.take([0] * 500_000), path)
    assert path.stat().st_size < 3e6
    found = survey(root)
    assert "rows of 500,000 episodes, and there are 38 frames" in str(found)
    assert found.whole


@pytest.mark.slow
def test_a_small_file_of_many_pieces_takes_no_time(noise, tmp_path):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (path,) = root.glob("data/*/*.parquet")
    table = pq.read_table(path).slice(0, 1)
    pq.write_table(table.take([0] * 20_500), path)
    assert path.stat().st_size < 3e6
    assert "20,500 pieces of episodes" in str(survey(root))


def test_a_small_table_of_many_tasks_takes_no_memory_that_is_not_there(noise, tmp_path, monkeypatch):
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    path = root / "meta/tasks.parquet"
    pq.write_table(pq.read_table(path).take(np.zeros(2_000_000, int)), path)
    assert path.stat().st_size < 1e6
    monkeypatch.setattr("lerobot_playbyear.datasets.parquet.available_memory", lambda: 2**26)
    for read in (check_dataset_files, lambda _, root: survey(root)):
        with pytest.raises(MemoryError, match="values in one piece"):
            read("a/b", root)


@pytest.mark.parametrize("is_list", [False, True])
def test_a_long_text_in_many_rows_takes_no_memory_that_is_not_there(noise, tmp_path, monkeypatch, is_list):
    """Once in a file of a few kilobytes, and in every row once it is read."""
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    texts = pa.DictionaryArray.from_arrays(pa.array(np.zeros(1500, np.int32)), pa.array(["x" * 2**20]))
    column = pa.ListArray.from_arrays(range(1501), texts) if is_list else texts
    options = {"store_schema": False, "dictionary_pagesize_limit": 2**28, "write_statistics": False}
    pq.write_table(pa.table({"task": column}), root / "meta/tasks.parquet", compression="zstd", **options)
    assert (root / "meta/tasks.parquet").stat().st_size < 1e4
    monkeypatch.setattr("lerobot_playbyear.datasets.parquet.available_memory", lambda: 2**30)
    with pytest.raises(MemoryError, match=r"holds texts in one piece, which take 1\.5 GiB"):
        check_dataset_files("a/b", root)


def test_memory_that_runs_out_while_the_tasks_are_read_is_no_damage(noise, monkeypatch):
    def fail(_: Path) -> None:
        raise pa.ArrowMemoryError("malloc of size 4194304 failed")

    monkeypatch.setattr("lerobot_playbyear.datasets.survey.read_table", fail)
    with pytest.raises(MemoryError, match="malloc"):
        survey(noise)


@pytest.mark.parametrize("part", ["meta/episodes", "data"])
def test_long_lists_of_equal_numbers_take_no_memory_that_is_not_there(noise, tmp_path, monkeypatch, part):
    """Twenty million zeros fill a few kilobytes."""
    root = Path(shutil.copytree(noise, tmp_path / "noise"))
    (path,) = root.glob(f"{part}/*/*.parquet")
    table = pq.read_table(path).replace_schema_metadata({})
    name = next(name for name in table.column_names if "action" in name)
    length = 20_000_000 // len(table)
    zeros = pa.ListArray.from_arrays(
        np.arange(len(table) + 1) * length, pa.array(np.zeros(len(table) * length, np.float32))
    )
    pq.write_table(table.set_column(table.column_names.index(name), name, zeros), path, compression="zstd")
    assert path.stat().st_size < 1e6
    monkeypatch.setattr("lerobot_playbyear.datasets.parquet.available_memory", lambda: 2**26)
    for read in (check_dataset_files, lambda _, root: survey(root)):
        with pytest.raises(MemoryError, match="values in one piece"):
            read("a/b", root)


@pytest.mark.parametrize(
    ("name", "value"),
    [("hidden_size", 10**6), ("n_memory_steps", 10**8), ("vision_width", 3000), ("audio_window_s", 1e6)],
)
def test_a_checkpoint_does_not_ask_for_all_memory(trained, tmp_path, name, value):
    policy = Path(shutil.copytree(trained, tmp_path / "policy"))
    saved = json.loads((policy / "config.json").read_text())
    (policy / "config.json").write_text(json.dumps({**saved, name: value}))
    said = run_in_process(video, *ENV, f"--policy.path={policy}", f"--output={tmp_path / 'film.mp4'}")
    assert re.search(rf"--policy\.{name} must be (at least 1 and )?at most", said)


def test_a_checkpoint_does_not_claim_a_state_of_a_billion_numbers(trained, tmp_path):
    policy = Path(shutil.copytree(trained, tmp_path / "policy"))
    saved = json.loads((policy / "config.json").read_text())
    saved["input_features"]["observation.state"]["shape"] = [10**9]
    (policy / "config.json").write_text(json.dumps(saved))
    said = run_in_process(video, *ENV, f"--policy.path={policy}", f"--output={tmp_path / 'film.mp4'}")
    assert "wanted at most 65536 numbers" in said


@pytest.mark.parametrize("data", [b"", (2**62).to_bytes(8, "little") + b"{}", b"\x02" + bytes(7) + b"{}" + b"x" * 9])
def test_damaged_weights_are_named(trained, tmp_path, data):
    policy = Path(shutil.copytree(trained, tmp_path / "policy"))
    (policy / "model.safetensors").write_bytes(data)
    said = run_in_process(video, *ENV, f"--policy.path={policy}", f"--output={tmp_path / 'film.mp4'}")
    assert f"{policy / 'model.safetensors'} is missing or damaged" in said
