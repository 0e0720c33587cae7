"""What there is of a dataset, and what is wrong with it: its files, frames, episodes, films and tables held against each other.

The repair keeps what a survey calls whole, inspection reports what it finds, and a recorder appends to nothing that it calls
damaged. That something cannot be read now is no finding but an OSError: it says nothing about the dataset.
"""

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image, UnidentifiedImageError

from lerobot_playbyear.datasets.errors import InputError, printable
from lerobot_playbyear.datasets.features import AUDIO_DTYPE, arrow_schema, audio_keys, check_audio_features
from lerobot_playbyear.datasets.files import EPISODES_DIR, INFO_PATH, is_listed, list_files, naming
from lerobot_playbyear.datasets.findings import Finding, name_episodes, worst
from lerobot_playbyear.datasets.info import (
    INDEX_COLUMNS,
    STATS_PATH,
    Info,
    InfoError,
    are_numbers,
    check_there,
    parse_stats,
    read_info,
)
from lerobot_playbyear.datasets.parquet import DataFile, ParquetDamageError, are_alike, column_to_numpy, read_table
from lerobot_playbyear.datasets.pictures import open_picture
from lerobot_playbyear.datasets.remedies import repair_command, task_command
from lerobot_playbyear.datasets.video_files import Place, find_places, place_in_row

TASKS_PATH = "meta/tasks.parquet"

Rescue = Callable[[Path, pa.Schema], pq.FileMetaData | None]
"""Makes the footer of a parquet file that has lost its own, from the file and the columns that it should have."""

_TIME_TOLERANCE_S = 1e-3
_MOST_LOST = 10_000  # episodes of which rows are left without frames
_MOST_PIECES = 20_000  # of episodes in a file: LeRobot's hold 100 MB


class DatasetDamagedError(InputError):
    """A dataset is damaged, or too damaged to say what it holds; the message says how, and what to do."""


@dataclass(frozen=True)
class Frames:
    """Rows of a data file that follow each other and belong to one episode.

    Args:
        file: Where they are.
        start: The first row.
        length: How many.
        episode: The episode's number.
        first_frame: The first row's number within the episode.
        first_index: The first row's number within the dataset.
        is_numbered: Whether the numbers of the others within the dataset follow from it.
        is_timely: Whether the timestamps are frame / fps.
        tasks: The numbers of the tasks that occur.
        damage: What is wrong with one of the pictures; None for nothing.
    """

    file: DataFile
    start: int
    length: int
    episode: int
    first_frame: int
    first_index: int
    is_numbered: bool
    is_timely: bool
    tasks: tuple[int, ...]
    damage: str | None = None


@dataclass(frozen=True)
class Episode:
    """An episode that is there, or of which something tells that it was.

    Args:
        number: Its number.
        frames: Where all of it is there.
        row: Its row in `meta/episodes`; empty where it has none.
        contradiction: What that says and the frames and films do not, if anything.
        places: Of each camera with films, where its pictures are.
        reason: Why not all of it is there.
    """

    number: int
    frames: Frames | None = None
    row: Mapping[str, Any] = field(default_factory=dict)
    contradiction: str | None = None
    places: dict[str, Place] = field(default_factory=dict)
    reason: str = ""


@dataclass(frozen=True)
class Survey:
    """A dataset as it was found.

    Args:
        root: Its folder.
        info: What it says about itself.
        schema: Of its data files.
        episodes: All episodes, in the order of their numbers, also those that are not whole.
        tasks: The text of each task.
        findings: What is wrong, or odd.
    """

    root: Path
    info: dict[str, Any]
    schema: pa.Schema
    episodes: Sequence[Episode]
    tasks: Mapping[int, str]
    findings: Sequence[Finding]

    @property
    def whole(self) -> list[Episode]:
        """The episodes of which everything is there."""
        return [episode for episode in self.episodes if episode.frames]

    @property
    def is_undamaged(self) -> bool:
        """Whether nothing is wrong; what is odd does not count."""
        return worst(self.findings) != "error"

    @property
    def damage(self) -> list[Finding]:
        """What `playbyear-repair` makes good, in a copy."""
        return [finding for finding in self.findings if finding.level == "error" and not finding.remedy]

    def __str__(self) -> str:
        if not self.findings:
            return f"{self.root}: {len(self.episodes)} episodes, nothing wrong."
        verdict = "nothing wrong, but" if self.is_undamaged else "it is damaged:"
        lines = [f"{self.root}: {len(self.whole)} whole episodes; {verdict}"]
        return "\n  - ".join([*lines, *(printable(each, kept="") for each in self.findings)])


