"""Damaged datasets: the copy has what is whole, bit for bit, and passes inspection; the dataset itself stays as it is."""

import json
import os
import shutil
import signal
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image
from recording_factory import (
    CAMERA,
    FEATURES,
    FILM,
    FPS,
    REPO_ID,
    RICH_FEATURES,
    TASKS,
    differences,
    episode_frames,
    load,
)
from support.recording import ENCODER, edit_column, edit_info, everything, write
from support.shared import run_in_process

from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.audio.attach_audio import AttachAudioConfig, DatasetPlace, attach_audio
from lerobot_playbyear.datasets import episode_files
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.info import OutsideError
from lerobot_playbyear.datasets.journal import lock_dataset
from lerobot_playbyear.datasets.reader import SurveyedDataset
from lerobot_playbyear.datasets.survey import DatasetDamagedError, survey
from lerobot_playbyear.hub.push import push_dataset
from lerobot_playbyear.inspection.inspect import InspectConfig, InspectDatasetConfig, inspect
from lerobot_playbyear.repair import footers
from lerobot_playbyear.repair.repair import RepairReport, repair_dataset
from lerobot_playbyear.scripts.commands import repair as repair_command

N_EPISODES = 6
EPISODES, TASKS_TABLE = "meta/episodes/chunk-000/file-000.parquet", "meta/tasks.parquet"
INFO, STATS = "meta/info.json", "meta/stats.json"


def dropped(report: RepairReport) -> set[int]:
    """The numbers of the episodes that are not in the copy."""
    return {episode.number for episode in report.survey.episodes} - set(report.kept)


def write_lerobots(root: Path, features: dict[str, Any]) -> LeRobotDataset:
    """A recording with plain LeRobot that goes on: its files have no end yet."""
    dataset = LeRobotDataset.create(REPO_ID, FPS, features, root=root, video_backend="pyav", rgb_encoder=ENCODER)
    for number in range(N_EPISODES):
        for frame in episode_frames(number, features):
            dataset.add_frame(frame)
        dataset.save_episode(parallel_encoding=False)
    return dataset


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> dict[str, tuple[Path, dict[str, Any]]]:
    """Datasets to be damaged: of ours in several files and in one, of LeRobot's, and one that was killed."""
    folder = tmp_path_factory.mktemp("originals")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(episode_files, "SMALL_DATA_BYTES", 20_000)
        write(folder / "ours", range(N_EPISODES), RICH_FEATURES)
    write(folder / "one file", range(N_EPISODES))
    dataset = write_lerobots(folder / "lerobot", RICH_FEATURES)
    shutil.copytree(folder / "lerobot", folder / "killed")  # as SIGKILL leaves it
    dataset.finalize()
    return {
        "ours": (folder / "ours", RICH_FEATURES),
        "one file": (folder / "one file", FEATURES),
        "lerobot": (folder / "lerobot", RICH_FEATURES),
        "killed": (folder / "killed", RICH_FEATURES),
    }


@pytest.fixture
def copy(originals, tmp_path) -> Callable[[str], Path]:
    """Makes a copy of one of the datasets to be damaged."""
    return lambda name: Path(shutil.copytree(originals[name][0], tmp_path / "place" / "dataset"))


def files(root: Path) -> list[Path]:
    return sorted(path for path in root.rglob("*") if path.is_file())


def truncate(path: Path, share: float = 0.3) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 64
    path.write_bytes(data)


def change(path: Path, column: str, row: int, value: Any) -> None:
    edit_column(path, column, lambda values: [*values[:row], value, *values[row + 1 :]])


def change_info(root: Path, **fields: Any) -> None:
    edit_info(root, lambda info: info.update(fields))


def write_tasks(root: Path, *texts: str) -> None:
    table = pd.DataFrame({"task_index": range(len(texts))}, index=pd.Index(texts, name="task"))
    table.to_parquet(root / TASKS_TABLE)


def episodes_in(root: Path, name: Path) -> set[int]:
    """The episodes whose frames or pictures are in a file."""
    if name.parts[0] == "data":
        return set(pq.read_table(root / name, columns=["episode_index"]).column(0).to_pylist())
    if name.parts[0] == "videos":
        rows = [row for path in root.glob("meta/episodes/*/*") for row in pq.read_table(path).to_pylist()]
        numbers = tuple(int(part.rsplit("-", 1)[-1]) for part in name.with_suffix("").parts[-2:])
        keys = [f"videos/{FILM}/{what}_index" for what in ("chunk", "file")]
        return {row["episode_index"] for row in rows if tuple(row[key] for key in keys) == numbers}
    return set()


