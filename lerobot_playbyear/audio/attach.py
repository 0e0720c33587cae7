"""`playbyear-attach-audio`: a copy of a LeRobotDataset with its sound in columns: from files, or from its own pictures.

LeRobot is imported when the dataset's files have been looked at.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_playbyear.audio.audio_layout import has_audio_files, read_layout
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.features import AUDIO_PREFIX
from lerobot_playbyear.datasets.files import (
    EPISODES_DIR,
    INFO_PATH,
    check_can_be_made,
    list_files,
    new_folder,
    scratch_folder,
)
from lerobot_playbyear.datasets.info import check_links
from lerobot_playbyear.datasets.parquet import ParquetDamageError
from lerobot_playbyear.datasets.reader import DatasetPlace, DatasetReader

if TYPE_CHECKING:
    from lerobot_playbyear.audio.attached_sound import EpisodesSound
    from lerobot_playbyear.datasets.reader import DatasetReader


class AttachError(InputError):
    """Sound cannot be attached; nothing was written."""


@dataclass
class AttachAudioConfig:
    """Options of `playbyear-attach-audio`.

    Args:
        dataset: The dataset that gets sound; it is not changed. Without a root it may come from the Hub.
        output: The copy with sound. Without a name: the dataset's name and folder with `_with_sound` behind them.
        files: The sound of each episode, if each has a file: a path in which `{episode}` stands for the episode's number,
            for example `sound/{episode:06d}.wav`. WAV, FLAC, or a film whose sound track is taken.
        session: One file with the sound of the whole session, in place of `files`; or, where a microphone was recorded as a
            camera, a folder with the files of its sessions, if these are not where the microphone left them.
        clock: When each episode's first frame was taken [s]: a table (CSV) of episode and seconds, or JSON. None: the
            dataset says so itself, in `meta/playbyear_clock.json`.
        marks: Moments that are known in the session's file and on that clock, such as a clap at the start and one at the
            end: `2.31=1754400000.12, 1802.74=1754401800.55`. None: the clock's seconds are the file's.
        microphone: What the microphone is called: the column is `observation.audio.<microphone>`. For files of
            several channels, a name for each, separated by commas. None: "microphone"; of those that were recorded as cameras,
            all.
        channel: Take only this channel of the files, counted from 0.
        offset: Where in its file each episode's first frame was taken [s]; negative where the file begins after it. None:
            0, or as the dataset says of its own files.
        offsets: A JSON file with a list of offsets [s], one per episode, in addition to `offset`.
        sample_rate: Resample to this rate [Hz]. None keeps the files' own.
        pad: Fill what a file lacks at its beginning or its end with silence; otherwise that is an error.
    """

    dataset: DatasetPlace
    output: DatasetPlace = field(default_factory=lambda: DatasetPlace(""))
    files: str | None = None
    session: Path | None = None
    clock: Path | None = None
    marks: str | None = None
    microphone: str | None = None
    channel: int | None = None
    offset: float | None = None
    offsets: Path | None = None
    sample_rate: int | None = None
    pad: bool = False

    def __post_init__(self) -> None:
        if not self.output.repo_id:
            root = self.output.root or (self.dataset.root and f"{Path(self.dataset.root)}_with_sound")
            self.output = DatasetPlace(f"{self.dataset.repo_id}_with_sound", root)


def attach_audio(cfg: AttachAudioConfig) -> Path:
    """Copies a dataset and adds its microphones: from files, from its own files, or those that were recorded as cameras.

    Args:
        cfg: The options.

    Returns:
        The copy's folder. It is there only when it is complete.

    Raises:
        AttachError: Naming every episode whose sound is missing, too short, or of another kind.
        InputError: The copy's folder cannot be made, before any sound is read.
        OSError: The copy cannot be written.
    """
    root = cfg.dataset.folder
    has_own_files = cfg.files is None and cfg.session is None and has_audio_files(root)
    _check_source(cfg, has_own_files)
    target = output_folder(cfg.output)
    if has_own_files:
        return _attach_own_files(cfg, root, target)
    dataset = open_for_copy(cfg.dataset)
    from lerobot_playbyear.audio.attached_copy import write_with_sound
    from lerobot_playbyear.audio.attached_sound import read_sound
    from lerobot_playbyear.audio.camera_sound import read_camera_sound, write_with_cameras
    from lerobot_playbyear.audio.session_sound import read_session

    with scratch_folder() as scratch:
        if _is_in_dataset(cfg):
            found = read_camera_sound(cfg, dataset, Path(scratch))
            sounds, write = found.sounds, partial(write_with_cameras, found=found, fps=dataset.fps)
        else:
            read = read_sound if cfg.session is None else read_session
            sounds = [read(cfg, dataset, _keys(cfg, dataset), Path(scratch))]
            write = partial(write_with_sound, sounds=sounds, fps=dataset.fps)
        write_new_dataset(Path(dataset.root), target, write)
    return _told(target, sounds)


def _attach_own_files(cfg: AttachAudioConfig, root: Path, target: Path) -> Path:
    layout = read_layout(cfg.dataset.repo_id, root, cfg.offset)
    from lerobot_playbyear.audio.attached_copy import write_with_sound
    from lerobot_playbyear.audio.audio_import import read_tracks_sound

    with scratch_folder() as scratch:
        sounds = read_tracks_sound(layout, cfg, Path(scratch))
        removed = [track.key for track in layout.tracks]
        write_new_dataset(root, target, partial(write_with_sound, sounds=sounds, fps=layout.fps, removed=removed))
    return _told(target, sounds)


def _told(target: Path, sounds: "list[EpisodesSound]") -> Path:
    heard = ", ".join(f"{key} at {sound.sample_rate} Hz" for sound in sounds for key in sound.keys)
    print(f"\nDataset: {target} ({len(sounds[0].episodes)} episodes with {heard})")
    return target


def _is_in_dataset(cfg: AttachAudioConfig) -> bool:
    return cfg.files is None and (cfg.session is None or cfg.session.is_dir())


def write_new_dataset(root: Path, target: Path, write: Callable[[Path, Path], None]) -> None:
    """Writes a dataset made from another, which is there only when it is complete and on the disk itself.

    Args:
        root: The other's folder.
        target: Its folder, which is not there yet.
        write: Given `root` and an empty folder, writes it there.

    Raises:
        AttachError: A table of the other is damaged.
        OSError: Something cannot be read or written.
    """
    try:
        with new_folder(target) as unfinished:
            write(root, unfinished)
    except ParquetDamageError as error:
        raise AttachError(f"{error} Repair it first: playbyear-repair --root={root}") from error


def output_folder(place: DatasetPlace) -> Path:
    """Where a new dataset is to be written.

    Raises:
        AttachError: Something is there already.
        InputError: It cannot be made.
    """
    target = place.folder
    if target.exists():
        raise AttachError(f"{target} is there already. Choose another --output.root, or delete it.")
    check_can_be_made(target, f"--output.root={target}")
    return target


def open_for_copy(place: DatasetPlace) -> DatasetReader:
    """Opens a dataset of which a copy is to be made: no link leads out of it, and its tables of episodes are whole.

    Raises:
        AttachError: There is none, or it is not so.
    """
    if place.root is not None and not (Path(place.root) / INFO_PATH).is_file():
        raise AttachError(f"There is no dataset in {place.root}: it has no {INFO_PATH}. Correct --dataset.root.")
    try:
        dataset = DatasetReader(place.repo_id, place.root)
        from lerobot_playbyear.audio.attached_copy import read_named_table

        check_links(Path(dataset.root))  # the copy would hold what they lead to
        for path in list_files(Path(dataset.root), f"{EPISODES_DIR}/*/*.parquet"):
            read_named_table(path, ["length"])  # LeRobot looks at no checksum
        return dataset
    except ParquetDamageError as error:
        raise AttachError(f"{error} Repair it first: playbyear-repair --root={dataset.root}") from error
    except Exception as error:  # also what the Hub's client raises
        raise AttachError(f"The dataset '{place.repo_id}' cannot be opened: {error}") from error


def _check_source(cfg: AttachAudioConfig, has_own_files: bool) -> None:
    """Whether the options say where the sound is, and in one way."""
    if cfg.files is not None and cfg.session is not None:
        raise AttachError(
            "--files has the sound of each episode, --session that of all; both are given. Give one of them."
        )
    if _is_in_dataset(cfg):
        own = ("the dataset's own files", "offset", "sample_rate", "pad")
        source, *taken = (
            own if has_own_files else ("microphones that were recorded as cameras", "session", "microphone")
        )
        for option in fields(AttachAudioConfig):
            value = getattr(cfg, option.name)
            if option.name not in ("dataset", "output", *taken) and value != option.default:
                raise AttachError(
                    f"--{option.name}={value} is for --files and one --session=FILE, not for {source}. Leave it out, or say "
                    "where the files are."
                )
    if cfg.files is not None and "{episode" not in cfg.files:
        raise AttachError(f"--files={cfg.files}: say with {{episode}} where the episode's number stands.")
    for name in ("clock", "marks"):
        if cfg.session is None and getattr(cfg, name) is not None:
            raise AttachError(f"--{name}={getattr(cfg, name)} is for --session. Leave it out.")


def _keys(cfg: AttachAudioConfig, dataset: DatasetReader) -> list[str]:
    names = [name.strip() for name in ("microphone" if cfg.microphone is None else cfg.microphone).split(",")]
    keys = [name if name.startswith(AUDIO_PREFIX) else AUDIO_PREFIX + name for name in names]
    for key in keys:
        if "/" in key or key == AUDIO_PREFIX or keys.count(key) > 1:
            raise AttachError(f"--microphone={cfg.microphone}: give each microphone a name of its own, without '/'.")
        if key in dataset.meta.features:
            raise AttachError(f"'{key}' is in the dataset already. Give another --microphone.")
    if cfg.channel is not None and len(keys) > 1:
        raise AttachError(f"--channel={cfg.channel} is for one microphone; --microphone names {len(keys)}.")
    return keys