def survey(root: str | Path, thorough: bool = True, rescue: Rescue | None = None, like: Path | None = None) -> Survey:
    """Reads a dataset, and changes nothing.

    Args:
        root: Its folder.
        thorough: Read everything, with checksums, look at the pictures in columns, and hold films against the frames. Otherwise
            only what tells whether it can be opened and continued: this takes seconds, whatever its size.
        rescue: Reads files that lost their end. None: they are only named.
        like: A dataset that was recorded with the same settings. Its frame rate and features are believed.

    Raises:
        InputError: It is no dataset.
        DatasetDamagedError: Nothing says what its columns are.
        OSError: Something cannot be read now.
        MemoryError: There is no room for something.
    """
    root, findings = Path(root), list[Finding]()
    info = _read_info(root, like, findings)
    schema = _schema(root, info)
    found = [
        frames
        for path in list_files(root, "data/*/*.parquet")
        if (file := _open(root, path, schema, rescue, findings)) is not None
        for frames in _read_frames(root, file, info, thorough, findings)
    ]
    rows = _read_rows(root, sum(frames.length for frames in found), findings)
    episodes = _find_films(root, info, _match(root, found, rows, info), thorough)
    tasks = _read_tasks(root, episodes, findings)
    findings += _judge_episodes(info, episodes)
    findings += _judge_counts(root, info, episodes, found)
    return Survey(root, info, schema, episodes, tasks, findings)


def _wrong(check: str, said: str, episodes: Sequence[int] = (), remedy: str = "", key: str | None = None) -> Finding:
    return Finding(check, "error", said, key, episodes, remedy=remedy)


def _read_info(root: Path, like: Path | None, findings: list[Finding]) -> dict[str, Any]:
    check_there(root)
    known = None if like is None else read_info(like)
    remedy = f"Put it back from a copy, or: {repair_command(root)} --like=<folder of a dataset with the same settings>"
    try:
        if not is_listed(root, INFO_PATH):
            raise InfoError(f"{root / INFO_PATH} is missing. {remedy}.")
        info = read_info(root)
    except InfoError as error:
        if known is None:
            raise DatasetDamagedError(str(error)) from error
        findings.append(_wrong("info", f"{INFO_PATH} cannot be read; it is made from that of {like}"))
        return known
    if known is not None and any(info[name] != known[name] for name in ("fps", "features")):
        findings.append(_wrong("info", f"{INFO_PATH}: its frame rate and features become those of {like}"))
        info = {**info, "fps": known["fps"], "features": known["features"]}
    for key in (key for key in audio_keys(info["features"]) if info["features"][key]["dtype"] != AUDIO_DTYPE):
        try:
            check_audio_features({key: info["features"][key]}, info["fps"])
        except ValueError as error:
            said = str(error).removeprefix(f"'{key}' ").rstrip(".")
            findings.append(_wrong("sample rate", said, remedy=f"Correct it in {INFO_PATH}", key=key))
    return info


def _schema(root: Path, info: Info) -> pa.Schema:
    in_rows = {key: feature for key, feature in info["features"].items() if feature["dtype"] != AUDIO_DTYPE}
    try:
        return arrow_schema(in_rows)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise DatasetDamagedError(f"{root / INFO_PATH}: LeRobot knows no such feature: {error}. Correct it.") from error


