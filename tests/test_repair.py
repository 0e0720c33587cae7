"""Damaged datasets: what is whole is kept bit for bit, what is lost is named, and nothing ends in a traceback."""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from recording_factory import (
    FEATURES,
    FILM,
    FPS,
    REPO_ID,
    RICH_FEATURES,
    differences,
    episode_frames,
    load,
)

from lerobot_playbyear.datasets import settling
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.repair import DatasetDamagedError, RepairReport, check_dataset, repair_dataset
from lerobot_playbyear.scripts import repair as repair_command

N_EPISODES = 6
UNDECIDED = "nothing is repaired before you decide it"
ENCODER = {"vcodec": "h264", "preset": "ultrafast"}


def write_ours(root: Path, features: dict[str, Any], numbers: Iterator[int] | range = range(N_EPISODES)) -> None:
    with DurableWriter(REPO_ID, root, FPS, features, resume=True, rgb_encoder=RGBEncoderConfig(**ENCODER)) as writer:
        for number in numbers:
            for frame in episode_frames(number, features):
                writer.add_frame(frame)
            writer.save_episode()


def write_lerobots(root: Path, features: dict[str, Any], n_episodes: int = N_EPISODES) -> LeRobotDataset:
    """A recording with plain LeRobot that goes on: its files have no end yet."""
    dataset = LeRobotDataset.create(
        REPO_ID, FPS, features, root=root, video_backend="pyav", rgb_encoder=RGBEncoderConfig(**ENCODER)
    )
    for number in range(n_episodes):
        for frame in episode_frames(number, features):
            dataset.add_frame(frame)
        dataset.save_episode(parallel_encoding=False)
    return dataset


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> dict[str, tuple[Path, dict[str, Any]]]:
    """Datasets to be damaged: of ours in several files and in one, of LeRobot's, and one that was killed."""
    folder = tmp_path_factory.mktemp("originals")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(settling, "_SMALL_DATA_BYTES", 20_000)
        patch.setattr(settling, "_SMALL_TABLE_BYTES", 30_000)
        write_ours(folder / "ours", RICH_FEATURES)
    write_ours(folder / "one file", FEATURES)
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
def copy(originals, tmp_path):
    """Makes a copy of one of the datasets to be damaged."""

    def make(name: str) -> Path:
        return Path(shutil.copytree(originals[name][0], tmp_path / "dataset"))

    return make


def files(root: Path) -> list[Path]:
    return sorted(path for path in root.rglob("*") if path.is_file())


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


def check_kept(root: Path, report: RepairReport, features: dict[str, Any]) -> LeRobotDataset:
    """The repaired dataset holds what the report says, and recording goes on in it."""
    dataset = load(root)
    assert dataset.num_episodes == len(report.kept)
    assert dataset.num_frames == len(dataset.hf_dataset) == dataset.meta.episodes[-1]["dataset_to_index"]
    assert not differences(dataset, {new: old for old, new in report.kept.items()}, features)
    return dataset


# Sound datasets


@pytest.mark.parametrize("name", ["ours", "one file", "lerobot"])
def test_a_sound_dataset_is_left_alone(copy, name):
    root = copy(name)
    before = {path: path.stat().st_mtime_ns for path in files(root)}

    report = repair_dataset(root)

    assert report.is_sound
    assert not report.changed
    assert "6 episodes, nothing wrong" in str(report)
    assert {path: path.stat().st_mtime_ns for path in files(root)} == before


# Recordings that were killed


def test_a_recording_that_lerobot_could_not_finish_is_whole_again(copy, originals):
    root = copy("killed")

    report = repair_dataset(root)

    assert report.changed
    assert not report.dropped
    dataset = check_kept(root, report, RICH_FEATURES)
    finished = load(originals["lerobot"][0])
    for key, own in finished.meta.stats.items():
        for name, value in own.items():
            if not key.startswith("observation.audio"):  # which LeRobot has per sample
                tolerance = 0.02 if key == FILM else 1e-6  # the film's from what was encoded
                np.testing.assert_allclose(dataset.meta.stats[key][name], value, atol=tolerance, err_msg=key)
    assert files(report.original)
    assert "no valid end" in str(report)


