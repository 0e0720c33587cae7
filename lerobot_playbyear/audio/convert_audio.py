"""`playbyear-convert-audio`: a copy of a dataset with its sound in columns instead of files, or in files instead of columns.

LeRobot is imported when the dataset's files have been looked at.
"""

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pyarrow as pa

from lerobot_playbyear.audio.attach import DatasetPlace, new_folder, open_for_copy, write_new_dataset
from lerobot_playbyear.audio.audio_layout import DEFAULT_AUDIO_PATH, AudioTrack, column_names, read_tracks
from lerobot_playbyear.datasets.columns import check_dataset_files
from lerobot_playbyear.datasets.confines import check_links
from lerobot_playbyear.datasets.errors import InputError, errors_of_input
from lerobot_playbyear.datasets.files import EPISODES_DIR, HF_LEROBOT_HOME, INFO_PATH, list_files
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, read_table

COLUMNS, FILES = "columns", "files"


class ConvertError(InputError):
    """Sound cannot be converted; nothing was written."""


@dataclass
class ConvertAudioConfig:
    """Options of `playbyear-convert-audio`.

    Args:
        dataset: The dataset; it is not changed.
        output: The copy.
        to: `columns`: files of sound beside the frames (LeRobot's pull request 2824) become our columns. `files`: our
            columns become such files.
        codec: Of the files: `alac` loses nothing, `aac` is what the pull request writes.
        sample_rate: Of the columns: resample to this rate [Hz]. None keeps the files' own, or takes the nearest multiple of
            the frame rate.
        start_time_s: How long before an episode's first frame its sound begins in the files [s]. None: as the dataset says.
        pad: Fill what a file lacks with silence; otherwise that is an error.
    """

    dataset: DatasetPlace
    output: DatasetPlace
    to: str
    codec: str = "alac"
    sample_rate: int | None = None
    start_time_s: float | None = None
    pad: bool = False


def convert_audio(cfg: ConvertAudioConfig) -> Path:
    """Copies a dataset and converts its sound.

    Args:
        cfg: The options.

    Returns:
        The copy's folder. It is there only when it is complete.

    Raises:
        InputError: The dataset cannot be read, its sound is not where it says, or an option does not fit.
        OSError: The copy cannot be written.
    """
    if cfg.to not in (COLUMNS, FILES):
        raise ConvertError(f"--to={cfg.to} is not known; wanted {COLUMNS} or {FILES}.")
    if cfg.to == FILES:
        for name in ("sample_rate", "start_time_s"):
            if getattr(cfg, name) is not None:
                raise ConvertError(f"--{name}={getattr(cfg, name)} is for --to={COLUMNS}. Leave it out.")
    target = new_folder(cfg.output)
    return _to_columns(cfg, target) if cfg.to == COLUMNS else _to_files(cfg, target)


def _to_columns(cfg: ConvertAudioConfig, target: Path) -> Path:
    root = Path(cfg.dataset.root) if cfg.dataset.root else HF_LEROBOT_HOME / cfg.dataset.repo_id
    if not (root / INFO_PATH).is_file():
        raise ConvertError(
            f"There is no dataset in {root}: it has no {INFO_PATH}. Correct --dataset.root; one on the Hub comes with "
            f"`hf download {cfg.dataset.repo_id} --repo-type=dataset --local-dir=...`."
        )
    with errors_of_input():
        footers = check_dataset_files(cfg.dataset.repo_id, root)
        check_links(root)
        fps, features = _fps_and_features(root)
        rows, lengths = _episodes(root, sum(footer.num_rows for footer in footers))
        tracks = read_tracks(root, rows, sum(lengths) / fps, cfg.start_time_s)
        _check_names(tracks, set(features))
        if cfg.sample_rate is not None and (cfg.sample_rate <= 0 or cfg.sample_rate % fps):
            raise ConvertError(f"--sample_rate={cfg.sample_rate}: wanted a multiple of {fps} frames per second.")
    from lerobot_playbyear.audio.attached_copy import write_with_sound
    from lerobot_playbyear.audio.audio_import import CutOptions, read_tracks_sound
    from lerobot_playbyear.datasets.long_dataset import scratch_folder

    with scratch_folder() as scratch:
        options = CutOptions(fps, cfg.sample_rate, cfg.pad)
        sounds = read_tracks_sound(tracks, lengths, options, Path(scratch))
        removed = [track.key for track in tracks]
        write_new_dataset(root, target, partial(write_with_sound, sounds=sounds, fps=fps, removed=removed))
    heard = ", ".join(f"{key} at {sound.sample_rate} Hz" for sound in sounds for key in sound.keys)
    print(f"\nDataset: {target} ({len(lengths)} episodes with {heard})")
    return target