# Frames


def _open(root: Path, path: Path, schema: pa.Schema, rescue: Rescue | None, findings: list[Finding]) -> DataFile | None:
    """A data file that is whole, or what can be rescued of it."""
    name = path.relative_to(root)
    try:
        file = DataFile(path)
    except ParquetDamageError as error:
        footer = rescue(path, schema) if rescue else None
        if footer is not None:
            said = f"{name} has no valid end, as if the recording had been killed: it is read from its beginning"
            findings.append(_wrong("files", said))
            return DataFile(path, footer)
        findings.append(_wrong("files", f"{name} is truncated or not a parquet file ({error})"))
        return None
    if problem := _difference(file.schema, schema):
        like = f"{repair_command(root)} --like=<folder of a dataset with the same settings>"
        remedy = f"Correct the features in {INFO_PATH}, or: {like}"
        findings.append(_wrong("files", f"{name}: {problem}", remedy=remedy))
        return None
    return file


def _difference(found: pa.Schema, wanted: pa.Schema) -> str | None:
    """In what a file's columns differ from the dataset's features."""
    if sorted(found.names) != sorted(wanted.names):
        names = ", ".join(sorted(set(found.names) ^ set(wanted.names))) or "one comes twice"
        return f"its columns are not the dataset's features: {names}"
    for column in wanted:
        own, kind = found.field(column.name).type, column.type
        is_whole = column.name in INDEX_COLUMNS and pa.types.is_integer(kind)
        if not are_alike(own, kind) or (is_whole and not pa.types.is_integer(own)):
            return f"its column '{column.name}' is {own}; wanted {kind}"
    return None


def _read_frames(root: Path, file: DataFile, info: Info, thorough: bool, findings: list[Finding]) -> Iterator[Frames]:
    """A file's rows, cut where another episode begins or frames are missing."""
    name = file.path.relative_to(root)
    cameras = [key for key, feature in info["features"].items() if feature["dtype"] == "image"] if thorough else []
    parts: list[dict[str, np.ndarray]] = []
    spoilt: dict[int, str] = {}
    for first, table in file.row_groups(None if thorough else list(INDEX_COLUMNS)):
        try:
            if isinstance(table, ParquetDamageError):
                raise table
            part = {key: column_to_numpy(table.column(key)) for key in INDEX_COLUMNS}
        except ValueError as error:
            findings.append(_wrong("files", f"{name}: rows from {first} on are damaged: {error}"))
            continue
        parts.append({**part, "row": first + np.arange(len(table))})
        for key in cameras:
            for row, problem in _damaged_pictures(root, table, key, info["features"][key]):
                spoilt[first + row] = f"a picture of '{key}' {problem}"
    if not parts:
        return
    index = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    steps = {key: np.diff(values) for key, values in index.items()}
    breaks = (steps["episode_index"] != 0) | (steps["frame_index"] != 1) | (steps["row"] != 1)
    if breaks.sum() > _MOST_PIECES:
        said = f"{name}: its rows are of {breaks.sum() + 1:,} pieces of episodes, which nobody recorded"
        findings.append(_wrong("files", said))
        return
    for start, stop in itertools.pairwise([0, *(np.flatnonzero(breaks) + 1).tolist(), len(index["row"])]):
        own = {key: values[start:stop] for key, values in index.items()}
        late = np.abs(own["timestamp"] - own["frame_index"] / info["fps"])
        yield Frames(
            file,
            start=int(own["row"][0]),
            length=stop - start,
            episode=int(own["episode_index"][0]),
            first_frame=int(own["frame_index"][0]),
            first_index=int(own["index"][0]),
            is_numbered=bool((np.diff(own["index"]) == 1).all()),
            is_timely=bool((late <= _TIME_TOLERANCE_S).all()),  # also not where it is NaN
            tasks=tuple(np.unique(own["task_index"]).tolist()),
            damage=next((spoilt[row] for row in own["row"].tolist() if row in spoilt), None) if spoilt else None,
        )


