"""The sound of microphones that were recorded as cameras: from a dataset's pictures, and from the files of their sessions."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lerobot_playbyear.audio.attach_audio import AttachAudioConfig, PutAside, raise_all
from lerobot_playbyear.audio.control_steps import ControlStepSound, check_pace
from lerobot_playbyear.audio.dataset_copy import AddedColumn, Columns
from lerobot_playbyear.audio.microphone_pictures import (
    SESSIONS,
    SessionSound,
    Strip,
    audio_key_of,
    find_session,
    microphone_pictures,
    n_kept,
    read_strip,
    read_timecode,
)
from lerobot_playbyear.audio.sound_picture import PICTURE_PREFIX
from lerobot_playbyear.datasets.errors import InputError, printable
from lerobot_playbyear.datasets.features import (
    INTERVENTION,
    IS_FIRST,
    IS_FIRST_FEATURE,
    MICROPHONE,
    Features,
    samples_per_frame,
)
from lerobot_playbyear.datasets.findings import name_episodes
from lerobot_playbyear.datasets.frame_rate import nearest_sample_rate
from lerobot_playbyear.datasets.info import came_from_the_hub
from lerobot_playbyear.datasets.reader import DatasetReader
from lerobot_playbyear.datasets.remedies import without_episodes
from lerobot_playbyear.datasets.statistics import numeric_stats


@dataclass
class _Frame:
    """Of one picture what it says of its microphone; `was_read`: and not reckoned from its neighbours."""

    session: int
    counter: int
    strip: Strip | None = None
    was_read: bool = True


def read_camera_sound(cfg: AttachAudioConfig, dataset: DatasetReader, scratch: Path) -> tuple[Columns, Features]:
    """Reads the sound of all microphones, so that what is wrong is known before anything is written.

    Args:
        cfg: The options.
        dataset: The dataset that gets its sound.
        scratch: A folder for the sound, 2 bytes a sample.

    Returns:
        The columns of a copy: of each microphone its sound, and `is_first`, the first frames of episodes and those after a
        pause. And what the `info` of the microphones' pictures says more.

    Raises:
        InputError: There is no such microphone, or its samples are not there.
    """
    keys = [key for key in microphone_pictures(dataset.meta) if audio_key_of(key) not in dataset.meta.features]
    chosen = keys if cfg.microphone is None else [PICTURE_PREFIX + name.strip() for name in cfg.microphone.split(",")]
    if not keys or not set(chosen) <= set(keys):
        raise InputError(
            f"The cameras of this dataset that are microphones without attached sound: {', '.join(keys) or 'none'}; wanted "
            f"{', '.join(chosen) or 'one'}. Sound that was recorded beside it is attached with --files or --session."
        )
    added: dict[str, AddedColumn] = {}
    is_first = [np.zeros(len(episode), bool) for episode in dataset.episodes]
    for key in chosen:
        columns, starts = _MicrophoneReader(cfg, dataset, key, scratch).read()
        added.update(columns)
        is_first = [own | other for own, other in zip(is_first, starts, strict=True)]
    known = (_flags(dataset, key) for key in (IS_FIRST, INTERVENTION))
    for flags, before, by_person in zip(is_first, *known, strict=True):
        flags |= before  # LeRobot's rollout resets the policy at every hand-back, too, however short the pause
        flags[1:] |= by_person[:-1] & ~by_person[1:]
    stats = [numeric_stats({IS_FIRST: flags[:, None]}, {IS_FIRST: IS_FIRST_FEATURE})[IS_FIRST] for flags in is_first]
    added[IS_FIRST] = AddedColumn(IS_FIRST_FEATURE, stats, is_first.__getitem__)
    return added, {key: {MICROPHONE: audio_key_of(key)} for key in chosen}


def _flags(dataset: DatasetReader, key: str) -> list[np.ndarray]:
    """A column of flags, of each episode (n,) bool; all false where the dataset has none."""
    feature = dataset.meta.features.get(key)
    if feature is None or feature["dtype"] != "bool" or tuple(feature["shape"]) != (1,):
        return [np.zeros(len(episode), bool) for episode in dataset.episodes]
    return [dataset.values(key, episode).astype(bool) for episode in dataset.episodes]


class _MicrophoneReader:
    """Reads one microphone."""

    def __init__(self, cfg: AttachAudioConfig, dataset: DatasetReader, key: str, scratch: Path) -> None:
        self._dataset, self._key = dataset, key
        self._sound = PutAside([audio_key_of(key)], scratch)
        # A stranger's pictures may name a session of this machine's own, and so its voices: they get those that are named.
        self._is_foreign = came_from_the_hub(Path(dataset.root))
        own = [] if self._is_foreign else [SESSIONS]
        self._folders = own if cfg.session is None else [cfg.session, *own]
        self._files: dict[int, SessionSound] = {}
        self._taken: dict[int, tuple[int, int]] = {}  # of each session's file, from which sample to which
        self._spacing: list[list[int]] = []  # of each episode, samples from frame to frame
        self._errors: dict[str, list[int]] = {}  # what is wrong, and in which episodes
        self._rate = 0  # of the microphone [Hz]

    def read(self) -> tuple[Columns, list[np.ndarray]]:
        """The sound of all episodes, and which of their frames are the first ones, (n,) bool."""
        reading = f"Reading {printable(self._key)}"
        is_first = [
            self._read_episode(number, self._dataset.pictures(self._key, episode))
            for number, episode in enumerate(tqdm(self._dataset.episodes, desc=reading, unit="episode"))
        ]
        raise_all([f"{self._key}, {name_episodes(episodes)}: {error}" for error, episodes in self._errors.items()])
        self._check_pace()
        for session, (start, stop) in self._taken.items():
            file = self._files[session]
            seconds = f"{start / file.sample_rate:.1f} to {stop / file.sample_rate:.1f} s"
            print(printable(f"{self._key}: {seconds} of {file.path}"))
        return self._sound.columns(self._new_rate, self._dataset.fps), is_first

    def _read_episode(self, episode: int, pictures: Iterator[np.ndarray]) -> np.ndarray:
        """Puts an episode's sound aside, and says what was exact. Returns which frames are the first ones, (n,) bool."""
        blocks: list[np.ndarray] = []
        is_first: list[bool] = []
        self._spacing.append([])
        n_read = n_strips = 0
        steps: ControlStepSound | None = None
        try:
            for frame in _known(map(_read_frame, pictures), self._samples_per_frame):
                strip = self._strip(frame)
                steps = steps or ControlStepSound(samples_per_frame(self._new_rate, self._dataset.fps))
                block, starts = steps.next(strip)
                blocks.append(block)
                is_first.append(starts)
                if steps.n_heard is not None and not starts:
                    self._spacing[-1].append(steps.n_heard)
                n_read, n_strips = n_read + frame.was_read, n_strips + (frame.strip is not None)
        except (ValueError, OSError) as error:
            self._errors.setdefault(str(error), []).append(episode)
            return np.zeros(0, bool)
        self._sound.append(np.stack(blocks)[..., None])
        told = f"{n_strips} from the pictures, {len(is_first) - n_strips} from the session's file"
        if n_read < len(is_first):
            told += f"; {len(is_first) - n_read} timecodes could not be read and follow from their neighbours"
        pauses = sum(is_first[1:])
        told += f"; {pauses} pauses" if pauses else ""
        key = printable(audio_key_of(self._key))
        tqdm.write(f"episode {episode}, {key}: {len(is_first)} frames, exact samples of {told}")
        return np.array(is_first)

    @property
    def _new_rate(self) -> int:
        """Of the column [Hz]."""
        return nearest_sample_rate(self._rate, self._dataset.fps)

    def _strip(self, frame: _Frame) -> Strip:
        strip = frame.strip or self._from_file(frame)
        self._rate = self._rate or strip.sample_rate
        if strip.sample_rate != self._rate:
            raise ValueError(
                f"it has {strip.sample_rate} samples per second, and those before {self._rate}: all episodes of a dataset "
                "need one sample_rate"
            )
        return strip

    def _from_file(self, frame: _Frame) -> Strip:
        """What the strip would hold, from the session's file.

        Raises:
            ValueError: The file is not there, or ends before.
        """
        file = self._file(frame.session)
        if frame.counter > len(file):
            raise ValueError(f"the session's file has {len(file)} samples, and a frame needs {frame.counter}")
        kept = n_kept(file.sample_rate)
        samples = file.samples(frame.counter - kept, frame.counter)
        start, stop = self._taken.get(frame.session, (frame.counter, frame.counter))
        self._taken[frame.session] = (min(start, max(frame.counter - kept, 0)), max(stop, frame.counter))
        return Strip(frame.session, frame.counter, file.sample_rate, samples)

    def _file(self, session: int) -> SessionSound:
        """A session's file.

        Raises:
            ValueError: It is not there.
        """
        if session not in self._files:
            path = next(filter(None, (find_session(folder, session) for folder in self._folders)), None)
            if path is None:
                where = f"is not in {' or '.join(map(str, self._folders))}" if self._folders else "has to be named"
                if self._is_foreign:
                    where += f", for this dataset came from the Hub and may be a stranger's (yours are in {SESSIONS})"
                raise ValueError(
                    f"its pictures were compressed, and the session's file *_{session:08x}.wav {where}. Copy it from the "
                    "machine that recorded, and give --session=FOLDER"
                )
            self._files[session] = SessionSound(path)
        return self._files[session]

    def _samples_per_frame(self, frame: _Frame) -> int:
        """From one frame to the next, as it should be."""
        rate = frame.strip.sample_rate if frame.strip else self._file(frame.session).sample_rate
        return round(rate / self._dataset.fps)

    def _check_pace(self) -> None:
        """Whether the recording's steps are as long as its frame rate says.

        Raises:
            InputError: They are not.
        """
        fps, rate = self._dataset.fps, self._rate
        whole = [n for own in self._spacing for n in own]
        check_pace(whole, rate, fps, "the dataset", f"Nothing was written. {self._key}: ")
        for episode, own in enumerate(self._spacing):
            try:
                check_pace(own, rate, fps, f"episode {episode}", is_live=True)
            except InputError as error:
                remedy = without_episodes(self._dataset.root, [episode])
                logging.warning("%s: %s To leave it out: %s", self._key, error, remedy)


def _read_frame(picture: np.ndarray) -> _Frame | None:
    strip = read_strip(picture)
    if strip is not None:
        return _Frame(strip.session, strip.counter, strip)
    code = read_timecode(picture)
    return None if code is None else _Frame(*code)


def _known(frames: Iterator[_Frame | None], size: Callable[[_Frame], int]) -> Iterator[_Frame]:
    """All frames of an episode; those that could not be read lie evenly between their neighbours.

    Raises:
        ValueError: None could be read.
    """
    last: _Frame | None = None
    n_unknown = 0
    for frame in frames:
        if frame is None:
            n_unknown += 1
            continue
        for i in range(n_unknown):
            if last is not None and last.session == frame.session:
                counter = last.counter + (frame.counter - last.counter) * (i + 1) // (n_unknown + 1)
            else:
                counter = frame.counter - (n_unknown - i) * size(frame)
            yield _Frame(frame.session, max(counter, 0), was_read=False)
        yield frame
        last, n_unknown = frame, 0
    if last is None:
        raise ValueError("none of its timecodes can be read: are these a microphone's pictures, in their own size?")
    for i in range(n_unknown):
        yield _Frame(last.session, last.counter + (i + 1) * size(last), was_read=False)