def _to_files(cfg: ConvertAudioConfig, target: Path) -> Path:
    dataset = open_for_copy(cfg.dataset)
    from lerobot_playbyear.audio.attached_copy import DatasetChange, write_changed
    from lerobot_playbyear.audio.audio_export import FILE_MEGABYTES, check_codec, microphones_of, write_track
    from lerobot_playbyear.datasets.columns import column_to_numpy, episode_bounds

    microphones = microphones_of(dataset.meta.features, dataset.fps)
    check_codec(cfg.codec, microphones)
    episodes = column_to_numpy(dataset.hf_dataset.data.column("episode_index"))
    bounds = list(zip(*episode_bounds(episodes), strict=True))
    if [int(episodes[start]) for start, _ in bounds] != list(range(dataset.num_episodes)):
        raise ConvertError(
            f"The data files do not hold episodes 0 to {dataset.num_episodes - 1} in this order. Repair the dataset first: "
            f"playbyear-repair --root={dataset.root}"
        )

    def write(root: Path, folder: Path) -> None:
        tracks = {mic.key: write_track(dataset, bounds, mic, cfg.codec, folder) for mic in microphones}
        change = DatasetChange(
            added={key: track.feature for key, track in tracks.items()},
            stats=[{key: track.stats[i] for key, track in tracks.items()} for i in range(len(bounds))],
            removed=[column for mic in microphones for column in mic.columns],
            episode_columns={name: values for track in tracks.values() for name, values in track.columns.items()},
            info={"audio_path": DEFAULT_AUDIO_PATH, "audio_files_size_in_mb": FILE_MEGABYTES},
        )
        write_changed(root, folder, change)

    with errors_of_input():
        write_new_dataset(Path(dataset.root), target, write)
    print(
        f"\nDataset: {target} ({len(bounds)} episodes with {', '.join(mic.key for mic in microphones)} as {cfg.codec})"
    )
    return target


def _fps_and_features(root: Path) -> tuple[int, dict]:
    info = json.loads((root / INFO_PATH).read_text())
    fps, features = info.get("fps"), info.get("features")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or fps % 1 or fps < 1:
        raise ConvertError(
            f"{root / INFO_PATH}: fps is {fps!r}; wanted a whole number of frames per second. Correct it."
        )
    if not isinstance(features, dict) or not all(isinstance(feature, dict) for feature in features.values()):
        raise ConvertError(f"{root / INFO_PATH} names no features. Repair it: playbyear-repair --root={root}")
    return int(fps), features


def _episodes(root: Path, n_frames: int) -> tuple[pa.Table, list[int]]:
    """The rows of `meta/episodes` in the order of the episodes, and the frames of each."""
    remedy = f"Repair it first: playbyear-repair --root={root}"
    try:
        tables = [read_table(path) for path in list_files(root, f"{EPISODES_DIR}/*/*.parquet")]
        rows = pa.concat_tables(tables, promote_options="default").sort_by("episode_index")
        lengths = rows.column("length").to_pylist()
        numbers = rows.column("episode_index").to_pylist()
    except (ParquetDamageError, pa.ArrowException, KeyError) as error:
        raise ConvertError(f"{root / EPISODES_DIR} is damaged: {error}. {remedy}") from error
    if numbers != list(range(len(rows))) or not all(isinstance(length, int) and length > 0 for length in lengths):
        raise ConvertError(
            f"{root / EPISODES_DIR} does not name episodes 0 to {len(rows) - 1} and their lengths. {remedy}"
        )
    if sum(lengths) != n_frames:
        raise ConvertError(
            f"{root / EPISODES_DIR} counts {sum(lengths)} frames; the data files hold {n_frames}. {remedy}"
        )
    return rows, lengths


def _check_names(tracks: list[AudioTrack], features: set[str]) -> None:
    taken = features - {track.key for track in tracks}
    for track in tracks:
        for name in column_names(track):
            if name in taken:
                raise ConvertError(f"'{track.key}' becomes '{name}', which is there already. Rename one of them.")
            taken.add(name)
