"""Sound in files beside the frames, as LeRobot's pull request 2824 stores it, and where in these files an episode's lies.

A feature `observation.audio.<microphone>` of dtype "audio" and shape (channels,) has no column. Its sound lies in
`audio/<key>/chunk-000/file-000.m4a`, or where `audio_path` in `meta/info.json` says, several episodes one after the other;
`meta/episodes` says where each begins. The sound of an episode begins `info.start_time_s` before its first frame. All this may
be a stranger's, and is checked here.
"""

import itertools
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_playbyear.datasets.errors import InputError, errors_of_input
from lerobot_playbyear.datasets.features import AUDIO_DTYPE, AUDIO_PREFIX
from lerobot_playbyear.datasets.files import INFO_PATH, parse_json
from lerobot_playbyear.datasets.info import file_inside, ordinary, read_info
from lerobot_playbyear.datasets.reader import DatasetReader

AUDIO_FOLDER = "audio"
DEFAULT_AUDIO_PATH = "audio/{audio_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.m4a"

_TEMPLATE = re.compile(r"(?:[^{}]|\{(?:audio_key|(?:chunk|file)_index(?::0?\d?d)?)\})*")
_MOST_CHANNELS, _MOST_START_S, _MOST_INDEX = 64, 60.0, 10**6
_TOLERANCE, _SPARE_S = 4, 60.0  # times as long as the episodes, and so much more, may the files claim to last


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


def has_audio_files(root: Path) -> bool:
    """Whether a dataset has sound in files beside the frames; also False where its features cannot be read."""
    try:
        features = parse_json(ordinary(root / INFO_PATH).read_text())["features"]
        return any(feature.get("dtype") == AUDIO_DTYPE for feature in features.values())
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return False


def read_tracks(dataset: DatasetReader, start_time_s: float | None = None) -> list[AudioTrack]:
    """Where the sound of a dataset lies that has it in files.

    Args:
        dataset: The dataset.
        start_time_s: What is taken for `info.start_time_s` [s]; None: what the dataset says.

    Raises:
        InputError: A file lies outside the folder; or a name, a number or a time is missing or cannot be right.
    """
    with errors_of_input():
        info = read_info(dataset.root)
        features = info["features"]
        template = info.get("audio_path") or DEFAULT_AUDIO_PATH
        if not isinstance(template, str) or not _TEMPLATE.fullmatch(template) or "{file_index" not in template:
            raise InputError(
                f"{dataset.root / INFO_PATH}: audio_path is {template!r}; wanted something like {DEFAULT_AUDIO_PATH!r}."
            )
        heard = [key for key, own in features.items() if own["dtype"] == AUDIO_DTYPE]
        tracks = [_track(dataset, key, features[key], template, start_time_s) for key in heard]
    taken = features.keys() - set(heard)
    for track in tracks:
        for name in column_names(track):
            if name in taken:
                raise InputError(f"'{track.key}' becomes '{name}', which is there already. Rename one of them.")
            taken.add(name)
    return tracks


def column_names(track: AudioTrack) -> list[str]:
    """The columns that a microphone becomes: one for each channel, numbered from 0 if there are several."""
    return [track.key] if track.n_channels == 1 else [f"{track.key}_{channel}" for channel in range(track.n_channels)]


def _track(dataset: DatasetReader, key: str, feature: dict, template: str, start_time_s: float | None) -> AudioTrack:
    if not key.startswith(AUDIO_PREFIX) or key == AUDIO_PREFIX or "/" in key or "\\" in key:
        raise InputError(f"'{key}' has dtype 'audio'; wanted '{AUDIO_PREFIX}<microphone>', without '/'.")
    info, shape = feature.get("info") or {}, feature["shape"]
    n_channels = shape[0] if len(shape) == 1 else None
    n_channels = _number(key, "shape", shape, n_channels, 1, _MOST_CHANNELS, "(channels,)")
    rate = info.get("sample_rate", info.get("audio.sample_rate"))
    if rate is not None:
        rate = _number(key, "info.sample_rate", rate, rate, 1, 1_000_000, "a whole number of Hz")
    start = info.get("start_time_s") if start_time_s is None else start_time_s
    if not isinstance(start, int | float) or not 0 <= start <= _MOST_START_S:
        raise InputError(
            f"'{key}': info.start_time_s is {start!r}; wanted how long before an episode's first frame its sound begins, "
            f"0 to {_MOST_START_S:g} s. Say it with --offset=1."
        )
    latest_s = _TOLERANCE * (len(dataset) / dataset.fps + len(dataset.episodes) * start) + _SPARE_S
    return AudioTrack(key, n_channels, rate, float(start), _spans(dataset, key, template, latest_s))


def _spans(dataset: DatasetReader, key: str, template: str, latest_s: float) -> list[AudioSpan]:
    rows = dataset.meta.episodes
    names = {name: f"{AUDIO_FOLDER}/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")}
    missing = [name for name in names.values() if name not in rows.column_names]
    if missing:
        raise InputError(f"'{key}': meta/episodes has no column {missing[0]!r}, which says where its sound is. Add it.")
    end_name = f"{AUDIO_FOLDER}/{key}/to_timestamp"
    ends = rows[end_name] if end_name in rows.column_names else [None] * len(rows)
    spans: list[AudioSpan] = []
    for episode, (chunk, file, start, end) in enumerate(zip(*map(rows.__getitem__, names.values()), ends, strict=True)):
        of = f"{key}', episode {episode}, '{AUDIO_FOLDER}"
        for name, value in (("chunk_index", chunk), ("file_index", file)):
            _number(of, name, value, value, 0, _MOST_INDEX, "a whole number")
        _time(of, "from_timestamp", start, 0, latest_s)
        if end is not None:
            _time(of, "to_timestamp", end, start, latest_s)
        path = file_inside(dataset.root, template.format(audio_key=key, chunk_index=int(chunk), file_index=int(file)))
        spans.append(AudioSpan(path, float(start), None if end is None else float(end)))
    starts = sorted({(span.path, span.start_s) for span in spans})
    # Where no end is said, a sound ends where the next one in its file begins, if there is one.
    ends_of = {here: later[1] for here, later in itertools.pairwise(starts) if here[0] == later[0]}
    return [replace(s, end_s=ends_of.get((s.path, s.start_s)) if s.end_s is None else s.end_s) for s in spans]


def _number(of: str, name: str, seen: Any, value: Any, least: int, most: int, wanted: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float) or value % 1 or not least <= value <= most:
        raise InputError(
            f"'{of}': {name} is {seen!r}; wanted {wanted}, {least} to {most:,}. Correct it, or ask who made the dataset."
        )
    return int(value)


def _time(of: str, name: str, value: Any, least: float, most: float) -> None:
    if not isinstance(value, int | float) or not math.isfinite(value) or not least <= value <= most:
        raise InputError(
            f"'{of}': {name} is {value!r}; wanted seconds, {least:g} to {most:g}, which is {_TOLERANCE} times what the "
            "episodes last. Correct it, or ask who made the dataset."
        )
