"""`playbyear-attach-audio`: a copy of a LeRobotDataset with its sound in columns: from files, or from its own pictures.

Where the sound of each episode is, says a `Source`: one for files of episodes, one for the recording of a session, one for the
files of sound that a dataset has itself. Microphones that were recorded as cameras are in `camera_sound`.

LeRobot is imported when the dataset's files have been looked at.
"""

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from lerobot_playbyear.audio.audio_files import AudioFileError, audio_pieces, cut_into_frames, read_audio
from lerobot_playbyear.audio.lerobot_audio import AudioTrack, column_names, has_audio_files, read_tracks
from lerobot_playbyear.audio.recorder_clock import CLOCK_PATH, ClockError, read_clock, read_episode_starts, read_marks
from lerobot_playbyear.datasets.errors import InputError, printable
from lerobot_playbyear.datasets.features import AUDIO_PREFIX, Features, audio_feature, audio_keys
from lerobot_playbyear.datasets.files import INFO_PATH, check_can_be_made, parse_json
from lerobot_playbyear.datasets.findings import name_episodes
from lerobot_playbyear.datasets.frame_rate import divides, exact_rate, nearest_sample_rate
from lerobot_playbyear.datasets.info import check_links, nothing_in
from lerobot_playbyear.datasets.next_command import training_command
from lerobot_playbyear.datasets.reader import DatasetPlace, DatasetReader

if TYPE_CHECKING:
    from lerobot_playbyear.audio.dataset_copy import Columns

_MOST_ERRORS = 10  # that are listed
_SPARE_S = 1.0  # of a file's sound behind what the episodes need


