"""Sound goes from files beside the frames (LeRobot's pull request 2824) to columns, and back, and stays the same."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from audio_layout_factory import EARS, PRE_ROLL_S, TABLE, add_files_of_sound, decode
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from test_attach_audio import FPS, LENGTHS, RATE, SIZE, silent_dataset

from lerobot_playbyear.audio.attach import AttachError, DatasetPlace
from lerobot_playbyear.audio.convert_audio import ConvertAudioConfig, convert_audio
from lerobot_playbyear.datasets import AUDIO_PREFIX, audio_export, episode_waveform
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.repair import check_dataset


def heard(episode: int, n_channels: int, rate: int = RATE) -> np.ndarray:
    """From a second before the first frame to the last one, and a little longer: (n, channels), tones and a little noise."""
    n_samples = round((PRE_ROLL_S + LENGTHS[episode] / FPS) * rate)
    rng = np.random.default_rng(episode)
    times = np.arange(n_samples)[:, None] / rate
    tones = 6000 * np.sin(2 * np.pi * (300 + 100 * episode + 50 * np.arange(n_channels)) * times)
    return (tones + rng.normal(0, 30, (n_samples, n_channels))).astype(np.int16)


def blocks_of(sound: np.ndarray, length: int) -> np.ndarray:
    """What is heard in (-1 / fps, (length - 1) / fps] around the first frame."""
    first = round(PRE_ROLL_S * RATE) - SIZE
    return sound[first : first + length * SIZE]


@pytest.fixture(scope="module")
def silent(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("silent") / "dataset"
    silent_dataset(root)
    return root


@pytest.fixture(scope="module")
def with_files(silent, tmp_path_factory) -> Path:
    """Three episodes, a mono and a stereo microphone, two episodes in the first file."""
    root = tmp_path_factory.mktemp("files") / "dataset"
    shutil.copytree(silent, root)
    add_files_of_sound(root, TABLE, [heard(i, 1) for i in range(3)], RATE, ends=False)
    add_files_of_sound(root, EARS, [heard(i, 2) for i in range(3)], RATE)
    return root


def convert(root: Path, target: Path, to: str, **options) -> Path:
    places = DatasetPlace("test/here", str(root)), DatasetPlace("test/there", str(target))
    return convert_audio(ConvertAudioConfig(*places, to, **options))


def load(root: Path) -> LeRobotDataset:
    return LeRobotDataset("test/there", root=root, video_backend="pyav")


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def episodes_of(root: Path) -> list[dict]:
    (table,) = root.glob("meta/episodes/*/*.parquet")
    return pq.read_table(table).to_pylist()


def test_files_become_columns_with_the_same_samples(with_files, silent, tmp_path):
    before = contents(with_files)
    root = convert(with_files, tmp_path / "columns", "columns")

    dataset = load(root)
    microphones = {TABLE: (1, 0), f"{EARS}_0": (2, 0), f"{EARS}_1": (2, 1)}
    assert {key for key in dataset.features if key.startswith(AUDIO_PREFIX)} == set(microphones)
    for key, (n_channels, channel) in microphones.items():
        for episode, length in enumerate(LENGTHS):
            waveform, rate = episode_waveform(dataset, episode, key)
            assert rate == RATE
            np.testing.assert_array_equal(waveform, blocks_of(heard(episode, n_channels), length)[:, channel])
    assert check_dataset(root).is_sound
    assert contents(with_files) == before
    old = LeRobotDataset("test/silent", root=silent, video_backend="pyav")
    for key, value in old[20].items():
        assert np.array_equal(np.asarray(dataset[20][key]), np.asarray(value)), key
    assert not (root / "audio").exists()
    assert not [name for name in episodes_of(root)[0] if name.startswith("audio/")]
    assert {path.name for path in tmp_path.iterdir()} == {"columns"}


def test_columns_become_files_as_the_layout_has_them(with_files, tmp_path):
    columns = convert(with_files, tmp_path / "columns", "columns")
    before = contents(columns)
    root = convert(columns, tmp_path / "files", "files")

    info = json.loads((root / "meta/info.json").read_text())
    rows = episodes_of(root)
    for key, n_channels in ((TABLE, 1), (EARS, 2)):
        feature = info["features"][key]
        assert (feature["dtype"], feature["shape"]) == ("audio", [n_channels])
        assert feature["info"]["sample_rate"] == feature["info"]["audio.sample_rate"] == RATE
        assert feature["info"]["audio.codec"] == "alac"
        for episode, length in enumerate(LENGTHS):
            place = {name.rsplit("/")[-1]: value for name, value in rows[episode].items() if f"audio/{key}/" in name}
            path = info["audio_path"].format(audio_key=key, **place)
            start, end = (round(place[name] * RATE) for name in ("from_timestamp", "to_timestamp"))
            samples = decode(root / path)[start:end]
            first = round(feature["info"]["start_time_s"] * RATE) - SIZE
            np.testing.assert_array_equal(samples[first:], blocks_of(heard(episode, n_channels), length))
            assert not samples[:first].any()
            assert (rows[episode][f"stats/{key}/max"], rows[episode][f"stats/{key}/count"]) == (
                pytest.approx(samples[first:].max(axis=0) / 32768, rel=1e-3),
                [length],
            )
        assert json.loads((root / "meta/stats.json").read_text())[key]["std"] == pytest.approx(
            [6000 / 2**0.5 / 32768] * n_channels, rel=0.01
        )
    assert not [key for key in info["features"] if key.startswith(f"{EARS}_")]
    (data,) = root.glob("data/*/*.parquet")
    assert not [name for name in pq.read_schema(data).names if name.startswith(AUDIO_PREFIX)]
    assert contents(columns) == before


def test_there_and_back_is_the_same_dataset(with_files, tmp_path):
    once = convert(with_files, tmp_path / "once", "columns")
    files = convert(once, tmp_path / "files", "files")
    twice = convert(files, tmp_path / "twice", "columns")
    first, second = contents(once), contents(twice)
    assert first.keys() == second.keys()
    for name in first:
        if name.endswith(".parquet") and name.startswith("data"):
            assert first[name] == second[name]
    assert json.loads(first["meta/info.json"]) == json.loads(second["meta/info.json"])
    assert json.loads(first["meta/stats.json"]) == json.loads(second["meta/stats.json"])


def test_a_large_file_is_followed_by_another(with_files, tmp_path, monkeypatch):
    """Here every file is large: each episode gets its own."""
    once = convert(with_files, tmp_path / "once", "columns")
    monkeypatch.setattr(audio_export, "FILE_MEGABYTES", 0)
    files = convert(once, tmp_path / "files", "files")
    rows = episodes_of(files)
    assert [row[f"audio/{EARS}/file_index"] for row in rows] == [0, 1, 2]
    assert [row[f"audio/{EARS}/from_timestamp"] for row in rows] == [0, 0, 0]
    twice = convert(files, tmp_path / "twice", "columns")
    assert contents(once)["data/chunk-000/file-000.parquet"] == contents(twice)["data/chunk-000/file-000.parquet"]


@pytest.mark.parametrize("n_channels", [1, 2])
def test_lossy_files_come_in_and_go_out_within_the_codecs_error(silent, tmp_path, n_channels):
    shutil.copytree(silent, tmp_path / "aac")
    sounds = [heard(i, n_channels) for i in range(3)]
    add_files_of_sound(tmp_path / "aac", EARS, sounds, RATE, codec="aac", per_file=3)
    once = convert(tmp_path / "aac", tmp_path / "once", "columns")
    files = convert(once, tmp_path / "files", "files", codec="aac")
    twice = convert(files, tmp_path / "twice", "columns", pad=True)
    for root, least in ((once, 15), (twice, 12)):
        dataset = load(root)
        for channel in range(n_channels):
            key = EARS if n_channels == 1 else f"{EARS}_{channel}"
            for episode, length in enumerate(LENGTHS):
                wanted = blocks_of(sounds[episode], length)[:, channel].astype(float)
                error = episode_waveform(dataset, episode, key)[0] - wanted
                assert 10 * np.log10((wanted**2).mean() / (error**2).mean()) > least, "decibels"


def test_a_rate_that_the_frame_rate_does_not_divide_is_resampled(silent, tmp_path):
    shutil.copytree(silent, tmp_path / "files")
    sounds = [heard(i, 1, rate=11025) for i in range(3)]
    add_files_of_sound(tmp_path / "files", TABLE, sounds, 11025)
    dataset = load(convert(tmp_path / "files", tmp_path / "columns", "columns"))
    assert dataset.features[TABLE]["info"]["sample_rate"] == 11020
    waveform, _ = episode_waveform(dataset, 1, TABLE)
    times = 1 - 1 / FPS + np.arange(len(waveform)) / 11020
    wanted = 6000 * np.sin(2 * np.pi * 400 * times)
    assert np.abs(waveform - wanted)[100:-100].max() < 200
    at_16k = load(convert(tmp_path / "files", tmp_path / "at_16k", "columns", sample_rate=RATE))
    assert at_16k[3][TABLE].shape == (SIZE,)


def test_only_what_belongs_to_the_first_frame_is_taken_of_the_time_before_it(silent, tmp_path):
    """A click half a block before the first frame is in block 0, one a block and a half before it is nowhere."""
    shutil.copytree(silent, tmp_path / "files")
    sounds = [np.zeros_like(heard(i, 1)) for i in range(3)]
    for sound in sounds:
        sound[RATE - SIZE // 2], sound[RATE - 3 * SIZE // 2] = 20_000, 10_000
    add_files_of_sound(tmp_path / "files", TABLE, sounds, RATE)
    waveform, _ = episode_waveform(load(convert(tmp_path / "files", tmp_path / "columns", "columns")), 1, TABLE)
    assert np.flatnonzero(waveform).tolist() == [SIZE // 2]


def test_sound_that_begins_with_the_first_frame_has_a_silent_first_block(with_files, tmp_path):
    """Where the dataset does not say when sound begins, the user does."""
    shutil.copytree(with_files, tmp_path / "files")
    change_info(tmp_path / "files", lambda info: info["features"][TABLE]["info"].pop("start_time_s"))
    with pytest.raises(InputError, match=rf"'{TABLE}': info.start_time_s is None; wanted.*--start_time_s=1"):
        convert(tmp_path / "files", tmp_path / "columns", "columns")
    waveform, _ = episode_waveform(
        load(convert(tmp_path / "files", tmp_path / "c", "columns", start_time_s=0)), 0, TABLE
    )
    assert not waveform[:SIZE].any()
    np.testing.assert_array_equal(waveform[SIZE:], heard(0, 1)[: (LENGTHS[0] - 1) * SIZE, 0])


def change_info(root: Path, change) -> None:
    info = json.loads((root / "meta/info.json").read_text())
    change(info)
    (root / "meta/info.json").write_text(json.dumps(info))


def change_column(root: Path, name: str, values: list) -> None:
    (table,) = root.glob("meta/episodes/*/*.parquet")
    rows = pq.read_table(table)
    place = rows.column_names.index(f"audio/{TABLE}/{name}")
    pq.write_table(rows.set_column(place, f"audio/{TABLE}/{name}", pa.array(values)), table)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda info: info.update(audio_path="../{audio_key}/{file_index}.m4a"), "not in its folder"),
        (lambda info: info.update(audio_path="{audio_key.__class__}"), "audio_path is .*wanted something like"),
        (lambda info: info["features"][TABLE].update(shape=[3]), "it has 1 channels; the feature's shape says 3"),
        (lambda info: info["features"][TABLE].update(shape=[10**9]), r"shape is \[1000000000\]; wanted \(channels,\)"),
        (lambda info: info["features"][TABLE]["info"].update(sample_rate=8000), "has 16000 samples.*info says 8000"),
        (lambda info: info["features"][TABLE]["info"].update(start_time_s=-1.0), "start_time_s is -1.0; wanted"),
        (lambda info: info["features"].update({f"{AUDIO_PREFIX}a/../b": info["features"].pop(TABLE)}), "without '/'"),
        (lambda info: info["features"].update({f"{EARS}_1": info["features"]["action"]}), "which is there already"),
        (lambda info: info.update(fps=0), "fps is 0; wanted"),
    ],
)
def test_what_a_stranger_says_is_checked_first(with_files, tmp_path, change, message):
    shutil.copytree(with_files, tmp_path / "files")
    change_info(tmp_path / "files", change)
    with pytest.raises(InputError, match=message):
        convert(tmp_path / "files", tmp_path / "columns", "columns")
    assert [path.name for path in tmp_path.iterdir()] == ["files"]


@pytest.mark.parametrize(
    ("column", "values", "message"),
    [
        ("from_timestamp", [0.0, float("nan"), 0.0], f"'{TABLE}', episode 1, .*from_timestamp is nan; wanted seconds"),
        ("from_timestamp", [0.0, 1e12, 0.0], r"from_timestamp is 1000000000000.0; wanted seconds, 0 to"),
        ("from_timestamp", [0.0, 2.5, 0.0], r"episode 1, .*file-000.m4a: it lasts .* at its end more"),
        ("file_index", [0, 7, 1], r"episode 1, .*There is no sound file .*file-007.m4a"),
        ("file_index", [0, -1, 1], "file_index is -1; wanted a whole number"),
        ("chunk_index", [0, None, 1], "chunk_index is None; wanted a whole number"),
    ],
)
def test_a_place_that_cannot_be_is_one_clear_error(with_files, tmp_path, column, values, message):
    shutil.copytree(with_files, tmp_path / "files")
    change_column(tmp_path / "files", column, values)
    with pytest.raises(InputError, match=message):
        convert(tmp_path / "files", tmp_path / "columns", "columns")
    assert [path.name for path in tmp_path.iterdir()] == ["files"]


def test_a_file_that_names_others_is_not_followed(with_files, tmp_path):
    shutil.copytree(with_files, tmp_path / "files")
    (tmp_path / f"files/audio/{TABLE}/chunk-000/file-000.m4a").write_text("ffconcat version 1.0\nfile file-001.m4a\n")
    with pytest.raises(InputError, match=rf"'{TABLE}', episode 0, .*cannot be decoded"):
        convert(tmp_path / "files", tmp_path / "columns", "columns")


def test_a_link_out_of_the_dataset_is_not_followed(with_files, tmp_path):
    shutil.copytree(with_files, tmp_path / "files")
    file = tmp_path / f"files/audio/{TABLE}/chunk-000/file-000.m4a"
    file.unlink()
    file.symlink_to(with_files / f"audio/{TABLE}/chunk-000/file-000.m4a")
    with pytest.raises(InputError, match=r"is a link to .*outside the dataset's folder"):
        convert(tmp_path / "files", tmp_path / "columns", "columns")


@pytest.mark.parametrize("to", ["columns", "files"])
def test_a_copy_that_cannot_be_made_is_told_before_the_dataset_is_read(tmp_path, to):
    (tmp_path / "file").touch()
    with pytest.raises(
        InputError, match=r"--output.root=.*/there cannot be written: Not a directory in .*/file; wanted"
    ):
        convert(tmp_path / "nothing", tmp_path / "file/there", to)


def test_options_that_do_not_fit_are_told(with_files, silent, tmp_path):
    with pytest.raises(InputError, match="--to=both is not known; wanted columns or files"):
        convert(with_files, tmp_path / "x", "both")
    with pytest.raises(InputError, match="no feature of dtype 'audio'"):
        convert(silent, tmp_path / "x", "columns")
    with pytest.raises(InputError, match="has no sound in columns"):
        convert(silent, tmp_path / "x", "files")
    with pytest.raises(InputError, match="--sample_rate=8000 is for --to=columns"):
        convert(silent, tmp_path / "x", "files", sample_rate=8000)
    with pytest.raises(InputError, match="--sample_rate=8010: wanted a multiple of 20"):
        convert(with_files, tmp_path / "x", "columns", sample_rate=8010)
    columns = convert(with_files, tmp_path / "columns", "columns", sample_rate=15980)
    with pytest.raises(InputError, match=r"15980 samples per second, which aac cannot have. Choose --codec=alac"):
        convert(columns, tmp_path / "x", "files", codec="aac")
    with pytest.raises(AttachError, match=f"'{TABLE}' has its sound in files.*playbyear-convert-audio --to=columns"):
        convert(with_files, tmp_path / "x", "files")
    with pytest.raises(InputError, match="--codec=mp3 is not known"):
        convert(columns, tmp_path / "x", "files", codec="mp3")