def _damaged_pictures(root: Path, table: pa.Table, key: str, feature: Mapping[str, Any]) -> Iterator[tuple[int, str]]:
    """Of every damaged picture of a camera its row, and what is wrong with it. Those in files of their own stay there."""
    for row, picture in enumerate(value.as_py() for value in table.column(key)):
        try:
            if picture["bytes"] is not None:
                with open_picture(picture, root, key, feature) as image:
                    image.verify()
        except UnidentifiedImageError:
            yield row, "is damaged (it is none)"
        except (OSError, SyntaxError, ValueError, TypeError, Image.DecompressionBombError) as error:
            yield row, f"is damaged ({error})"


# Episodes


def _read_rows(root: Path, n_frames: int, findings: list[Finding]) -> dict[int, dict[str, Any]]:
    """The rows of all tables of episodes, by the episode's number: no more than there are frames, unless frames are lost."""
    rows: dict[int, dict[str, Any]] = {}
    for path in list_files(root, f"{EPISODES_DIR}/*/*.parquet"):
        name = path.relative_to(root)
        try:
            if (n_rows := DataFile(path).n_rows) > max(n_frames, _MOST_LOST):
                raise ParquetDamageError(f"it has rows of {n_rows:,} episodes, and there are {n_frames:,} frames")
            found = read_table(path).to_pylist()
        except ParquetDamageError as error:
            findings.append(_wrong("rows", f"{name} cannot be read: {error}"))
            continue
        for row in found:
            number = row.get("episode_index")
            if not isinstance(number, int) or number in rows:
                said = "names no episode" if not isinstance(number, int) else f"names episode {number} a second time"
                findings.append(_wrong("rows", f"a row of {name} {said}"))
            else:
                rows[number] = row
    return rows


def _match(root: Path, found: Iterable[Frames], rows: dict[int, dict[str, Any]], info: Info) -> list[Episode]:
    """Finds each episode's frames."""
    frames_of: dict[int, list[Frames]] = defaultdict(list)
    for frames in found:
        frames_of[frames.episode].append(frames)
    episodes = []
    for number in sorted({*frames_of, *rows}):
        row = rows.get(number, {})
        name = data_path(info, row)
        own = sorted(frames_of[number], key=lambda frames: str(frames.file.path.relative_to(root)) != name)
        episodes.append(replace(_choose(number, own, row), row=row))
    return episodes


def _choose(number: int, found: Sequence[Frames], row: Mapping[str, Any]) -> Episode:
    """The frames of an episode, if it is whole. Its row counts them in two ways, of which one may be wrong."""
    length, first, end = (row.get(name) for name in ("length", "dataset_from_index", "dataset_to_index"))
    lengths = {end - first} if isinstance(first, int) and isinstance(end, int) else set[int]()
    lengths |= {length} if isinstance(length, int) else set()
    whole = [frames for frames in found if frames.first_frame == 0 and (not lengths or frames.length in lengths)]
    sound = [frames for frames in whole if frames.damage is None]
    if sound:
        return Episode(number, sound[0])
    if whole:
        reason = str(whole[0].damage)
    elif found and lengths:
        wanted = " or ".join(map(str, sorted(lengths)))
        reason = f"{sum(frames.length for frames in found)} of its {wanted} frames are left"
    else:
        reason = "its first frames are lost" if found else "its frames are lost"
    return Episode(number, reason=reason)


def _find_films(root: Path, info: Info, episodes: list[Episode], thorough: bool) -> list[Episode]:
    """Finds each episode's pictures in films. An episode without them is lost."""
    for key, feature in info["features"].items():
        if feature["dtype"] == "video":
            lengths = [episode.frames.length if episode.frames else None for episode in episodes]
            said = [place_in_row(episode.row, key) for episode in episodes]
            for i, place in enumerate(find_places(root, info, key, lengths, said, thorough)):
                if isinstance(place, str):
                    reason = f"its pictures of '{key}' are lost: {place}"
                    episodes[i] = replace(episodes[i], frames=None, reason=reason)
                elif place is not None:
                    episodes[i].places[key] = place
    for i, episode in enumerate(episodes):
        if episode.frames and episode.row:
            episodes[i] = replace(episode, contradiction=_contradiction(root, info, episode, episode.frames))
    return episodes