def repaired(root: Path, features: dict[str, Any], lost: Collection[int] = (), **options: Any) -> RepairReport:
    """Repairs a dataset: it stays as it is, and the copy is whole, holds what the report says and passes inspection."""
    before = everything(root)
    report = repair_dataset(root, **options)
    assert everything(root) == before
    assert report.target is not None, str(report)
    assert report.is_done, str(report)
    assert bool(dropped(report)) == bool(lost), str(report)
    assert all(number in lost for number in dropped(report)), str(report)
    assert survey(report.target).is_undamaged
    dataset = load(report.target)
    assert dataset.num_episodes == len(report.kept)
    assert dataset.num_frames == len(dataset.hf_dataset) == dataset.meta.episodes[-1]["dataset_to_index"]
    assert not differences(dataset, {new: old for old, new in report.kept.items()}, features)
    verdicts = inspect(InspectConfig(InspectDatasetConfig(REPO_ID, str(report.target))))
    wrong = [
        verdict for verdict in verdicts if verdict.level == "error" and verdict.check not in ("clipping", "silence")
    ]
    assert not wrong
    return report


def test_a_sound_dataset_is_left_alone(copy):
    for name in ("ours", "one file", "lerobot"):
        root = copy(name)
        before = everything(root)
        report = repair_dataset(root)
        assert (report.is_done, report.target) == (True, None)
        assert "6 episodes, nothing wrong" in str(report)
        assert everything(root) == before
        assert [path.name for path in root.parent.iterdir()] == ["dataset"]
        shutil.rmtree(root)


def test_a_recording_that_lerobot_could_not_finish_is_whole_again(copy, originals):
    """And goes on, in the copy; what was killed is not continued."""
    root = copy("killed")
    with pytest.raises(DatasetDamagedError, match=r"(?s)no meta/episodes.*playbyear-repair --root="):
        write(root, [N_EPISODES], RICH_FEATURES)
    report = repaired(root, RICH_FEATURES)
    assert "no valid end" in str(report)
    stats, finished = load(report.target).meta.stats, load(originals["lerobot"][0]).meta.stats
    for key, own in finished.items():
        for name, value in own.items():
            if not key.startswith("observation.audio"):  # which LeRobot has per sample
                tolerance = 0.02 if key == FILM else 1e-6  # the film's from what was encoded
                np.testing.assert_allclose(stats[key][name], value, atol=tolerance, err_msg=key)
    write(report.target, [N_EPISODES], RICH_FEATURES)
    assert not differences(load(report.target), {n: n for n in range(N_EPISODES + 1)}, RICH_FEATURES)


@pytest.mark.parametrize(
    ("folder", "how"), [("data", truncate), ("data", flip), ("data", Path.unlink), ("videos", truncate)]
)
def test_what_is_lost_takes_only_its_episodes_with_it(copy, folder, how):
    """The second file holds episodes from the middle of the dataset; those after it move up."""
    root = copy("ours")
    path = files(root / folder)[1]
    hit = episodes_in(root, path.relative_to(root))
    assert 0 < len(hit) < N_EPISODES
    how(path)
    report = repaired(root, RICH_FEATURES, lost=hit)
    assert "Renumbered" in str(report)


@pytest.mark.parametrize(
    ("victim", "name", "how"),
    [
        (STATS, "ours", Path.unlink),
        (TASKS_TABLE, "lerobot", truncate),
        ("meta/episodes", "ours", Path.unlink),
        ("meta/episodes", "lerobot", truncate),
    ],
)
def test_tables_that_are_lost_are_made_anew(copy, originals, victim, name, how):
    root = copy(name)
    for path in files(root / victim) or [root / victim]:
        how(path)
    report = repaired(root, RICH_FEATURES)
    stats, original = load(report.target).meta.stats, load(originals[name][0]).meta.stats
    assert stats.keys() == original.keys()
    np.testing.assert_allclose(stats["action"]["q90"], original["action"]["q90"], atol=1e-6)


