"""Sound in files beside the frames, as LeRobot's pull request 2824 stores it, and where in these files an episode's lies.

A feature `observation.audio.<microphone>` of dtype "audio" and shape (channels,) has no column. Its sound lies in
`audio/<key>/chunk-000/file-000.m4a`, or where `audio_path` in `meta/info.json` says, several episodes one after the other;
`meta/episodes` says where each begins. The sound of an episode begins `info.start_time_s` before its first frame. All this may
be a stranger's, and is checked here.
"""

import bisect
import json
import math
import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from lerobot_playbyear.datasets.errors import InputError, errors_of_input
from lerobot_playbyear.datasets.features import AUDIO_DTYPE, AUDIO_PREFIX
from lerobot_playbyear.datasets.files import EPISODES_DIR, INFO_PATH, list_files
from lerobot_playbyear.datasets.info import check_dataset_files, check_links, file_inside, read_info
from lerobot_playbyear.datasets.parquet import ParquetDamageError, read_table

AUDIO_FOLDER = "audio"
DEFAULT_AUDIO_PATH = "audio/{audio_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.m4a"

_TEMPLATE = re.compile(r"(?:[^{}]|\{(?:audio_key|(?:chunk|file)_index(?::0?\d?d)?)\})*")
_MOST_CHANNELS, _MOST_START_S, _MOST_INDEX = 64, 60.0, 10**6
_TOLERANCE, _SPARE_S = 4, 60.0  # times as long as the episodes, and so much more, may the files claim to last


class AudioLayoutError(InputError):
    """What a dataset says of its files of sound cannot be so."""


@dataclass(frozen=True)
class AudioSpan:
    """Where an episode's sound lies.

    Args:
        path: The file.
        start_s: Where in it the sound begins [s].
        end_s: Where it ends [s]; None: with the file.
    """

    path: Path
    start_s: float
    end_s: float | None


@dataclass(frozen=True)
class AudioTrack:
    """A microphone.

    Args:
        key: Its feature.
        n_channels: Of its files.
        sample_rate: Of its files, as the feature says [Hz]; None: it says nothing.
        start_time_s: How long before an episode's first frame its sound begins [s].
        spans: Of every episode.
    """

    key: str
    n_channels: int
    sample_rate: int | None
    start_time_s: float
    spans: list[AudioSpan]


@dataclass(frozen=True)
class AudioLayout:
    """What a dataset says of its files of sound.

    Args:
        fps: Its frames per second [Hz].
        lengths: Frames of each episode.
        tracks: Its microphones.
    """

    fps: int
    lengths: list[int]
    tracks: list[AudioTrack]


def has_audio_files(root: Path) -> bool:
    """Whether a dataset has sound in files beside the frames; also False where its features cannot be read."""
    try:
        features = json.loads((root / INFO_PATH).read_text())["features"]
        return any(feature.get("dtype") == AUDIO_DTYPE for feature in features.values())
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return False


def read_layout(repo_id: str, root: Path, start_time_s: float | None = None) -> AudioLayout:
    """Where the sound of a dataset lies that has it in files.

    Args:
        repo_id: Its name.
        root: Its folder.
        start_time_s: What is taken for `info.start_time_s` [s]; None: what the dataset says.

    Raises:
        InputError: A file is damaged or lies outside the folder; or a name, a number or a time is missing or cannot be right.
    """
    with errors_of_input():
        footers = check_dataset_files(repo_id, root)
        check_links(root)
        info = read_info(root)
        fps, features = info["fps"], info["features"]
        if fps % 1:
            raise AudioLayoutError(f"{root / INFO_PATH}: fps is {fps!r}; wanted a whole number. Correct it.")
        template = info.get("audio_path") or DEFAULT_AUDIO_PATH
        if not isinstance(template, str) or not _TEMPLATE.fullmatch(template) or "{file_index" not in template:
            raise AudioLayoutError(
                f"{root / INFO_PATH}: audio_path is {template!r}; wanted something like {DEFAULT_AUDIO_PATH!r}."
            )
        rows, lengths = _episodes(root, sum(footer.num_rows for footer in footers))
        seconds, heard = sum(lengths) / fps, [key for key, own in features.items() if own["dtype"] == AUDIO_DTYPE]
        tracks = [_track(root, key, features[key], template, rows, seconds, start_time_s) for key in heard]
        _check_names(tracks, set(features))
    return AudioLayout(int(fps), lengths, tracks)


def _episodes(root: Path, n_frames: int) -> tuple[pa.Table, list[int]]:
    """The rows of `meta/episodes` in the order of the episodes, and the frames of each."""
    remedy = f"Repair it first: playbyear-repair --root={root}"
    try:
        tables = [read_table(path) for path in list_files(root, f"{EPISODES_DIR}/*/*.parquet")]
        rows = pa.concat_tables(tables, promote_options="default").sort_by("episode_index")
        lengths = rows.column("length").to_pylist()
        numbers = rows.column("episode_index").to_pylist()
    except (ParquetDamageError, pa.ArrowException, KeyError) as error:
        raise AudioLayoutError(f"{root / EPISODES_DIR} is damaged: {error}. {remedy}") from error
    if numbers != list(range(len(rows))) or not all(isinstance(length, int) and length > 0 for length in lengths):
        raise AudioLayoutError(f"{root / EPISODES_DIR} lacks episodes, or lengths, of 0 to {len(rows) - 1}. {remedy}")
    if sum(lengths) != n_frames:
        raise AudioLayoutError(f"{root / EPISODES_DIR} counts {sum(lengths)} frames; data/ holds {n_frames}. {remedy}")
    return rows, lengths