def test_recording_goes_on_where_lerobot_was_killed(copy):
    """After the repair that it asks for."""
    root = copy("killed")
    with pytest.raises(DatasetDamagedError, match=r"(?s)no valid end.*playbyear-repair --root="):
        write_ours(root, RICH_FEATURES, range(N_EPISODES, N_EPISODES + 1))
    repair_dataset(root)
    write_ours(root, RICH_FEATURES, range(N_EPISODES, N_EPISODES + 1))
    assert not differences(load(root), {n: n for n in range(N_EPISODES + 1)}, RICH_FEATURES)
    assert check_dataset(root).is_sound


# What is damaged or deleted later


def truncate(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def flip(path: Path, share: float) -> None:
    data = bytearray(path.read_bytes())
    data[int(len(data) * share)] ^= 64
    path.write_bytes(data)


@pytest.mark.parametrize("how", [truncate, flip])
@pytest.mark.parametrize("folder", ["data", "videos"])
def test_what_is_lost_takes_only_its_episodes_with_it(copy, folder, how):
    """The second file holds episodes from the middle of the dataset; those after it move up."""
    root = copy("ours")
    path = files(root / folder)[1]
    hit = episodes_in(root, path.relative_to(root))
    how(path, 0.3)

    report = repair_dataset(root)

    lost = set(report.dropped)
    assert lost <= hit < set(range(N_EPISODES))
    assert set(report.kept) == set(range(N_EPISODES)) - lost
    check_kept(root, report, RICH_FEATURES)
    assert all(f"episode {number} is lost" in str(report) for number in lost)
    assert lost
    assert "Numbered anew" in str(report)
    assert (report.original / path.relative_to(root)).exists()


@pytest.mark.parametrize(("name", "is_deleted"), [("ours", True), ("lerobot", False)])
@pytest.mark.parametrize("victim", ["meta/stats.json", "meta/tasks.parquet", "meta/episodes"])
def test_tables_that_are_lost_are_made_anew(copy, originals, name, victim, is_deleted):
    root = copy(name)
    for path in files(root / victim) or [root / victim]:
        path.unlink() if is_deleted else truncate(path, 0.5)

    report = repair_dataset(root)

    assert not report.dropped
    assert victim in str(report)
    dataset = check_kept(root, report, RICH_FEATURES)
    original = load(originals[name][0])
    assert dataset.meta.stats.keys() == original.meta.stats.keys()
    np.testing.assert_allclose(dataset.meta.stats["action"]["q90"], original.meta.stats["action"]["q90"], atol=1e-6)


def test_without_its_features_a_dataset_needs_one_that_is_like_it(copy, originals, capsys):
    root = copy("ours")
    (root / "meta/info.json").write_text("{")
    with pytest.raises(DatasetDamagedError, match=r"info\.json is damaged.*--like="):
        repair_dataset(root)

    command(f"--root={root}", f"--like={originals['lerobot'][0]}")

    assert "made anew" in capsys.readouterr().out
    assert load(root).features.keys() == load(originals["ours"][0]).features.keys()
    assert not differences(load(root), {n: n for n in range(N_EPISODES)}, RICH_FEATURES)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"total_episodes": 6', '"total_episodes": 7', "counts 7 episodes of 30 frames in all; there are 6 of 30"),
        ("{chunk_index:03d}/file", "{chunk_index:03d}/fike", "where nothing is"),
    ],
)
def test_what_the_dataset_says_about_itself_is_held_against_the_data(copy, old, new, said):
    root = copy("one file")
    info = root / "meta/info.json"
    assert old in info.read_text()
    info.write_text(info.read_text().replace(old, new))

    report = repair_dataset(root)

    assert said in str(report)
    check_kept(root, report, FEATURES)