def test_all_else_is_in_the_copy_as_it_was(copy):
    root = copy("ours")
    change_info(root, robot_type="arm", licence="CC-BY", splits={"train": "0:4", "val": "4:6"})
    tasks = pd.read_parquet(root / TASKS_TABLE)
    tasks["difficulty"] = ["easy", "hard"]
    tasks.to_parquet(root / TASKS_TABLE)
    rows = pq.read_table(root / EPISODES)
    pq.write_table(
        rows.append_column("operator", pa.array([f"person {n}" for n in range(N_EPISODES)])), root / EPISODES
    )
    others = ("meta/modality.json", "README.md", "notes/day 1.txt", "data/source.txt", "images/plot.png")
    for name in (*others, f"images/{CAMERA}/episode-000006/frame-000000.png"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(name)
    lost = files(root / "data")[1]
    hit = episodes_in(root, lost.relative_to(root))
    lost.unlink()
    target = repaired(root, RICH_FEATURES, lost=hit).target
    assert all((target / name).read_text() == name for name in others)
    assert not (target / "images" / CAMERA).exists()  # of an episode that was not saved
    info = json.loads((target / INFO).read_text())
    assert (info["robot_type"], info["licence"], info["splits"]) == (
        "arm",
        "CC-BY",
        {"train": f"0:{N_EPISODES - len(hit)}"},
    )
    assert pd.read_parquet(target / TASKS_TABLE)["difficulty"].tolist() == ["easy", "hard"]
    kept = [f"person {n}" for n in range(N_EPISODES) if n not in hit]
    assert pq.read_table(target / EPISODES).column("operator").to_pylist() == kept


def test_without_its_features_a_dataset_needs_one_that_is_like_it(copy, originals, capsys):
    root = copy("ours")
    (root / INFO).write_text("{")
    with pytest.raises(DatasetDamagedError, match=r"info\.json is damaged.*--like="):
        repair_dataset(root)
    assert "made from that of" in str(repaired(root, RICH_FEATURES, like=originals["lerobot"][0]))
    for text in ("[]", "{}", '{"features": 1}'):
        (root / INFO).write_text(text)
        assert "info.json is damaged" in str(run_in_process(repair_command, f"--root={root}", f"--like={root}"))


def test_features_that_the_files_do_not_have_are_not_believed(copy, originals):
    root = copy("one file")
    text = (root / INFO).read_text()
    (root / INFO).write_text(text.replace('"action"', '"cction"'))
    with pytest.raises(DatasetDamagedError, match=r"(?s)its columns are not .*: action, cction.*No whole episode"):
        repair_dataset(root)
    repaired(root, FEATURES, like=originals["one file"][0])


# What contradicts itself


@pytest.mark.parametrize(
    ("path", "changes"),
    [
        ("data/chunk-000/file-000.parquet", [("index", 8, 4000)]),
        (EPISODES, [("length", 1, 64), ("dataset_to_index", 2, 64), ("data/file_index", 3, 3)]),
        (EPISODES, [("episode_index", 1, 0), ("stats/action/mean", 1, [None] * 4), ("stats/action/mean", 2, None)]),
        (EPISODES, [(f"videos/{FILM}/from_timestamp", 2, 64.0), (f"videos/{FILM}/chunk_index", 1, -1)]),
        (EPISODES, [(f"videos/{FILM}/to_timestamp", 2, float("nan")), (f"videos/{FILM}/file_index", 1, float("inf"))]),
    ],
)
def test_a_number_that_disagrees_with_the_frames_costs_no_episode(copy, path, changes):
    root = copy("lerobot")
    for column, row, value in changes:
        change(root / path, column, row, value)
    repaired(root, RICH_FEATURES)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("fps", 30, "timestamps are not frame / fps at 30 frames per second. If they are right, correct fps"),
        ("sample_rate", 1602, "Correct it in meta/info.json"),
    ],
)
def test_what_only_a_person_can_decide_is_named_and_left(copy, field, value, said):
    root = copy("one file")
    notes = (
        (lambda info: info) if field == "fps" else lambda info: info["features"]["observation.audio.gripper"]["info"]
    )
    edit_info(root, lambda info: notes(info).update({field: value}))
    report = repair_dataset(root)
    assert (report.target, report.is_done) == (None, False)
    assert said in str(report)
    (root / STATS).unlink()
    report = repair_dataset(root)  # what can be made good is
    assert report.target is not None
    assert "What is left to be done in the copy" in str(report)
    assert run_in_process(repair_command, f"--root={root}", f"--output={root.parent / 'other'}") == 1


