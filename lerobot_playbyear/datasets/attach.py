"""`playbyear-attach-audio`: a copy of a LeRobotDataset with sound from files that were recorded beside it."""

import itertools
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import write_info
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import EPISODES_DIR, INFO_PATH, DatasetInfo
from lerobot.utils.constants import DEFAULT_FEATURES, HF_LEROBOT_HOME
from tqdm import tqdm

from lerobot_playbyear.datasets.audio_feature import AUDIO_PREFIX, audio_feature
from lerobot_playbyear.datasets.audio_files import AudioFileError, Cut, Resampled, audio_pieces
from lerobot_playbyear.datasets.columns import column_to_numpy
from lerobot_playbyear.datasets.confines import check_links
from lerobot_playbyear.datasets.files import list_files
from lerobot_playbyear.datasets.journal import flush
from lerobot_playbyear.datasets.opening import LongDataset, open_dataset, scratch_folder
from lerobot_playbyear.datasets.parquet_files import (
    ParquetDamageError,
    open_checked,
    read_row_groups,
    read_table,
    write_tables,
)
from lerobot_playbyear.datasets.settling import write_rows
from lerobot_playbyear.datasets.spooled_sound import EpisodesSound, SpooledFile
from lerobot_playbyear.datasets.statistics import Stats, add_stats, read_stats, write_stats

_MOST_ERRORS = 10  # that are listed


class AttachError(ValueError):
    """Sound cannot be attached; nothing was written."""


@dataclass
class DatasetPlace:
    """A dataset's name and place.

    Args:
        repo_id: Its name, `user/name`.
        root: Its folder. None: in LeRobot's own cache, under its name.
    """

    repo_id: str
    root: str | None = None


@dataclass
class AttachAudioConfig:
    """Options of `playbyear-attach-audio`.

    Args:
        dataset: The dataset that gets sound; it is not changed. Without a root it may come from the Hub.
        output: The copy with sound.
        files: The sound of each episode: a path in which `{episode}` stands for the episode's number, for example
            `sound/{episode:06d}.wav`. WAV, FLAC, or a film whose sound track is taken.
        microphone: What the microphone is called: the column is `observation.audio.<microphone>`. For files of
            several channels, a name for each, separated by commas.
        channel: Take only this channel of the files, counted from 0.
        offset: Where in its file each episode's first frame was taken [s]; negative where the file begins after it.
        offsets: A JSON file with a list of offsets [s], one per episode, in addition to `offset`.
        sample_rate: Resample to this rate [Hz]. None keeps the files' own.
        pad: Fill what a file lacks at its beginning or its end with silence; otherwise that is an error.
    """

    dataset: DatasetPlace
    output: DatasetPlace
    files: str
    microphone: str = "microphone"
    channel: int | None = None
    offset: float = 0.0
    offsets: Path | None = None
    sample_rate: int | None = None
    pad: bool = False


def attach_audio(cfg: AttachAudioConfig) -> Path:
    """Copies a dataset and adds a microphone.

    Args:
        cfg: The options.

    Returns:
        The copy's folder. It is there only when it is complete.

    Raises:
        AttachError: Naming every episode whose sound is missing, too short, or of another kind.
        OSError: The copy cannot be written.
    """
    target = Path(cfg.output.root) if cfg.output.root else HF_LEROBOT_HOME / cfg.output.repo_id
    if target.exists():
        raise AttachError(f"{target} is there already. Choose another --output.root, or delete it.")
    dataset = _open(cfg.dataset)
    keys = _keys(cfg, dataset)
    with scratch_folder() as scratch:
        sound = _read_sound(cfg, dataset, keys, Path(scratch))
        _write(Path(dataset.root), target, sound)
    print(f"\nDataset: {target} ({dataset.num_episodes} episodes with {', '.join(keys)} at {sound.sample_rate} Hz)")
    return target


def _write(root: Path, target: Path, sound: EpisodesSound) -> None:
    """The copy, which is there only when it is complete."""
    unfinished = target.absolute().with_name(f".{target.name}.attaching")
    shutil.rmtree(unfinished, ignore_errors=True)  # of one that was killed
    try:
        unfinished.mkdir(parents=True)
        _write_copy(root, unfinished, sound)
        for path in [*unfinished.rglob("*"), unfinished]:
            flush(path)
        os.rename(unfinished, target)
        flush(target.absolute().parent)
    except ParquetDamageError as error:
        raise AttachError(f"{error} Repair it first: playbyear-repair --root={root}") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _open(place: DatasetPlace) -> LeRobotDataset | LongDataset:
    if place.root is not None and not (Path(place.root) / INFO_PATH).is_file():
        raise AttachError(f"There is no dataset in {place.root}: it has no {INFO_PATH}. Correct --dataset.root.")
    try:
        dataset = open_dataset(place.repo_id, place.root, video_backend="pyav")
        check_links(Path(dataset.root))  # the copy would hold what they lead to
        for path in list_files(Path(dataset.root), f"{EPISODES_DIR}/*/*.parquet"):
            _read_table(path, ["length"])  # LeRobot looks at no checksum
        return dataset
    except ParquetDamageError as error:
        raise AttachError(f"{error} Repair it first: playbyear-repair --root={dataset.root}") from error
    except Exception as error:  # also what the Hub's client raises
        raise AttachError(f"The dataset '{place.repo_id}' cannot be opened: {error}") from error