@pytest.mark.parametrize("is_damaged", [False, True], ids=["else sound", "else damaged"])
@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"fps": 20', '"fps": 30', "fps is 30, but the frames' timestamps are 20 per second. Write 20 there if"),
        (
            '"sample_rate": 1600',
            '"sample_rate": 1602',
            "is 1602, but 80 samples per frame at 20 frames per second are 1600",
        ),
        (
            '"codebase_version": "v3.0"',
            '"codebase_version": "w3.0"',
            "codebase_version is 'w3.0', which LeRobot does not",
        ),
        (
            '"shape": [\n                16,\n',
            '"shape": [\n                24,\n',
            "has shape (24, 16, 3), but there are pictures 16 high",
        ),
    ],
    ids=["fps", "sample rate", "version", "shape"],
)
def test_what_is_wrong_in_one_of_two_places_is_reported_and_nothing_is_changed(copy, old, new, said, is_damaged):
    root = copy("ours")
    info = root / "meta/info.json"
    assert old in info.read_text()
    info.write_text(info.read_text().replace(old, new, 1))
    if is_damaged:
        files(root / "data")[1].unlink()
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files(root)}

    if is_damaged:
        with pytest.raises(DatasetDamagedError, match=r"(?s)its frames are lost.*nothing is repaired before") as error:
            repair_dataset(root)
        assert said in str(error.value)
    else:
        report = repair_dataset(root)
        assert (report.changed, report.is_sound, len(report.undecided)) == (False, False, 1)
        assert said in str(report)
        assert command(f"--root={root}") == 1
    with pytest.raises(ValueError):  # noqa: PT011  (the repair's, or that of settings that differ)
        write_ours(root, RICH_FEATURES)

    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files(root)} == before
    assert [path.name for path in root.parent.iterdir()] == ["dataset"]
    info.write_text(info.read_text().replace(new, old))  # what the report says
    assert repair_dataset(root).changed == is_damaged
    assert check_dataset(root).is_sound


def test_a_feature_of_another_name_is_not_believed(copy):
    root = copy("one file")
    info = root / "meta/info.json"
    info.write_text(info.read_text().replace('"action"', '"cction"'))
    with pytest.raises(DatasetDamagedError, match=r"disagree: its columns are not .*: action, cction"):
        repair_dataset(root)
    report = repair_dataset(root, fps=FPS, features=FEATURES)
    check_kept(root, report, FEATURES)


def test_a_file_with_another_column_costs_no_episode(copy):
    root = copy("ours")
    path = files(root / "data")[1]
    table = pq.read_table(path).replace_schema_metadata(None)
    pq.write_table(table.append_column("reward", pa.array(np.zeros(len(table)))), path)
    before = {path: path.read_bytes() for path in files(root)}
    with pytest.raises(
        DatasetDamagedError, match=r"file-001\.parquet: its columns .*: reward\. Correct the features in"
    ):
        repair_dataset(root)
    assert {path: path.read_bytes() for path in files(root)} == before


def test_the_recorder_asks_for_the_repair_of_what_it_continues(copy):
    root = copy("ours")
    first = sorted(root.glob("data/*/*"))[0]
    lost = episodes_in(root, first.relative_to(root))
    first.unlink()
    said = (
        rf"(?s)its frames are lost.*Can be kept: {N_EPISODES - len(lost)} complete episodes.*playbyear-repair --root="
    )
    with pytest.raises(DatasetDamagedError, match=said):
        write_ours(root, RICH_FEATURES, range(20, 21))
    assert not list(root.parent.glob("*.damaged"))
    repair_dataset(root)
    write_ours(root, RICH_FEATURES, range(20, 21))
    kept = [number for number in range(N_EPISODES) if number not in lost]
    assert not differences(load(root), dict(enumerate([*kept, 20])), RICH_FEATURES)


def test_nothing_is_changed_where_nothing_would_be_left(copy):
    root = copy("one file")
    for path in root.glob("data/*/*"):
        truncate(path, 0.01)
    before = {path: path.read_bytes() for path in files(root)}
    with pytest.raises(DatasetDamagedError, match="No complete episode is left"):
        repair_dataset(root)
    assert {path: path.read_bytes() for path in files(root)} == before
    assert not list(root.parent.glob(".*"))


# Folders of other tools


def test_an_older_format_is_told_how_to_be_converted(copy):
    root = copy("one file")
    info = root / "meta/info.json"
    info.write_text(info.read_text().replace('"v3.0"', '"v2.1"'))
    shutil.rmtree(root / "meta/episodes")
    (root / "meta/episodes.jsonl").write_text("{}\n")
    with pytest.raises(DatasetDamagedError, match=r"older format v2\.1.*convert_dataset_v21_to_v30"):
        write_ours(root, FEATURES)


@pytest.mark.parametrize(
    ("name", "content", "error"),
    [
        ("demo.hdf5", b"\x89HDF", "holds no LeRobotDataset"),
        ("meta/info.json", b'{"robot": "arm"}', "holds no LeRobotDataset"),
        ("data/chunk-000/file-000.parquet", b"PAR1", "needs|--like|and nothing else says"),
    ],
)
def test_a_folder_of_another_tool_is_named_as_such(tmp_path, name, content, error):
    root = tmp_path / "dataset"
    (root / name).parent.mkdir(parents=True)
    (root / name).write_bytes(content)
    with pytest.raises(DatasetDamagedError, match=error):
        repair_dataset(root)
    assert [path.relative_to(root).as_posix() for path in files(root)] == [name]