def test_tasks_are_named_by_what_says_so_alone(copy):
    root = copy("lerobot")
    write_tasks(root, "Grasp the cubf.", TASKS[1])
    report = repair_dataset(root)
    assert (report.target, report.is_done) == (None, True)  # somebody may have renamed it
    assert f"task 0 reads 'Grasp the cubf.'; the rows of episodes 0, 2, 4 say {TASKS[0]!r}" in str(report)
    (root / TASKS_TABLE).unlink()
    change(root / EPISODES, "tasks", 2, ["Grasp the cubf."])
    target = repair_dataset(root).target
    assert pd.read_parquet(target / TASKS_TABLE).index.tolist() == ["unknown task 0", TASKS[1]]
    write_tasks(root, TASKS[0])
    assert "frames are of task 1, which has no text. Put a table from a copy" in str(survey(root))


def test_no_episode_gets_the_pictures_of_another(copy):
    """The rows that say where they are lost, and one film: the next film is as good as the one that is gone."""
    root = copy("ours")
    shutil.rmtree(root / "meta/episodes")
    files(root / "videos" / FILM)[1].unlink()
    report = repair_dataset(root)
    assert report.kept == {0: 0}
    assert not differences(load(report.target), {0: 0}, RICH_FEATURES)


def test_data_files_that_lerobot_reads_in_another_order_are_damage(copy):
    root = copy("ours")
    renamed = {path: path.with_name(f"file-{4 * n + 6}.parquet") for n, path in enumerate(files(root / "data"))}
    assert sorted(renamed.values()) != [*renamed.values()]  # 10 comes before 6
    for path, new in renamed.items():
        path.rename(new)
    change_info(root, data_path="data/chunk-{chunk_index:03d}/file-{file_index}.parquet")
    edit_column(root / EPISODES, "data/file_index", lambda numbers: [4 * n + 6 for n in numbers])
    assert "not in the order of their frames" in str(survey(root, thorough=False))
    repaired(root, RICH_FEATURES)


def test_episodes_that_take_turns_in_two_data_files_are_put_in_order(copy):
    root = copy("one file")
    (path,) = files(root / "data")
    table = pq.read_table(path)
    is_odd = np.array(table.column("episode_index")) % 2 == 1
    for number, own in enumerate((~is_odd, is_odd)):
        pq.write_table(table.filter(pa.array(own)), path.with_name(f"file-00{number}.parquet"))
    edit_column(root / EPISODES, "data/file_index", lambda _: [n % 2 for n in range(N_EPISODES)])
    assert "not in the order of their frames" in str(survey(root, thorough=False))
    repaired(root, FEATURES)


def test_pictures_in_files_are_read_in_the_folder_alone(copy):
    root = copy("one file")
    (path,) = files(root / "data")
    (root / EPISODES).write_bytes(b"lost")
    Image.new("RGB", (16, 16), (9, 8, 7)).save(root / "picture.png")
    for name in ("../private.png", "picture.png"):
        edit_column(path, CAMERA, lambda rows, name=name: [{"bytes": None, "path": name}] * len(rows))
        if name.startswith(".."):
            Image.new("RGB", (16, 16)).save(root / name)
            with pytest.raises(OutsideError):
                repair_dataset(root)
    rows = pq.read_table(repair_dataset(root).target / EPISODES)
    assert np.allclose(np.ravel(rows.column(f"stats/{CAMERA}/max")[0].as_py()) * 255, [9, 8, 7])


def test_pictures_where_lerobot_writes_them_come_along_and_those_of_an_unsaved_episode_do_not(copy, tmp_path, here):
    root, audio = copy("one file"), tmp_path / "{episode}.wav"
    (path,) = files(root / "data")
    rows = range(pq.read_metadata(path).num_rows)
    names = [f"images/{CAMERA}/episode-000000/frame-{row:06d}.png" for row in rows]
    edit_column(path, CAMERA, lambda _: [{"bytes": None, "path": f"./{name}"} for name in names])
    (root / names[0]).parent.mkdir(parents=True)
    for name in (*names, left := f"images/{CAMERA}/frame-000000.png"):
        Image.new("RGB", (16, 16), (9, 8, 7)).save(root / name)
    for episode in range(N_EPISODES):
        write_audio(Path(str(audio).format(episode=episode)), np.zeros(8000, np.int16), 8000)
    places = DatasetPlace("a/b", str(root)), DatasetPlace("a/c", str(tmp_path / "with sound"))
    attach_audio(AttachAudioConfig(*places, files=str(audio), microphone="new"))
    push_dataset("me/pictures", root)
    (root / EPISODES).write_bytes(b"lost")
    for target in (tmp_path / "with sound", repair_dataset(root).target):
        dataset = SurveyedDataset.open("a/b", target)
        assert (next(dataset.pictures(CAMERA, dataset.episodes[-1]))[0, 0] == (9, 8, 7)).all()
        assert not (target / left).exists()
    there = here.dataset("me/pictures").files()
    assert {name for name in there if name.startswith("images/")} == set(names)