@dataclass
class AttachAudioConfig:
    """Options of `playbyear-attach-audio`.

    Args:
        dataset: The dataset that gets sound. It is not changed. Without a root it may come from the Hub.
        output: The copy with sound. By default the dataset's name and folder with `_with_sound` appended.
        files: The sound of each episode, if each has its own file: a path in which `{episode}` stands for the episode's number,
            such as `sound/{episode:06d}.wav`. WAV, FLAC, or a video whose sound track is read.
        session: One file with the sound of the whole session, instead of `files`. For microphones recorded as cameras: the
            folder of their session files, if these were moved.
        clock: When each episode's first frame was taken [s]: CSV lines of episode and seconds, labels exported from Audacity,
            or JSON. None: the dataset's `meta/playbyear_clock.json`.
        marks: Moments known both in the session's file and on that clock, such as a clap at the start and one at the end:
            `2.31=1754400000.12, 1802.74=1754401800.55`. None: the clock counts the seconds of the file.
        microphone: Name of the microphone: the column is `observation.audio.<microphone>`. For files with several channels: one
            name per channel, separated by commas. None: "microphone", or all microphones that were recorded as cameras.
        channel: Use only this channel of the files, counted from 0.
        offset: Time in its file at which each episode's first frame was taken [s]. It is negative if the file begins later.
            None: 0, or what the dataset says of its own files.
        offsets: JSON file with a list of offsets [s], one per episode. They are added to `offset`.
        sample_rate: Resample to this rate [Hz]. None: keep the files' rate.
        pad: Fill missing sound at the beginning or end of a file with silence. Otherwise missing sound is an error.
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
            root = self.output.root or (self.dataset.root and f"{os.path.abspath(self.dataset.root)}_with_sound")
            self.output = DatasetPlace(f"{self.dataset.repo_id}_with_sound", root)


Recording = tuple[np.ndarray, int, float, float]
"""Of one episode: a recording with its sound, (n, channels) int16; its rate [Hz]; when the episode's first frame was taken,
from the recording's beginning on [s of the frames' clock]; and seconds of the recording in a second of that clock."""


@dataclass(frozen=True)
class Source:
    """Where the sound of a dataset's episodes is.

    Args:
        keys: The columns that it becomes, one per channel.
        named: What an episode is called where its sound is wrong.
        recording: Gives that of an episode.
        is_own: Whether the dataset has it in files of its own: nobody chose their rate, so the nearest that fits is taken.
    """

    keys: list[str]
    named: Callable[[int], str]
    recording: Callable[[int], Recording]
    is_own: bool = False


class PutAside:
    """The sound of all episodes, in files, until it is known that nothing is wrong with it and a copy is written.

    Args:
        keys: The columns.
        folder: For the files, 2 bytes a sample.
    """

    def __init__(self, keys: Sequence[str], folder: Path) -> None:
        self._keys, self._folder = keys, folder
        self._stats: dict[str, list[dict[str, np.ndarray]]] = {key: [] for key in keys}

    def append(self, blocks: np.ndarray) -> None:
        """Adds an episode: (n_frames, S, columns) int16."""
        from lerobot_playbyear.datasets.statistics import sound_stats

        for channel, key in enumerate(self._keys):
            np.save(self._folder / f"{key}-{len(self._stats[key])}.npy", blocks[..., channel])
            self._stats[key].append(sound_stats(blocks[..., channel]))

    def columns(self, sample_rate: int, fps: float) -> "Columns":
        """All that was added, as columns of a copy."""
        from lerobot_playbyear.audio.dataset_copy import AddedColumn

        feature = audio_feature(sample_rate, fps)
        return {key: AddedColumn(feature, self._stats[key], partial(self._blocks, key)) for key in self._keys}

    def _blocks(self, key: str, episode: int) -> np.ndarray:
        return np.load(self._folder / f"{key}-{episode}.npy")


def attach_audio(cfg: AttachAudioConfig) -> Path:
    """Copies a dataset and adds its microphones: from files, from its own files, or those that were recorded as cameras.

    Args:
        cfg: The options.

    Returns:
        The copy's folder. It is there only when it is complete.

    Raises:
        InputError: Naming every episode whose sound is missing, too short, or of another kind; or the copy's folder cannot be
            made, before any sound is read.
        OSError: The copy cannot be written.
    """
    has_own_files = cfg.files is None and cfg.session is None and has_audio_files(cfg.dataset.folder)
    _check_source(cfg, has_own_files)
    target = output_folder(cfg.output)
    dataset = open_for_copy(cfg.dataset, has_own_files)
    removed: list[str] = []
    notes: Features = {}
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.sound-") as folder:
        scratch = Path(folder)
        if has_own_files:
            tracks = read_tracks(dataset, cfg.offset)
            removed = [track.key for track in tracks]
            added = _read([_own_files(track, dataset, scratch) for track in tracks], cfg, dataset, scratch)
        elif _is_in_dataset(cfg):
            from lerobot_playbyear.audio.camera_sound import read_camera_sound

            added, notes = read_camera_sound(cfg, dataset, scratch)
        else:
            source = (_session if cfg.files is None else _files)(cfg, dataset, _keys(cfg, dataset), scratch)
            added = _read([source], cfg, dataset, scratch)
        from lerobot_playbyear.audio.dataset_copy import write_copy

        write_copy(dataset.root, target, added, removed, notes)
    heard = [f"{key} at {added[key].feature['info']['sample_rate']} Hz" for key in audio_keys(added)]
    print(printable(f"\nDataset: {target} ({len(dataset.episodes)} episodes with {', '.join(heard)})"))
    print(printable(f"Train on it: {training_command(cfg.output.repo_id, [*dataset.features, *added], target)}"))
    return target


def output_folder(place: DatasetPlace) -> Path:
    """Where a new dataset is to be written.

    Raises:
        InputError: Something is there already.
        InputError: It cannot be made.
    """
    target = place.folder
    if target.exists():
        raise InputError(f"{target} is there already. Choose another --output.root, or delete it.")
    check_can_be_made(target, f"--output.root={target}")
    return target


def open_for_copy(place: DatasetPlace, may_have_audio_files: bool = False) -> DatasetReader:
    """Opens a dataset of which a copy is to be made: it is whole, and no link leads out of it.

    Args:
        place: The dataset.
        may_have_audio_files: See `DatasetReader`.

    Raises:
        InputError: There is none, or it is not so.
    """
    if place.root is not None and not (Path(place.root) / INFO_PATH).is_file():
        raise InputError(f"{nothing_in(Path(place.root))}. Correct --dataset.root.")
    try:
        dataset = DatasetReader(place.repo_id, place.root, may_have_audio_files=may_have_audio_files)
        check_links(dataset.root)  # the copy would hold what they lead to
    except InputError:
        raise
    except Exception as error:  # also what the Hub's client raises
        raise InputError(f"The dataset '{place.repo_id}' in {place.folder} cannot be opened: {error}") from error
    return dataset


def raise_all(errors: list[str]) -> None:
    """Ends with what is wrong with sound, the first of it where it is much.

    Raises:
        InputError: If there is anything.
    """
    if errors:
        more = f"\n  ... and {len(errors) - _MOST_ERRORS} more" if len(errors) > _MOST_ERRORS else ""
        raise InputError("Nothing was written.\n  " + "\n  ".join(errors[:_MOST_ERRORS]) + more)


# What the options say


def _is_in_dataset(cfg: AttachAudioConfig) -> bool:
    return cfg.files is None and (cfg.session is None or cfg.session.is_dir())


def _check_source(cfg: AttachAudioConfig, has_own_files: bool) -> None:
    """Whether the options say where the sound is, and in one way."""
    if cfg.files is not None and cfg.session is not None:
        raise InputError("--files has the sound of each episode, --session that of all; both are given. Give one.")
    if _is_in_dataset(cfg):
        own = ("the dataset's own files", "offset", "sample_rate", "pad")
        source, *taken = own if has_own_files else ("microphones recorded as cameras", "session", "microphone")
        for option in fields(AttachAudioConfig):
            value = getattr(cfg, option.name)
            if option.name not in ("dataset", "output", *taken) and value != option.default:
                raise InputError(
                    f"--{option.name}={value} is for --files and one --session=FILE, not for {source}. Leave it out, or say "
                    "where the files are."
                )
    if cfg.session is not None and not cfg.session.exists():
        raise InputError(f"--session={cfg.session}: there is no such file or folder.")
    if cfg.files is not None and "{episode" not in cfg.files:
        raise InputError(f"--files={cfg.files}: say with {{episode}} where the episode's number stands.")
    for name in ("clock", "marks"):
        if cfg.session is None and getattr(cfg, name) is not None:
            raise InputError(f"--{name}={getattr(cfg, name)} is for --session. Leave it out.")


def _keys(cfg: AttachAudioConfig, dataset: DatasetReader) -> list[str]:
    names = [name.strip() for name in ("microphone" if cfg.microphone is None else cfg.microphone).split(",")]
    keys = [name if name.startswith(AUDIO_PREFIX) else AUDIO_PREFIX + name for name in names]
    for key in keys:
        if "/" in key or key == AUDIO_PREFIX or keys.count(key) > 1:
            raise InputError(f"--microphone={cfg.microphone}: give each microphone a name of its own, without '/'.")
        if key in dataset.meta.features:
            raise InputError(f"'{key}' is in the dataset already. Give another --microphone.")
    if cfg.channel is not None and len(keys) > 1:
        raise InputError(f"--channel={cfg.channel} is for one microphone; --microphone names {len(keys)}.")
    return keys


def _offsets(cfg: AttachAudioConfig, n_episodes: int) -> list[float]:
    """The offset of each episode [s], from the options.

    Raises:
        InputError: `offsets` is not a list of as many numbers.
    """
    offset = cfg.offset or 0.0
    if not np.isfinite(offset):
        raise InputError(f"--offset={offset}: wanted seconds, such as 0.25.")
    if cfg.offsets is None:
        return [offset] * n_episodes
    try:
        values = parse_json(cfg.offsets.read_bytes())
        if not isinstance(values, list) or not np.isfinite(values).all():
            raise ValueError(f"it holds {printable(str(values)[:40])}; wanted [0.5, 1.2, ...], seconds by episode")
        values = [float(value) for value in values]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"--offsets={cfg.offsets} is not a list of numbers in JSON: {error}") from error
    if len(values) != n_episodes:
        raise InputError(f"--offsets={cfg.offsets} has {len(values)} values; the dataset has {n_episodes} episodes.")
    return [offset + value for value in values]


# Where sound is


def _read(sources: list[Source], cfg: AttachAudioConfig, dataset: DatasetReader, scratch: Path) -> "Columns":
    """Cuts the sound of all episodes, so that what is wrong with it is known before anything is written.

    Raises:
        InputError: Naming every episode whose sound is missing, too short or of another kind.
    """
    fps = dataset.fps
    if cfg.sample_rate is not None and not divides(fps, cfg.sample_rate):
        raise InputError(
            f"--sample_rate={cfg.sample_rate}: wanted a multiple of {exact_rate(fps).numerator} Hz, such as "
            f"{nearest_sample_rate(cfg.sample_rate, fps)}, since the dataset has {fps} frames per second."
        )
    errors: list[str] = []
    found: list[tuple[PutAside, dict[int, int]]] = []  # and the episode in which each rate comes first
    for source in sources:
        sound, first_with = PutAside(source.keys, scratch), dict[int, int]()
        for episode, rows in enumerate(tqdm(dataset.episodes, desc="Reading sound", unit="episode")):
            try:
                samples, own_rate, start_s, speed = source.recording(episode)
                rate = _new_rate(cfg, own_rate, fps, source.is_own)
                first_with.setdefault(rate, episode)
                sound.append(cut_into_frames(samples, own_rate, fps, len(rows), start_s, cfg.pad, rate, speed))
            except (AudioFileError, ValueError) as error:
                errors.append(f"{source.named(episode)}{error}")
        if len(first_with) > 1:
            each = ", ".join(f"{rate} Hz (episode {first_with[rate]})" for rate in sorted(first_with))
            errors.append(f"the files have different sample rates, {each}. Give --sample_rate to resample them.")
        found.append((sound, first_with))
    raise_all(errors)
    return {key: column for sound, rates in found for key, column in sound.columns(next(iter(rates)), fps).items()}


def _new_rate(cfg: AttachAudioConfig, own_rate: int, fps: float, is_own: bool = False) -> int:
    """The rate that sound of the rate `own_rate` is to have [Hz].

    Raises:
        AudioFileError: The frame rate does not divide it.
    """
    rate, nearest = cfg.sample_rate or own_rate, nearest_sample_rate(own_rate, fps)
    if divides(fps, rate):
        return rate
    if not is_own:
        raise AudioFileError(
            f"it has {own_rate} samples per second, which is not a multiple of {exact_rate(fps).numerator} Hz, and the dataset "
            f"{fps} frames per second. Resample it, for example with --sample_rate={nearest}."
        )
    return nearest


def _files(cfg: AttachAudioConfig, dataset: DatasetReader, keys: list[str], _: Path) -> Source:
    """A file for each episode."""
    offsets = _offsets(cfg, dataset.meta.total_episodes)
    pattern = str(cfg.files)

    def path_of(episode: int) -> str:
        try:
            return str(Path(pattern.format(episode=episode)))
        except (LookupError, ValueError, AttributeError, TypeError) as error:
            raise InputError(f"--files={pattern} cannot be filled in: {error}. It takes {{episode}} alone.") from error

    def recording(episode: int) -> Recording:
        samples, rate = read_audio(path_of(episode))
        return _choose_channels(cfg, samples, len(keys)), rate, offsets[episode], 1.0

    return Source(keys, lambda episode: f"episode {episode}, {path_of(episode)}: ", recording)


def _session(cfg: AttachAudioConfig, dataset: DatasetReader, keys: list[str], scratch: Path) -> Source:
    """One recording of a whole session, and the times when the episodes began."""
    speed, began_s, error_s = read_marks(cfg.marks)
    n_episodes = dataset.meta.total_episodes
    starts, offsets = _starts(cfg, dataset.root, n_episodes), _offsets(cfg, n_episodes)
    path = Path(str(cfg.session))
    try:
        pieces = ((_choose_channels(cfg, samples, len(keys)), rate) for samples, rate in audio_pieces(path))
        samples, rate = _decoded(pieces, scratch / "session")
        _new_rate(cfg, rate, dataset.fps)
    except (AudioFileError, ValueError) as error:
        raise InputError(f"Nothing was written. {path}: {error}") from error
    if cfg.marks is not None:
        print(
            f"{path}: its clock runs at {speed:.6f} of the episodes' clock ({(speed - 1) * 1e6:+.0f} parts in a million); "
            f"the marks fit to {error_s * 1000:.1f} ms."
        )

    def recording(episode: int) -> Recording:
        return samples, rate, starts[episode] - began_s + offsets[episode] / speed, speed

    def named(episode: int) -> str:
        return f"episode {episode}, which began at {starts[episode]:.3f} s of the clock: in {path} "

    return Source(keys, named, recording)


def _starts(cfg: AttachAudioConfig, root: Path, n_episodes: int) -> list[float]:
    """When each episode began, on the clock [s]."""
    source = cfg.clock or root / CLOCK_PATH
    try:
        known = read_clock(cfg.clock) if cfg.clock else read_episode_starts(root)
    except FileNotFoundError:
        known = None
    except OSError as error:
        raise ClockError(f"{source} cannot be read: {error}") from error
    if known is None:
        raise InputError(
            f"Nothing says when the episodes began: there is no {source}. Give --clock=times.csv with lines "
            "episode,seconds: for each episode when its first frame was taken."
        )
    missing = [episode for episode in range(n_episodes) if episode not in known]
    if missing:
        lacking = name_episodes(missing)
        raise InputError(f"{source} has no time for {lacking}; the dataset has {n_episodes} episodes. Add it.")
    return [known[episode] for episode in range(n_episodes)]


def _own_files(track: AudioTrack, dataset: DatasetReader, scratch: Path) -> Source:
    """A microphone's files beside the frames, of several episodes each."""
    needed_s: dict[Path, float] = {}  # to where in each file; one may decode to more than a disk holds
    for span, rows in zip(track.spans, dataset.episodes, strict=True):
        end_s = span.start_s + track.start_time_s + len(rows) / dataset.fps + _SPARE_S
        needed_s[span.path] = max(end_s, needed_s.get(span.path, 0.0))

    @cache
    def decoded(path: Path) -> tuple[np.ndarray, int] | AudioFileError:
        place = scratch / f"{track.key}-file-{list(needed_s).index(path)}"
        try:
            return _decoded(_checked_pieces(track, path, needed_s[path]), place)
        except AudioFileError as error:  # which is not to be tried again for each episode
            return error

    def recording(episode: int) -> Recording:
        span = track.spans[episode]
        found = decoded(span.path)
        if isinstance(found, AudioFileError):
            raise found
        samples, rate = found
        stop = len(samples) if span.end_s is None else round(span.end_s * rate)
        return samples[round(span.start_s * rate) : stop], rate, track.start_time_s, 1.0

    def named(episode: int) -> str:
        return f"'{track.key}', episode {episode}, {track.spans[episode].path}: "

    return Source(column_names(track), named, recording, is_own=True)


