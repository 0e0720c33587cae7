"""Sound in files beside the frames (LeRobot's pull request 2824) becomes columns with the same samples."""

import itertools
import shutil
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from recording_factory import load
from support.recording import edit_column, edit_info, everything
from test_attach_audio import FPS, LENGTHS, RATE, SIZE, attach

from lerobot_playbyear.datasets import episode_waveform
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.features import AUDIO_PREFIX
from lerobot_playbyear.datasets.survey import survey

PRE_ROLL_S = 1.0
EARS = "observation.audio.ears"
TABLE = "observation.audio.table"


def encode(path: Path, samples: np.ndarray, rate: int, codec: str) -> None:
    """Samples (n, channels) int16 as an M4A file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    layout = "mono" if samples.shape[1] == 1 else "stereo"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, layout=layout)
        for start in range(0, len(samples), 1024):
            piece = np.ascontiguousarray(samples[start : start + 1024]).reshape(1, -1)
            frame = av.AudioFrame.from_ndarray(piece, format="s16", layout=layout)
            frame.sample_rate, frame.pts = rate, start
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def add_files_of_sound(
    root: Path, key: str, sounds: list[np.ndarray], rate: int, codec: str = "alac", per_file: int = 2, ends: bool = True
) -> None:
    """Adds a microphone to a dataset.

    Args:
        root: Its folder.
        key: The feature.
        sounds: For each episode (n, channels) int16, from `PRE_ROLL_S` before its first frame on.
        rate: [Hz].
        codec: Of the files.
        per_file: Episodes in one file.
        ends: Whether `to_timestamp` is there.
    """
    columns: dict[str, list] = {"chunk_index": [], "file_index": [], "from_timestamp": [], "to_timestamp": []}
    for first in range(0, len(sounds), per_file):
        part = sounds[first : first + per_file]
        number = first // per_file
        encode(root / f"audio/{key}/chunk-000/file-{number:03d}.m4a", np.concatenate(part), rate, codec)
        edges = np.cumsum([0, *map(len, part)]) / rate
        for start, end in itertools.pairwise(edges):
            for name, value in zip(columns, (0, number, float(start), float(end)), strict=True):
                columns[name].append(value)
    (table,) = root.glob("meta/episodes/*/*.parquet")
    rows = pq.read_table(table)
    for name, values in columns.items():
        if ends or name != "to_timestamp":
            rows = rows.append_column(f"audio/{key}/{name}", pa.array(values))
    pq.write_table(rows, table)
    n_channels = sounds[0].shape[1]
    notes = {"sample_rate": rate, "audio.codec": codec, "audio.channels": n_channels, "start_time_s": PRE_ROLL_S}
    feature = {"dtype": "audio", "shape": [n_channels], "names": ["channels"], "info": notes}
    path = "audio/{audio_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.m4a"
    edit_info(root, lambda info: info.update(features={**info["features"], key: feature}, audio_path=path))


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
def with_files(silent, tmp_path_factory) -> Path:
    """Three episodes, a mono and a stereo microphone, two episodes in the first file."""
    root = tmp_path_factory.mktemp("files") / "dataset"
    shutil.copytree(silent, root)
    add_files_of_sound(root, TABLE, [heard(i, 1) for i in range(3)], RATE, ends=False)
    add_files_of_sound(root, EARS, [heard(i, 2) for i in range(3)], RATE)
    return root


def episodes_of(root: Path) -> list[dict]:
    (table,) = root.glob("meta/episodes/*/*.parquet")
    return pq.read_table(table).to_pylist()


def test_files_become_columns_with_the_same_samples(with_files, silent, tmp_path):
    before = everything(with_files)
    root = attach(with_files, tmp_path / "columns")

    dataset = load(root)
    microphones = {TABLE: (1, 0), f"{EARS}_0": (2, 0), f"{EARS}_1": (2, 1)}
    assert {key for key in dataset.features if key.startswith(AUDIO_PREFIX)} == set(microphones)
    for key, (n_channels, channel) in microphones.items():
        for episode, length in enumerate(LENGTHS):
            waveform, rate = episode_waveform(dataset, episode, key)
            assert rate == RATE
            np.testing.assert_array_equal(waveform, blocks_of(heard(episode, n_channels), length)[:, channel])
    assert survey(root).is_undamaged
    assert everything(with_files) == before
    for key, value in load(silent)[20].items():
        assert np.array_equal(np.asarray(dataset[20][key]), np.asarray(value)), key
    assert not (root / "audio").exists()
    assert not [name for name in episodes_of(root)[0] if name.startswith("audio/")]
    assert {path.name for path in tmp_path.iterdir()} == {"columns"}


def test_lossy_files_come_in_within_the_codecs_error(silent, tmp_path):
    shutil.copytree(silent, tmp_path / "aac")
    sounds = [heard(i, 2) for i in range(3)]
    add_files_of_sound(tmp_path / "aac", EARS, sounds, RATE, codec="aac", per_file=3)
    dataset = load(attach(tmp_path / "aac", tmp_path / "columns"))
    for channel, key in enumerate((f"{EARS}_0", f"{EARS}_1")):
        for episode, length in enumerate(LENGTHS):
            wanted = blocks_of(sounds[episode], length)[:, channel].astype(float)
            error = episode_waveform(dataset, episode, key)[0] - wanted
            assert 10 * np.log10((wanted**2).mean() / (error**2).mean()) > 15, "decibels"


def test_a_rate_that_the_frame_rate_does_not_divide_is_resampled(silent, tmp_path):
    shutil.copytree(silent, tmp_path / "files")
    sounds = [heard(i, 1, rate=11025) for i in range(3)]
    add_files_of_sound(tmp_path / "files", TABLE, sounds, 11025)
    dataset = load(attach(tmp_path / "files", tmp_path / "columns"))
    assert dataset.features[TABLE]["info"]["sample_rate"] == 11020
    waveform, _ = episode_waveform(dataset, 1, TABLE)
    times = 1 - 1 / FPS + np.arange(len(waveform)) / 11020
    wanted = 6000 * np.sin(2 * np.pi * 400 * times)
    assert np.abs(waveform - wanted)[100:-100].max() < 200


def test_sound_that_begins_with_the_first_frame_has_a_silent_first_block(with_files, tmp_path):
    """Where the dataset does not say when sound begins, the user does."""
    shutil.copytree(with_files, tmp_path / "files")
    edit_info(tmp_path / "files", lambda info: info["features"][TABLE]["info"].pop("start_time_s"))
    with pytest.raises(InputError, match=rf"'{TABLE}': info.start_time_s is None; wanted.*--offset=1"):
        attach(tmp_path / "files", tmp_path / "columns")
    waveform, _ = episode_waveform(load(attach(tmp_path / "files", tmp_path / "c", offset=0)), 0, TABLE)
    assert not waveform[:SIZE].any()
    np.testing.assert_array_equal(waveform[SIZE:], heard(0, 1)[: (LENGTHS[0] - 1) * SIZE, 0])


def place(name: str, *values: float | None):
    """Where a microphone's sound is, episode by episode."""

    def change(root: Path) -> None:
        (table,) = root.glob("meta/episodes/*/*.parquet")
        edit_column(table, f"audio/{TABLE}/{name}", lambda _: list(values))

    return change