def test_a_file_of_many_small_pages_takes_no_time(tmp_path, monkeypatch):
    """What does not fit together is not tried with every number of rows that there could be."""
    path, tried, real = tmp_path / "file.parquet", [], footers._columns
    pq.write_table(pa.table({"a": range(3000)}), path, data_page_size=1, write_batch_size=1, use_dictionary=False)
    path.write_bytes(path.read_bytes()[:-8])
    monkeypatch.setattr(footers, "_columns", lambda *args: tried.append(args) or real(*args))
    assert footers.rescue(path, pa.schema({"a": pa.int64(), "b": pa.list_(pa.int64(), 2**20)})) is None
    assert len(tried) == 1000


# Where the copy is written


@pytest.mark.parametrize("step", ["write_json", "flush_all", "rename"])
def test_a_repair_that_was_killed_leaves_the_dataset_and_no_half_copy(copy, monkeypatch, step):
    from lerobot_playbyear.datasets import files as disk
    from lerobot_playbyear.repair import copy as copying

    root = copy("one file")
    (root / TASKS_TABLE).unlink()
    before = everything(root)
    child = os.fork()
    if child == 0:
        place = {"write_json": copying, "flush_all": disk, "rename": disk.os}[step]
        monkeypatch.setattr(place, step, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        repair_dataset(root)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert everything(root) == before
    assert [path.name for path in sorted(root.parent.glob("*dataset*"))] == [
        ".dataset_repaired.lock",
        ".dataset_repaired.partial",
        "dataset",
    ]
    repaired(root, FEATURES)
    assert [path.name for path in sorted(root.parent.glob("*dataset*"))] == ["dataset", "dataset_repaired"]


def test_nothing_is_written_where_something_is_or_while_somebody_writes(copy):
    root = copy("one file")
    (root / TASKS_TABLE).unlink()
    lock = lock_dataset(root)
    with pytest.raises(InputError, match="Another process"):
        repair_dataset(root)
    lock.close()
    (root.parent / "dataset_repaired").mkdir()
    with pytest.raises(InputError, match=r"--output=.*is there already"):
        repair_dataset(root)
    assert repair_dataset(root, root.parent / "other").target == root.parent / "other"


def test_no_copy_holds_what_a_link_leads_to(copy, tmp_path):
    root = copy("one file")
    (root / TASKS_TABLE).unlink()
    (root / "meta/loop").symlink_to("..")
    shutil.move(root / "data", tmp_path / "elsewhere")
    (root / "data").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutsideError, match=r"data' is a link to"):
        repair_dataset(root)
    (root / "data").unlink()
    shutil.move(tmp_path / "elsewhere", root / "data")
    assert not (repaired(root, FEATURES).target / "meta/loop").exists()


@pytest.mark.parametrize("name", ["data/chunk-000/file-000.parquet", INFO, TASKS_TABLE, STATS, "meta/episodes"])
def test_a_file_that_is_listed_and_cannot_be_opened_is_not_missing(copy, name):
    """A link to a disk that is not there at the moment stands for what no superuser can open."""
    root = copy("one file")
    (root / name).rename(root.parent / "not there")
    (root / name).symlink_to(root.parent / "elsewhere")
    with pytest.raises(FileNotFoundError) as error:
        repair_dataset(root)
    assert error.value.filename is not None


# Folders of other tools


def test_what_is_no_whole_dataset_is_named_as_such(copy, tmp_path):
    root = copy("one file")
    change_info(root, codebase_version="v2.1")
    with pytest.raises(DatasetDamagedError, match=r"older format v2\.1.*convert_dataset_v21_to_v30"):
        repair_dataset(root)
    change_info(root, codebase_version="v3.0")
    for path in files(root / "data"):
        truncate(path, 0.01)
    with pytest.raises(DatasetDamagedError, match="No whole episode is left"):
        repair_dataset(root)
    for name, content, error in (
        ("demo.hdf5", b"\x89HDF", "There is no LeRobotDataset"),
        ("meta/info.json", b'{"robot": "arm"}', "info.json is damaged"),
        ("data/chunk-000/file-000.parquet", b"PAR1", "info.json is missing.*--like"),
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=error):
            repair_dataset(tmp_path)
        (tmp_path / name).unlink()