def _checked_pieces(track: AudioTrack, path: Path, last_s: float) -> Iterator[tuple[np.ndarray, int]]:
    """A file's sound up to a time, which is what the feature says.

    Raises:
        AudioFileError: It is not, or cannot be decoded.
    """
    n_samples = 0
    for samples, rate in audio_pieces(path):
        if samples.shape[1] != track.n_channels:
            raise AudioFileError(
                f"it has {samples.shape[1]} channels; the feature's shape says {track.n_channels}. Correct meta/info.json."
            )
        if track.sample_rate not in (None, rate):
            raise AudioFileError(
                f"it has {rate} samples per second; the feature's info says {track.sample_rate}. Correct meta/info.json."
            )
        if n_samples > last_s * rate:
            return
        yield samples, rate
        n_samples += len(samples)


def _decoded(pieces: Iterator[tuple[np.ndarray, int]], path: Path) -> tuple[np.ndarray, int]:
    """A recording that may be hours long, as a memory map (n, channels) int16 of the file `path`; and its rate [Hz]."""
    n_channels = rate = 0
    with path.open("wb") as file:
        for samples, own_rate in pieces:
            file.write(samples.astype("<i2").tobytes())
            n_channels, rate = samples.shape[1], own_rate
    return np.memmap(path, "<i2", "r").reshape(-1, n_channels), rate


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
