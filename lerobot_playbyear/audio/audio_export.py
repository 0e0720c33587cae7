"""Sound in columns becomes files beside the frames, as `audio_layout` describes them."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import av
import numpy as np

from lerobot_playbyear.audio.audio_import import CHANNEL, CHANNEL_OF
from lerobot_playbyear.audio.audio_layout import AUDIO_FOLDER, DEFAULT_AUDIO_PATH, PRE_ROLL_S
from lerobot_playbyear.datasets.audio_feature import AUDIO_DTYPE, AUDIO_PREFIX, check_audio_features, to_pcm_s16
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.statistics import repeated_stats
from lerobot_playbyear.datasets.tensors import read_rows

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

    from lerobot_playbyear.datasets.long_dataset import LongDataset

CODECS = {"alac": "s16p", "aac": "fltp"}
"""What a file may be encoded as, and the form of samples that each takes; alac loses nothing."""

FILE_MEGABYTES = 100
"""Of a file; then the next one begins."""

_FILES_PER_CHUNK = 1000
_PIECE_SAMPLES = 2**18
_PCM_S16_FULL_SCALE = 32768
_LAYOUTS = {1: "mono", 2: "stereo"}


@dataclass
class Microphone:
    """A microphone to be written: its key there, its columns here, one per channel, and its sample rate [Hz]."""

    key: str
    columns: list[str]
    sample_rate: int


@dataclass
class WrittenTrack:
    """What the dataset then says of a microphone: the feature, per episode its statistics, and columns of `meta/episodes`."""

    feature: dict[str, Any]
    stats: list[dict[str, np.ndarray]] = field(default_factory=list)
    columns: dict[str, list] = field(default_factory=dict)


def microphones_of(features: Mapping[str, Mapping[str, Any]], fps: int) -> list[Microphone]:
    """The microphones of a dataset; two columns that were a stereo file's channels are one again.

    Args:
        features: The dataset's.
        fps: Its frames per second [Hz].

    Raises:
        InputError: There is none, or one breaks the contract.
    """
    try:
        rates = check_audio_features(features, fps)
    except ValueError as error:
        raise InputError(str(error)) from error
    if not rates:
        raise InputError("The dataset has no sound in columns 'observation.audio.<microphone>'. Choose another.")
    for key in rates:
        if "/" in key or "\\" in key:
            raise InputError(f"'{key}' names a folder of files; wanted a name without '/'. Rename the feature.")
    pairs: dict[str, dict[Any, str]] = {}
    for key in rates:
        info = features[key]["info"]
        pairs.setdefault(str(info.get(CHANNEL_OF)), {})[str(info.get(CHANNEL))] = key
    found: list[Microphone] = []
    for key, rate in rates.items():
        of = str(features[key]["info"].get(CHANNEL_OF))
        left, right = pairs[of].get("0", ""), pairs[of].get("1", "")
        is_name = of.startswith(AUDIO_PREFIX) and of not in features and "/" not in of and "\\" not in of
        is_stereo = is_name and len(pairs[of]) == 2 and key in (left, right) and rates.get(left) == rates.get(right)
        if not is_stereo:
            found.append(Microphone(key, [key], rate))
        elif key == left:
            found.append(Microphone(of, [left, right], rate))
    return found


def check_codec(codec: str, microphones: list[Microphone]) -> None:
    """Refuses a codec that is not known, or cannot have a microphone's sample rate.

    Raises:
        InputError: Naming it.
    """
    if codec not in CODECS:
        raise InputError(f"--codec={codec} is not known; wanted one of {', '.join(CODECS)}.")
    possible = av.codec.Codec(codec, "w").audio_rates
    for mic in microphones:
        if possible and mic.sample_rate not in possible:
            raise InputError(
                f"'{mic.key}' has {mic.sample_rate} samples per second, which {codec} cannot have. Choose --codec=alac."
            )


def write_track(
    dataset: "LeRobotDataset | LongDataset", bounds: list[tuple[int, int]], mic: Microphone, codec: str, root: Path
) -> WrittenTrack:
    """Writes the files of one microphone.

    Args:
        dataset: The dataset with columns.
        bounds: First row, and row after the last, of every episode.
        mic: The microphone.
        codec: Of `CODECS`.
        root: The folder of the dataset with files.

    Raises:
        ValueError: A row is missing or holds no sound.
        OSError: A file cannot be written.
    """
    files = _Files(mic, codec, root)
    written = WrittenTrack({})
    names = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    rows: list[tuple] = []
    for start, end in bounds:
        pieces = partial(_pieces, dataset, mic, start, end)
        rows.append(files.add(pieces, (end - start) * mic.sample_rate // dataset.fps, dataset.fps))
        written.stats.append(_stats(pieces, len(mic.columns), end - start))
    files.close()
    written.columns = {
        f"{AUDIO_FOLDER}/{mic.key}/{name}": list(column)
        for name, column in zip(names, zip(*rows, strict=True), strict=True)
    }
    info = {"sample_rate": mic.sample_rate, "start_time_s": PRE_ROLL_S, **_file_info(files.first)}
    written.feature = {"dtype": AUDIO_DTYPE, "shape": [len(mic.columns)], "names": ["channels"], "info": info}
    return written


class _Files:
    """Writes episodes one after the other, and begins a file when the one before is large."""

    def __init__(self, mic: Microphone, codec: str, root: Path) -> None:
        self._mic, self._codec, self._root = mic, codec, root
        self._layout = _LAYOUTS[len(mic.columns)]
        self._n_files = self._n_bytes = self._position = 0
        self._container: Any = None
        self._stream: Any = None
        self.first = self._path(0)

    def _path(self, number: int) -> Path:
        chunk, file = divmod(number, _FILES_PER_CHUNK)
        return self._root / DEFAULT_AUDIO_PATH.format(audio_key=self._mic.key, chunk_index=chunk, file_index=file)

    def add(
        self, pieces: Callable[[], Iterator[np.ndarray]], n_samples: int, fps: int
    ) -> tuple[int, int, float, float]:
        """Writes an episode. Returns its file's chunk and number, and where in the file it begins and ends [s]."""
        rate = self._mic.sample_rate
        if self._container is None or self._n_bytes >= FILE_MEGABYTES * 2**20:
            self._begin()
        first = self._position
        n_silent = round(PRE_ROLL_S * rate) - rate // fps  # block 0 ends at the first frame
        for done in range(0, n_silent, _PIECE_SAMPLES):
            self._encode(np.zeros((min(_PIECE_SAMPLES, n_silent - done), len(self._mic.columns)), np.int16))
        for samples in pieces():
            self._encode(samples)
        assert self._position == first + n_silent + n_samples
        return (*divmod(self._n_files - 1, _FILES_PER_CHUNK), first / rate, self._position / rate)

    def _begin(self) -> None:
        self.close()
        path = self._path(self._n_files)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._n_files, self._n_bytes, self._position = self._n_files + 1, 0, 0
        self._container = av.open(str(path), "w")
        self._stream = self._container.add_stream(self._codec, rate=self._mic.sample_rate, layout=self._layout)
        self._stream.format = CODECS[self._codec]

    def _encode(self, samples: np.ndarray) -> None:
        """Samples (n, channels) int16."""
        interleaved = np.ascontiguousarray(samples).reshape(1, -1)
        frame = av.AudioFrame.from_ndarray(interleaved, format="s16", layout=self._layout)
        frame.sample_rate, frame.pts = self._mic.sample_rate, self._position
        self._position += len(samples)
        self._mux(self._stream.encode(frame))

    def _mux(self, packets: list[Any]) -> None:
        self._n_bytes += sum(packet.size for packet in packets)
        self._container.mux(packets)

    def close(self) -> None:
        if self._container is not None:
            self._mux(self._stream.encode(None))
            self._container.close()
            self._container = None