def test_a_dataset_that_lerobot_had_only_begun_can_be_continued(tmp_path):
    root = tmp_path / "dataset"
    LeRobotDataset.create(REPO_ID, FPS, FEATURES, root=root, use_videos=False)
    assert check_dataset(root).is_sound
    write_ours(root, FEATURES, range(2))
    assert not differences(load(root), {0: 0, 1: 1}, FEATURES)


# The command


def command(*arguments: str) -> int | str | None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["playbyear-repair", *arguments])
        with pytest.raises(SystemExit) as end:
            repair_command.main()
    return end.value.code


def test_the_command_looks_and_repairs(copy, capsys):
    root = copy("killed")
    assert command(f"--root={root}", "--dry_run=true") == 1
    assert "is damaged" in capsys.readouterr().out
    assert command(f"--root={root}") == 0
    assert "Kept: 6 complete episodes" in capsys.readouterr().out
    assert command(f"--root={root}", "--dry_run=true") == 0
    assert "nothing wrong" in capsys.readouterr().out
    assert str(command(f"--root={root}/nowhere")).startswith("error: ")


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


def damage_and_repair(original: Path, features: dict[str, Any], root: Path, seed: int, tells: bool) -> None:
    """One damaged copy: it is repaired, or the one error says why not; only what was hit may be missing."""
    rng = np.random.default_rng(seed)
    shutil.copytree(original, root)
    has_checksums = "lerobot" not in original.name
    hit: set[int] = set()
    hit_names = []
    for path in rng.choice(np.array(files(root), dtype=object), size=rng.integers(1, 3), replace=False):
        name = path.relative_to(root)
        hit |= episodes_in(original, name)
        hit_names.append(f"{damage(path, rng)} {name}")
    story = f"seed {seed} of {original.name}: {', '.join(hit_names)}"
    report, error = None, ""
    try:
        report = repair_dataset(root, **({"fps": FPS, "features": features} if tells else {}))
    except DatasetDamagedError as refusal:
        error = str(refusal)
    if report is None:
        assert str(root) in error, story
        excused = hit == set(range(N_EPISODES)) or (not tells and any("info.json" in name for name in hit_names))
        assert excused or UNDECIDED in error, f"{story}: {error}"
        return
    if report.undecided:
        assert not report.changed, story
        assert UNDECIDED in str(report), story
        return
    assert set(report.dropped) | set(report.kept) == set(range(N_EPISODES)), f"{story}: {report}"
    assert set(report.dropped) <= hit, f"{story}: {report}"
    assert all(reason for reason in report.dropped.values())
    dataset = load(root)
    assert dataset.num_episodes == len(report.kept), story
    # A bit of sound can flip unseen where LeRobot wrote it: without checksums.
    exact = {new: old for old, new in report.kept.items() if has_checksums or old not in hit}
    checked = {key: feature for key, feature in features.items() if key != FILM}
    wrong = differences(dataset, exact, checked)
    if {"tasks.parquet", "episodes"} <= {part for name in hit_names for part in Path(name).parts}:
        assert not wrong or "the text of task" in str(report)  # both places that have it were hit
        wrong = [what for what in wrong if not what.startswith("task")]
    if any(f"{Path('meta/tasks.parquet')}: task " in what for what in report.odd):  # a text without a checksum
        wrong = [what for what in wrong if not what.startswith("task")]
    assert not wrong, f"{story}: {wrong} {report}"


@pytest.mark.parametrize("name", ["ours", "one file", pytest.param("lerobot", marks=pytest.mark.slow)])
def test_random_damage(originals, tmp_path, name):
    for seed in range(7):
        damage_and_repair(*originals[name], tmp_path / str(seed), seed, tells=seed % 2 == 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ours", "one file", "lerobot"])
def test_much_random_damage(originals, tmp_path, name):
    for seed in range(1000, 1100):
        damage_and_repair(*originals[name], tmp_path / str(seed), seed, tells=seed % 2 == 0)
        shutil.rmtree(tmp_path / str(seed), ignore_errors=True)