def test_the_command_looks_and_repairs(copy, capsys, monkeypatch):
    monkeypatch.chdir(copy("killed").parent)
    root = Path("dataset")  # what is said names places as they were given
    assert run_in_process(repair_command, f"--root={root}", "--dry_run=true") == 1
    assert "it is damaged" in capsys.readouterr().out
    assert run_in_process(repair_command, f"--root={root}") == 0
    said = capsys.readouterr().out
    assert f"A copy with 6 whole episodes is in {root}_repaired" in said
    assert f"mv {root} {root}_damaged && mv {root}_repaired {root}" in said
    assert run_in_process(repair_command, f"--root={root}_repaired", "--dry_run=true") == 0
    assert "nothing wrong" in capsys.readouterr().out
    assert str(run_in_process(repair_command, f"--root={root}/nowhere")).startswith("error: ")


# Damage of every kind, at random


def damage(path: Path, rng: np.random.Generator) -> str:
    """Does one of the things to a file that disks and crashes do. Says what."""
    data = bytearray(path.read_bytes())
    kind = rng.choice(["flip", "flip", "flips", "truncate", "truncate", "delete", "empty", "zeros", "overwrite"])
    if kind in ("flip", "flips"):
        for _ in range(1 if kind == "flip" else 20):
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
    elif kind == "truncate":
        del data[rng.integers(len(data)) :]
    elif kind == "empty":
        data.clear()
    elif kind in ("zeros", "overwrite"):
        start = rng.integers(len(data))
        size = len(data[start : start + 512])
        data[start : start + 512] = bytes(size) if kind == "zeros" else rng.bytes(size)
    path.write_bytes(data)
    if kind == "delete":
        path.unlink()
    return str(kind)


def damage_and_repair(original: Path, features: dict[str, Any], root: Path, seed: int, like: Path | None) -> None:
    """One damaged copy: it is repaired, or the one error says why not; only what was hit may be missing."""
    rng = np.random.default_rng(seed)
    shutil.copytree(original, root)
    has_checksums = "lerobot" not in original.name
    hit: set[int] = set()
    hit_names = []
    chosen = [path for path in files(root) if path.name != ".lock"]
    for path in rng.choice(np.array(chosen, dtype=object), size=rng.integers(1, 3), replace=False):
        hit |= episodes_in(original, path.relative_to(root))
        hit_names.append(f"{damage(path, rng)} {path.relative_to(root)}")
    names = " ".join(hit_names)
    story = f"seed {seed} of {original.name}: {names}"
    before, error = everything(root), None
    try:
        report = repair_dataset(root, like=like)
    except InputError as refusal:
        error = str(refusal)
    assert everything(root) == before, story
    if error is not None:
        assert str(root) in error, story
        assert hit == set(range(N_EPISODES)) or (like is None and "info.json" in names), f"{story}: {error}"
        return
    story = f"{story}: {report}"
    if report.left:  # two of the places that say a thing were hit, or one that only a person can put right
        return
    if "film" not in names or "episodes" not in names:  # both say where pictures are
        assert dropped(report) <= hit, story
    assert all(each.reason for each in report.survey.episodes if not each.frames), story
    target = report.target or root
    assert survey(target).is_undamaged, story
    dataset = load(target)
    assert dataset.num_episodes == len(report.kept), story
    # A bit of sound can flip unseen where LeRobot wrote it: without checksums.
    exact = {new: old for old, new in report.kept.items() if has_checksums or old not in hit}
    wrong = differences(dataset, exact, {key: feature for key, feature in features.items() if key != FILM})
    if "tasks.parquet" in names:  # a text without a checksum, or both places that have it were hit
        wrong = [what for what in wrong if not what.startswith("task")]
    assert not wrong, f"{wrong} {story}"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ours", "one file", "lerobot"])
@pytest.mark.parametrize(
    "seeds", [range(5), pytest.param(range(1000, 1100), marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_random_damage(originals, tmp_path, name, seeds):
    original, features = originals[name]
    for seed in seeds:
        damage_and_repair(
            original, features, tmp_path / str(seed) / "dataset", seed, original if seed % 2 == 0 else None
        )
        shutil.rmtree(tmp_path / str(seed))
