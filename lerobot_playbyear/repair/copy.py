"""The repaired copy of a dataset: every episode that a survey calls whole; what is wrong around it is made again."""

import shutil
from collections.abc import Collection, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
from lerobot.datasets.compute_stats import sample_indices
from lerobot.datasets.io_utils import write_json, write_tasks

from lerobot_playbyear.audio.recorder_clock import renumber_episode_starts
from lerobot_playbyear.datasets import statistics
from lerobot_playbyear.datasets.features import is_depth
from lerobot_playbyear.datasets.files import DEFAULT_DATA_PATH, EPISODES_DIR, INFO_PATH, entries_below, fits
from lerobot_playbyear.datasets.info import STATS_PATH
from lerobot_playbyear.datasets.parquet import write_rows, write_tables
from lerobot_playbyear.datasets.pictures import is_unsaved, named_pictures
from lerobot_playbyear.datasets.reader import SurveyedDataset
from lerobot_playbyear.datasets.survey import TASKS_PATH, Episode, Frames, Survey, unknown_task

_REMADE = (INFO_PATH, STATS_PATH, TASKS_PATH, "data/*/*.parquet", f"{EPISODES_DIR}/*/*.parquet")


def write_copy(survey: Survey, target: Path) -> None:
    """Writes a whole dataset.

    Args:
        survey: Of the damaged one.
        target: An empty folder.

    Raises:
        ValueError: A picture or a film lies outside the dataset's folder, or a picture has another size than its feature.
        OSError: Something cannot be read now, or written.
    """
    _copy_rest(survey, target)
    renumber_episode_starts(target, {episode.number: number for number, episode in enumerate(survey.whole)})
    rows = sorted(_write_data(survey, target), key=lambda row: row["episode_index"])
    columns = dict.fromkeys(column for row in rows for column in row)
    table = pa.table({column: [row.get(column) for row in rows] for column in columns})
    write_rows(table, target / EPISODES_DIR / "chunk-000/file-000.parquet")
    if not any(each.check == "tasks" for each in survey.damage):
        shutil.copy2(survey.root / TASKS_PATH, target / TASKS_PATH)  # it may have columns of its own
    else:
        numbers = range(max(survey.tasks, default=-1) + 1)  # LeRobot finds a task by its place
        texts = [survey.tasks.get(number, unknown_task(number)) for number in numbers]
        write_tasks(pd.DataFrame({"task_index": list(numbers)}, index=pd.Index(texts, name="task")), target)
    statistics.write_stats(statistics.add_stats(None, map(statistics.row_stats, rows)), target)
    n_frames = sum(row["length"] for row in rows)
    counts = {"total_episodes": len(rows), "total_frames": n_frames, "total_tasks": len(survey.tasks)}
    is_complete = len(rows) == len(survey.episodes)
    splits = survey.info.get("splits") if is_complete else {"train": f"0:{len(rows)}"}
    write_json({**survey.info, **counts, "splits": splits, "data_path": DEFAULT_DATA_PATH}, target / INFO_PATH)


def _copy_rest(survey: Survey, target: Path) -> None:
    """Films, a card, notes, files of other tools: all but the frames, the tables and what an unsaved episode left."""
    features, whole = survey.info["features"], (episode.frames for episode in survey.whole)
    named = named_pictures(survey.root, {frames.file for frames in whole if frames}, features)
    for path in entries_below(survey.root):
        name = path.relative_to(survey.root)
        if path.is_file() and not _is_scratch(name, features, named) and not fits(name, *_REMADE):
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, target / name)  # no link: LeRobot may write into a film that is there


def _is_scratch(name: Path, features: Collection[str], named: Collection[str]) -> bool:
    """Whether a file is what was only needed while an episode was written."""
    inside = name.parts[1:2]
    return is_unsaved(name, named) and bool(inside) and (inside[0] in features or inside[0].startswith("."))


class _Kept(NamedTuple):
    """A whole episode, with its number and that of its first frame in the copy."""

    episode: Episode
    frames: Frames
    number: int
    first_index: int

    def numbers(self) -> dict[str, np.ndarray]:
        """The columns of its frames that change, (n,)."""
        index = np.arange(self.first_index, self.first_index + self.frames.length)
        return {"episode_index": np.full(len(index), self.number), "index": index}

    def table(self) -> pa.Table:
        """Its frames."""
        table = self.frames.file.read(self.frames.start, self.frames.start + self.frames.length)
        for key, values in self.numbers().items():
            field = table.schema.field(key)
            table = table.set_column(table.column_names.index(key), field, pa.array(values, field.type))
        return table


def _write_data(survey: Survey, target: Path) -> Iterator[dict[str, Any]]:
    """Writes the frames, file by file. Returns the episodes' rows."""
    dataset, first_index = SurveyedDataset(survey.root.name, survey), 0
    every: list[_Kept] = []
    for number, episode in enumerate(survey.whole):
        assert episode.frames is not None
        every.append(_Kept(episode, episode.frames, number, first_index))
        first_index += episode.frames.length
    # The order of the files is that of the frames, whatever it was.
    for place, kept in enumerate(list(own) for _, own in groupby(every, lambda one: one.frames.file.path)):
        chunk, number = divmod(place, survey.info["chunks_size"])
        name = target / DEFAULT_DATA_PATH.format(chunk_index=chunk, file_index=number)
        write_tables(name, (one.table() for one in kept), kept[0].frames.file.schema)
        for one in kept:
            places = {"episode_index": one.number, "data/chunk_index": chunk, "data/file_index": number}
            end = one.first_index + one.frames.length
            places |= {"dataset_from_index": one.first_index, "dataset_to_index": end}
            places |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
            yield {**_row(dataset, one), **places}


def _row(dataset: SurveyedDataset, kept: _Kept) -> dict[str, Any]:
    """An episode's row: its own, with the statistics of its new numbers, or one that is made again."""
    places = {name: value for key, own in kept.episode.places.items() for name, value in own.columns(key).items()}
    row = kept.episode.row
    if not row or kept.episode.contradiction:
        texts = [dataset.tasks.get(task, unknown_task(task)) for task in kept.frames.tasks]
        stats = statistics.stats_columns(_episode_stats(dataset, kept))
        return {"tasks": texts, "length": kept.frames.length, **stats, **places}
    moved = statistics.stats_columns(statistics.numeric_stats(kept.numbers(), dataset.features))
    return {**row, **{name: value for name, value in moved.items() if name in row}, **places}


def _episode_stats(dataset: SurveyedDataset, kept: _Kept) -> statistics.Stats:
    """The statistics of one episode, as LeRobot has them: of pictures, from as many as it samples.

    Raises:
        ValueError: A picture or a film lies outside the folder, or a picture has another size than the feature says.
    """
    (episode,) = (each for each in dataset.episodes if each.index == kept.episode.number)
    numbers: dict[str, np.ndarray] = {}
    stats: statistics.Stats = {}
    sampled = set(sample_indices(len(episode)))
    for key, feature in dataset.features.items():
        if is_depth(feature) or feature["dtype"] in ("string", "language"):
            continue
        if feature["dtype"] in ("image", "video"):
            pictures = enumerate(dataset.pictures(key, episode))
            stats[key] = statistics.picture_stats(picture for number, picture in pictures if number in sampled)
        else:
            numbers[key] = dataset.values(key, episode)
    return {**statistics.numeric_stats(numbers | kept.numbers(), dataset.features), **stats}