def _keys(cfg: AttachAudioConfig, dataset: LeRobotDataset | LongDataset) -> list[str]:
    names = [name.strip() for name in cfg.microphone.split(",")]
    keys = [name if name.startswith(AUDIO_PREFIX) else AUDIO_PREFIX + name for name in names]
    for key in keys:
        if "/" in key or key == AUDIO_PREFIX or keys.count(key) > 1:
            raise AttachError(f"--microphone={cfg.microphone}: give each microphone a name of its own, without '/'.")
        if key in dataset.meta.features:
            raise AttachError(f"'{key}' is in the dataset already. Give another --microphone.")
    if "{episode" not in cfg.files:
        raise AttachError(f"--files={cfg.files}: say with {{episode}} where the episode's number stands.")
    if cfg.channel is not None and len(keys) > 1:
        raise AttachError(f"--channel={cfg.channel} is for one microphone; --microphone names {len(keys)}.")
    return keys


def _read_sound(
    cfg: AttachAudioConfig, dataset: LeRobotDataset | LongDataset, keys: list[str], scratch: Path
) -> EpisodesSound:
    """Decodes all files, so that what is wrong with them is known before anything is written."""
    offsets = _offsets(cfg, dataset.num_episodes)
    lengths = [int(length) for length in dataset.meta.episodes["length"]]
    errors: list[str] = []
    rates: dict[int, int] = {}
    episodes: list[Cut] = []
    for episode, length in enumerate(tqdm(lengths, desc="Reading sound", unit="episode")):
        path = Path(_format(cfg.files, episode))
        try:
            samples, rate = _spool(cfg, path, len(keys), scratch / str(episode))
            rates[episode] = cfg.sample_rate or rate
            if rates[episode] % dataset.fps:
                raise AudioFileError(
                    f"it has {rate} samples per second, which is no multiple of {dataset.fps} frames per second. "
                    f"Resample it, for example with --sample_rate={max(1, round(rate / dataset.fps)) * dataset.fps}."
                )
            resampled = Resampled(samples, rate, rates[episode])
            episodes.append(Cut(resampled, rates[episode], dataset.fps, length, offsets[episode], cfg.pad))
        except (AudioFileError, ValueError) as error:
            errors.append(f"episode {episode}, {path}: {error}")
    if len(set(rates.values())) > 1:
        each = ", ".join(
            f"{rate} Hz (episode {list(rates.values()).index(rate)})" for rate in sorted(set(rates.values()))
        )
        errors.append(f"the files have different sample rates, {each}. Give --sample_rate to resample them.")
    if errors:
        more = f"\n  ... and {len(errors) - _MOST_ERRORS} more" if len(errors) > _MOST_ERRORS else ""
        raise AttachError("Nothing was written.\n  " + "\n  ".join(errors[:_MOST_ERRORS]) + more)
    return EpisodesSound(rates[0], keys, rates[0] // dataset.fps, episodes)


def _spool(cfg: AttachAudioConfig, path: Path, n_microphones: int, target: Path) -> tuple[SpooledFile, int]:
    """Decodes the channels of a file that are wanted; the samples, and their rate [Hz]."""
    rate = 0
    with target.open("wb") as file:
        for samples, found in audio_pieces(path):
            rate = found
            file.write(np.ascontiguousarray(_choose_channels(cfg, samples, n_microphones)).tobytes())
    return SpooledFile(target, n_microphones), rate


def _format(pattern: str, episode: int) -> str:
    try:
        return pattern.format(episode=episode)
    except (KeyError, IndexError, ValueError) as error:
        raise AttachError(
            f"--files={pattern} cannot be filled in: {error}. Only {{episode}} may stand in it."
        ) from error


def _offsets(cfg: AttachAudioConfig, n_episodes: int) -> list[float]:
    if cfg.offsets is None:
        return [cfg.offset] * n_episodes
    try:
        values = [float(value) for value in json.loads(cfg.offsets.read_text())]
    except (OSError, ValueError, TypeError) as error:
        raise AttachError(f"--offsets={cfg.offsets} is no list of numbers in JSON: {error}") from error
    if len(values) != n_episodes:
        raise AttachError(f"--offsets={cfg.offsets} has {len(values)} values; the dataset has {n_episodes} episodes.")
    return [cfg.offset + value for value in values]


def _choose_channels(cfg: AttachAudioConfig, samples: np.ndarray, n_microphones: int) -> np.ndarray:
    n_channels = samples.shape[1]
    if cfg.channel is not None:
        if not 0 <= cfg.channel < n_channels:
            raise AudioFileError(f"it has {n_channels} channels; there is no --channel={cfg.channel}.")
        return samples[:, [cfg.channel]]
    if n_channels != n_microphones:
        raise AudioFileError(
            f"it has {n_channels} channels, and --microphone names {n_microphones}. Choose one with --channel=0, or "
            "name a microphone for each, separated by commas."
        )
    return samples


def _write_copy(root: Path, target: Path, sound: EpisodesSound) -> None:
    info = DatasetInfo.from_dict(json.loads((root / INFO_PATH).read_text()))
    info.features = _with_microphones(info.features, sound, info.fps)
    schema = get_hf_features_from_features(info.features).arrow_schema
    stats = [sound.stats(episode) for episode in range(len(sound.episodes))]
    paths = sorted(path for path in root.rglob("*") if path.is_file() and not _is_scratch(path.relative_to(root)))
    for path in tqdm(paths, desc="Writing", unit="file"):
        name = path.relative_to(root)
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        if name.parts[0] == "data":
            _write_data(path, target / name, schema, sound)
        elif name.parts[:2] == ("meta", "episodes"):
            _write_rows(path, target / name, stats)
        elif name != Path(INFO_PATH):
            shutil.copyfile(path, target / name)
    known = read_stats(root) or {}
    write_stats({**known, **add_stats(None, stats, sound.keys)}, target)
    write_info(info, target)


def _is_scratch(name: Path) -> bool:
    return name.parts[0] in ("images", ".cache", ".git")


def _with_microphones(features: dict[str, dict], sound: EpisodesSound, fps: int) -> dict[str, dict[str, Any]]:
    own = {key: feature for key, feature in features.items() if key not in DEFAULT_FEATURES}
    return {
        **own,
        **{key: audio_feature(sound.sample_rate, fps) for key in sound.keys},
        **{key: feature for key, feature in features.items() if key in DEFAULT_FEATURES},
    }


def _write_data(source: Path, target: Path, schema: pa.Schema, sound: EpisodesSound) -> None:
    with open_checked(source) as file:
        metadata = file.schema_arrow.metadata or {}
        if b"huggingface" in metadata:
            metadata = {**metadata, **(schema.metadata or {})}
        first = file.schema_arrow.empty_table()

        def add(table: pa.Table) -> pa.Table:
            try:
                return _with_columns(table, schema, sound, metadata)
            except ValueError as error:
                raise ParquetDamageError(f"{source} is damaged: {error}.") from error

        write_tables(target, map(add, _tables(file, source, sound.rows_at_once)), add(first).schema)


def _tables(file: Any, source: Path, rows: int) -> Iterator[pa.Table]:
    for table in read_row_groups(file):
        if isinstance(table, ParquetDamageError):
            raise ParquetDamageError(f"{source} is damaged: {table}.")
        for start in range(0, len(table), rows):
            yield table.slice(start, rows)


def _with_columns(table: pa.Table, schema: pa.Schema, sound: EpisodesSound, metadata: dict[bytes, bytes]) -> pa.Table:
    episodes = column_to_numpy(table.column("episode_index"))
    frames = column_to_numpy(table.column("frame_index"))
    edges = np.flatnonzero((np.diff(episodes) != 0) | (np.diff(frames) != 1)) + 1
    spans = list(itertools.pairwise([0, *edges.tolist(), len(table)])) if len(table) else []
    for first, stop in spans:
        sound.check(int(episodes[first]), int(frames[first]), int(frames[stop - 1]))
    parts = [sound.blocks(int(episodes[a]), int(frames[a]), int(frames[a]) + b - a) for a, b in spans]
    blocks = np.concatenate(parts) if parts else np.zeros((0, sound.samples_per_frame, len(sound.keys)), np.int16)
    for i, key in enumerate(sound.keys):
        kind = schema.field(key).type
        samples = pa.array(np.ascontiguousarray(blocks[..., i]).reshape(-1))
        column = pa.FixedSizeListArray.from_arrays(samples, kind.list_size).cast(kind)
        table = table.append_column(pa.field(key, kind), column)
    return table.replace_schema_metadata(metadata)


def _read_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    try:
        return read_table(path, columns)
    except ParquetDamageError as error:
        raise ParquetDamageError(f"{path} is damaged: {error}.") from error


def _write_rows(source: Path, target: Path, stats: list[Stats]) -> None:
    table = _read_table(source)
    episodes = table.column("episode_index").to_pylist()
    for key in stats[0]:
        for name in stats[0][key]:
            values = pa.array([stats[episode][key][name].tolist() for episode in episodes])
            table = table.append_column(f"stats/{key}/{name}", values)
    write_rows(table.replace_schema_metadata(None), target)