def _contradiction(root: Path, info: Info, episode: Episode, frames: Frames) -> str | None:
    """What an episode's row says that its frames and films do not."""
    row, end = episode.row, frames.first_index + frames.length
    said = {"length": frames.length, "dataset_from_index": frames.first_index, "dataset_to_index": end}
    for key, place in episode.places.items():
        said |= place.columns(key)
    for name, value in said.items():
        if row.get(name) != value:
            return f"its {name} is {row.get(name)!r}; wanted {value!r}"
    file = data_path(info, row)
    if file is None or root / file != frames.file.path:
        return f"its frames are in {frames.file.path.relative_to(root)}, not in {file}"
    if not isinstance(row.get("tasks"), list):
        return "its tasks are missing"
    names: dict[str, set[str]] = defaultdict(set)
    for column, value in row.items():
        if column.startswith("stats/") and column.count("/") > 1 and value is not None:
            key, name = column.removeprefix("stats/").rsplit("/", 1)
            names[key].add(name)
            if not are_numbers(value):
                return f"its statistics '{key}/{name}' are not numbers"
    if len(set(map(frozenset, names.values()))) > 1:
        return "parts of its statistics are missing"
    return None


def data_path(info: Info, row: Mapping[str, Any]) -> str | None:
    """Where an episode's row says that its frames are; None where it does not."""
    try:
        return info["data_path"].format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
    except (KeyError, ValueError, TypeError):
        return None


def _judge_episodes(info: Info, episodes: Sequence[Episode]) -> Iterator[Finding]:
    lost: dict[str, list[int]] = defaultdict(list)
    for episode in episodes:
        if not episode.frames:
            lost[episode.reason].append(episode.number)
        elif episode.contradiction:
            said = f"the row of episode {episode.number} in {EPISODES_DIR} is wrong: {episode.contradiction}"
            yield _wrong("rows", said, [episode.number])
    for reason, numbers in lost.items():
        yield _wrong("rows", f"{name_episodes(numbers)}: {reason}", numbers)
    if without := [episode.number for episode in episodes if episode.frames and not episode.row]:
        yield _wrong("rows", f"the rows of {name_episodes(without)} in {EPISODES_DIR} are lost", without)
    whole = [(episode.number, episode.frames) for episode in episodes if episode.frames]
    if mixed := [number for number, frames in whole if not frames.is_numbered]:
        yield _wrong("rows", f"{name_episodes(mixed)}: frames are not numbered one after the other in 'index'", mixed)
    if untimely := [number for number, frames in whole if not frames.is_timely]:
        said = f"{name_episodes(untimely)}: timestamps are not frame / fps at {info['fps']} frames per second"
        yield _wrong("times", said, untimely, f"If they are right, correct fps in {INFO_PATH}")


# What is said of the whole dataset