def _check_names(tracks: list[AudioTrack], features: set[str]) -> None:
    taken = features - {track.key for track in tracks}
    for track in tracks:
        for name in column_names(track):
            if name in taken:
                raise AudioLayoutError(f"'{track.key}' becomes '{name}', which is there already. Rename one of them.")
            taken.add(name)


def column_names(track: AudioTrack) -> list[str]:
    """The columns that a microphone becomes: one for each channel, numbered from 0 if there are several."""
    return [track.key] if track.n_channels == 1 else [f"{track.key}_{channel}" for channel in range(track.n_channels)]


def _track(
    root: Path, key: str, feature: dict, template: str, rows: pa.Table, seconds: float, start_time_s: float | None
) -> AudioTrack:
    if not key.startswith(AUDIO_PREFIX) or key == AUDIO_PREFIX or "/" in key or "\\" in key:
        raise AudioLayoutError(f"'{key}' has dtype 'audio'; wanted '{AUDIO_PREFIX}<microphone>', without '/'.")
    info = feature.get("info") or {}
    if not isinstance(info, Mapping):
        raise AudioLayoutError(f"'{key}': info is {info!r}; wanted fields such as sample_rate. Correct {INFO_PATH}.")
    shape = feature.get("shape")
    n_channels = shape[0] if isinstance(shape, list) and len(shape) == 1 else None
    n_channels = _number(key, "shape", shape, n_channels, 1, _MOST_CHANNELS, "(channels,)")
    rate = info.get("sample_rate", info.get("audio.sample_rate"))
    if rate is not None:
        rate = _number(key, "info.sample_rate", rate, rate, 1, 1_000_000, "a whole number of Hz")
    start = info.get("start_time_s") if start_time_s is None else start_time_s
    is_time = isinstance(start, int | float) and not isinstance(start, bool) and 0 <= start <= _MOST_START_S
    if start is None or not is_time:
        raise AudioLayoutError(
            f"'{key}': info.start_time_s is {start!r}; wanted how long before an episode's first frame its sound begins, "
            f"0 to {_MOST_START_S:g} s. Say it with --offset=1."
        )
    latest_s = _TOLERANCE * (seconds + len(rows) * start) + _SPARE_S
    spans = _spans(root, key, template, rows, latest_s)
    return AudioTrack(key, int(n_channels), None if rate is None else int(rate), float(start), spans)


def _spans(root: Path, key: str, template: str, rows: pa.Table, latest_s: float) -> list[AudioSpan]:
    names = {name: f"{AUDIO_FOLDER}/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")}
    missing = [name for name in names.values() if name not in rows.column_names]
    if missing:
        raise AudioLayoutError(
            f"'{key}': meta/episodes has no column {missing[0]!r}, which says where its sound is. Add it."
        )
    columns = {name: rows.column(column).to_pylist() for name, column in names.items()}
    end_name = f"{AUDIO_FOLDER}/{key}/to_timestamp"
    ends = rows.column(end_name).to_pylist() if end_name in rows.column_names else [None] * len(rows)
    spans: list[AudioSpan] = []
    for episode, (chunk, file, start, end) in enumerate(zip(*columns.values(), ends, strict=True)):
        of = f"{key}', episode {episode}, '{AUDIO_FOLDER}"
        for name, value in (("chunk_index", chunk), ("file_index", file)):
            _number(of, name, value, value, 0, _MOST_INDEX, "a whole number")
        _time(of, "from_timestamp", start, 0, latest_s)
        if end is not None:
            _time(of, "to_timestamp", end, start, latest_s)
        path = file_inside(root, template.format(audio_key=key, chunk_index=int(chunk), file_index=int(file)))
        spans.append(AudioSpan(path, float(start), None if end is None else float(end)))
    starts: dict[Path, list[float]] = defaultdict(list)
    for span in sorted(spans, key=lambda span: span.start_s):
        starts[span.path].append(span.start_s)
    return [replace(span, end_s=_end(span, starts[span.path])) for span in spans]


def _end(span: AudioSpan, starts: list[float]) -> float | None:
    """Where a sound ends [s]: if that is not said, where the next one in its file begins, if there is one."""
    later = bisect.bisect_right(starts, span.start_s)
    return span.end_s if span.end_s is not None else starts[later] if later < len(starts) else None


def _number(of: str, name: str, seen: Any, value: Any, least: int, most: int, wanted: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float) or value % 1 or not least <= value <= most:
        raise AudioLayoutError(
            f"'{of}': {name} is {seen!r}; wanted {wanted}, {least} to {most:,}. Correct it, or ask who made the dataset."
        )
    return int(value)


def _time(of: str, name: str, value: Any, least: float, most: float) -> None:
    if not isinstance(value, int | float) or not math.isfinite(value) or not least <= value <= most:
        raise AudioLayoutError(
            f"'{of}': {name} is {value!r}; wanted seconds, {least:g} to {most:g}, which is {_TOLERANCE} times what the "
            "episodes last. Correct it, or ask who made the dataset."
        )