def add_a_column_of_its_name(root: Path) -> None:
    edit_info(root, lambda info: info["features"].update({f"{EARS}_1": info["features"]["action"]}))
    (path,) = root.glob("data/*/*.parquet")
    table = pq.read_table(path)
    pq.write_table(table.append_column(f"{EARS}_1", table["action"]).replace_schema_metadata({}), path)


def info(change):
    return lambda root: edit_info(root, change)


def microphone(**notes: float):
    return info(lambda info: info["features"][TABLE]["info"].update(notes))


REFUSED = [
    (info(lambda info: info.update(audio_path="../{audio_key}/{file_index}.m4a")), "not in its folder"),
    (info(lambda info: info.update(audio_path="{audio_key.__class__}")), "audio_path is .*wanted something like"),
    (info(lambda info: info["features"][TABLE].update(shape=[3])), "it has 1 channels; the feature's shape says 3"),
    (
        info(lambda info: info["features"][TABLE].update(shape=[10**9])),
        r"shape is \[1000000000\]; wanted \(channels,\)",
    ),
    (info(lambda info: info["features"].update({f"{AUDIO_PREFIX}a/../b": info["features"].pop(TABLE)})), "without '/'"),
    (add_a_column_of_its_name, "which is there already"),
    (microphone(sample_rate=8000), "has 16000 samples.*info says 8000"),
    (microphone(start_time_s=-1.0), "start_time_s is -1.0; wanted"),
    (place("from_timestamp", 0.0, float("nan"), 0.0), f"'{TABLE}', episode 1, .*from_timestamp is nan; wanted seconds"),
    (place("from_timestamp", 0.0, 1e12, 0.0), r"from_timestamp is 1000000000000.0; wanted seconds, 0 to"),
    (place("from_timestamp", 0.0, 2.5, 0.0), r"episode 1, .*file-000.m4a: it lasts .* at its end more"),
    (place("file_index", 0, 7, 1), r"episode 1, .*There is no sound file .*file-007.m4a"),
    (place("file_index", 0, -1, 1), "file_index is -1; wanted a whole number"),
    (place("chunk_index", 0, None, 1), "chunk_index is None; wanted a whole number"),
]


OPTIONS: list[tuple[dict, str]] = [
    ({"sample_rate": 8010}, "--sample_rate=8010: wanted a multiple of 20"),
    ({"microphone": "gripper"}, "--microphone=gripper is for --files .*, not for the dataset's own files"),
    ({"files": "{episode}.wav"}, rf"'{EARS}|{TABLE}' has its sound in files.*without --files and --session"),
]


@pytest.mark.parametrize(("change", "message"), [*REFUSED, *OPTIONS])
def test_what_a_stranger_says_and_options_that_do_not_fit_are_refused_first(with_files, tmp_path, change, message):
    shutil.copytree(with_files, tmp_path / "files")
    options = change if isinstance(change, dict) else change(tmp_path / "files") or {}
    with pytest.raises(InputError, match=message):
        attach(tmp_path / "files", tmp_path / "columns", **options)
    assert [path.name for path in tmp_path.iterdir()] == ["files"]


def test_a_file_that_names_others_or_is_a_link_is_not_followed(with_files, tmp_path):
    shutil.copytree(with_files, tmp_path / "files")
    file = tmp_path / f"files/audio/{TABLE}/chunk-000/file-000.m4a"
    file.write_text("ffconcat version 1.0\nfile file-001.m4a\n")
    with pytest.raises(InputError, match=rf"'{TABLE}', episode 0, .*cannot be decoded"):
        attach(tmp_path / "files", tmp_path / "columns")
    file.unlink()
    file.symlink_to(with_files / f"audio/{TABLE}/chunk-000/file-000.m4a")
    with pytest.raises(InputError, match=r"is a link to .*outside its folder"):
        attach(tmp_path / "files", tmp_path / "columns")