def _judge_counts(root: Path, info: Info, episodes: Sequence[Episode], found: Sequence[Frames]) -> Iterator[Finding]:
    n_frames = sum(episode.frames.length for episode in episodes if episode.frames)
    is_whole = all(episode.frames for episode in episodes)
    if info["total_episodes"] != len(episodes) or (is_whole and info["total_frames"] != n_frames):
        counted = f"{INFO_PATH} counts {info['total_episodes']} episodes of {info['total_frames']} frames in all"
        yield _wrong("rows", f"{counted}; there are {len(episodes)} of {n_frames}")
    used = {(each.frames.file.path, each.frames.start) for each in episodes if each.frames}
    firsts = [each.first_index for each in found if (each.file.path, each.start) in used]
    if firsts != sorted(firsts):
        yield _wrong("rows", "the data files are not in the order of their frames, in which LeRobot reads them")
    if is_whole and (others := [each for each in found if (each.file.path, each.start) not in used]):
        names = sorted({each.file.path.relative_to(root).as_posix() for each in others})
        n_others = sum(each.length for each in others)
        yield _wrong("rows", f"{', '.join(names)}: {n_others} frames belong to no episode")
    expected = 0
    for place, episode in enumerate(episodes):
        if episode.frames is None:
            break
        if (episode.number, episode.frames.first_index) != (place, expected):
            said = f"episode {episode.number} begins with frame {episode.frames.first_index}; wanted episode {place}, frame"
            yield _wrong("rows", f"{said} {expected}", [episode.number])
            break
        expected += episode.frames.length
    try:
        if is_listed(root, STATS_PATH):
            with naming(root / STATS_PATH):
                parse_stats((root / STATS_PATH).read_bytes())
        elif n_frames:
            yield _wrong("statistics", f"{STATS_PATH} is missing")
    except ValueError as error:
        yield _wrong("statistics", f"{STATS_PATH} cannot be read: {error}")


def _read_tasks(root: Path, episodes: Sequence[Episode], findings: list[Finding]) -> dict[int, str]:
    """The text of each task. Where the table lacks one, what all episodes of only this task say in their rows."""
    whole = [(episode, episode.frames) for episode in episodes if episode.frames]
    said: dict[int, dict[str, list[int]]] = defaultdict(lambda: defaultdict(list))
    for episode, frames in whole:
        texts = episode.row.get("tasks")
        if isinstance(texts, list) and len(texts) == len(frames.tasks) == 1:
            said[frames.tasks[0]][str(texts[0])].append(episode.number)
    wanted = sorted({task for _, frames in whole for task in frames.tasks})
    known, problem = _tasks_in_table(root)
    if problem and wanted:
        findings.append(_wrong("tasks", f"{TASKS_PATH} {problem}; its texts are those that the episodes' rows say"))
        n_frames = sum(frames.length for _, frames in whole)
        texts = {task: next(iter(said[task])) if len(said[task]) == 1 else unknown_task(task) for task in wanted}
        known = {task: text for task, text in texts.items() if task < n_frames}
    if nameless := sorted(set(wanted) - set(known)):
        remedy = "Put a table from a copy in its place, or correct the frames' task_index"
        text = f"{TASKS_PATH}: frames are of task {', '.join(map(str, nameless[:8]))}, which has no text"
        findings.append(_wrong("tasks", text, remedy=remedy))
    for task, text, numbers in ((each, text, own) for each in wanted for text, own in said[each].items()):
        if text != known.get(task, text) and not problem:
            others = name_episodes(numbers)
            message = f"{TASKS_PATH}: task {task} reads {known[task]!r}; the rows of {others} say {text!r}"
            remedy = f"If nobody renamed it, give them the right one: {task_command(root, numbers, text)}"
            findings.append(Finding("tasks", "warning", message, episodes=numbers, remedy=remedy))
    return known


def unknown_task(number: int) -> str:
    """What stands for a text that is lost."""
    return f"unknown task {number}"


def _tasks_in_table(root: Path) -> tuple[dict[int, str], str | None]:
    """The tasks' texts, and what is wrong with their table: LeRobot finds a task by its place."""
    path = root / TASKS_PATH
    if not is_listed(root, TASKS_PATH):
        return {}, "is missing"
    try:
        table = read_table(path).to_pandas()  # LeRobot's way: the file says twice what the columns are
        known = dict(zip(table["task_index"].astype(int).tolist(), table.index.astype(str), strict=True))
    except (pa.ArrowException, LookupError, ValueError, TypeError, OverflowError) as error:
        return {}, f"cannot be read ({error})"
    return known, None if list(known) == list(range(len(known))) else "does not number its tasks from 0 on"