def _pieces(dataset: "LeRobotDataset | LongDataset", mic: Microphone, start: int, end: int) -> Iterator[np.ndarray]:
    """The sound of rows, (n, channels) int16."""
    n_rows = max(_PIECE_SAMPLES * dataset.fps // mic.sample_rate, 1)
    for row in range(start, end, n_rows):
        n = min(n_rows, end - row)
        yield np.stack([to_pcm_s16(read_rows(dataset, key, row, n)).reshape(-1) for key in mic.columns], axis=1)


def _stats(pieces: Callable[[], Iterator[np.ndarray]], n_channels: int, n_frames: int) -> dict[str, np.ndarray]:
    """Of each channel, (channels,), for samples in [-1, 1]."""

    def of(channel: int) -> Iterator[np.ndarray]:
        return (piece[:, [channel]] for piece in pieces())

    each = [repeated_stats(partial(of, channel), n_frames, 1) for channel in range(n_channels)]
    stats = {name: np.concatenate([own[name] for own in each]) / _PCM_S16_FULL_SCALE for name in each[0]}
    return {**stats, "count": np.array([n_frames])}


def _file_info(path: Path) -> dict[str, Any]:
    """What a file says of itself, named as the layout names it."""
    with av.open(str(path)) as container:
        stream = container.streams.audio[0]
        info: dict[str, Any] = {
            "has_audio": True,
            "audio.channels": stream.layout.nb_channels,
            "audio.codec": stream.codec.canonical_name,
            "audio.bit_rate": stream.bit_rate,
            "audio.sample_rate": stream.rate,
            "audio.bit_depth": stream.format.bits,
            "audio.channel_layout": stream.layout.name,
        }
    return info
