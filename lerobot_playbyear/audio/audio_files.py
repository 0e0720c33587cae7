"""Sound in files: WAV, FLAC and the sound tracks of videos in, WAV and FLAC out, and how a recording meets frames."""

import contextlib
import io
import itertools
import logging
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np

from lerobot_playbyear.datasets.features import samples_per_frame, to_pcm_s16

# FFmpeg's names of the formats of files that hold sound themselves. Playlists, which would have other files opened, are none.
_FORMATS = "wav,w64,flac,aiff,au,caf,mp3,ogg,aac,ac3,amr,ape,tta,wv,mov,matroska,avi,asf"
_WITHOUT_HEADER = {b"FLV": "flv", b"\x00\x00\x01\xba": "mpeg", b"G": "mpegts"}

logger = logging.getLogger(__name__)

HALF = 16
"""Samples before and after a moment that its interpolated value depends on."""

_NUMBERS = (1, 3)  # what a WAV file calls integers and floats; its "extensible" form says it further on
_EXTENSIBLE = 0xFFFE
_MOST_CHUNKS = 64  # of a WAV file before the one that says how its samples are written
_GAP_SECONDS = 0.02  # between two packets of a sound track; smaller ones are rounding
_SILENCE_AT_ONCE = 2**14  # samples
_MOST_HZ = 10**7  # of sound, also of bats'
_CODECS = {".wav": "pcm_s16le", ".flac": "flac"}
_BLOCK = 4096  # samples that are encoded at once
_FILTER_WIDTH, _ROLLOFF = 64, 0.9475937167399596  # of the resampler
_MOST_PHASES = 4096  # of its filter, which takes the square of them in memory
_PHASES = 256  # between two samples, for which an interpolation's weights are known
_PLACES_AT_ONCE = 2**14  # that are interpolated


class AudioFileError(ValueError):
    """A sound file cannot be used; the message says why, and what to do."""


def read_audio(path: str | Path) -> tuple[np.ndarray, int]:
    """Reads the sound of a file: WAV, FLAC, MP3, or a video's sound track; whatever FFmpeg reads.

    Args:
        path: The file.

    Returns:
        The samples, (n, channels) int16 PCM, and the sample rate [Hz]. Sample 0 is when the file's first picture is shown, or
        without pictures its first sound heard: a sound track that begins after its video begins with silence. 16-bit files
        come out bit for bit; others are rounded. Of a file that is cut off or damaged in the middle what comes before is read,
        and a warning says how much that is.

    Raises:
        AudioFileError: The file is missing, or holds no sound that can be decoded.
    """
    parts = list(audio_pieces(path))
    return np.concatenate([samples for samples, _ in parts]), parts[0][1]


def audio_pieces(path: str | Path) -> Iterator[tuple[np.ndarray, int]]:
    """As `read_audio`, in pieces of bounded size, each with the sample rate; silence, how long it may be, is no exception.

    Args:
        path: The file.

    Raises:
        AudioFileError: The file is missing, or holds no sound that can be decoded.
    """
    path = Path(path)
    if not path.is_file():
        raise AudioFileError(f"There is no sound file {path}.")
    position = rate = 0
    try:
        with _opened(path) as container:
            if not container.streams.audio:
                raise AudioFileError(f"{path} holds no sound.")
            sound: Any = container.streams.audio[0]
            if sound.codec_context is None:
                raise AudioFileError(f"{path} holds sound that FFmpeg cannot decode: convert it to WAV or FLAC.")
            rate, begin = sound.rate, _begin(container)
            if not 0 < rate <= _MOST_HZ:
                says = f"says that it has {rate} samples per second; wanted 1 to {_MOST_HZ:,}"
                raise AudioFileError(f"{path} {says if path.stat().st_size else 'holds no samples'}.")
            _warn_of_delay(path, container)
            for frame in container.decode(audio=0):
                samples = _to_samples(frame)  # (n, channels)
                if begin is None:
                    begin = frame.time or 0.0
                start = round((frame.time - begin) * rate) if frame.time is not None else position
                if position == 0 and start < 0:
                    samples, start = samples[-start:], 0
                if start - position > (_GAP_SECONDS * rate if position else 0):
                    while position < start:  # a file may say that it goes on after years
                        silence = np.zeros((min(start - position, _SILENCE_AT_ONCE), samples.shape[1]), np.int16)
                        position += len(silence)
                        yield silence, rate
                position += len(samples)
                yield samples, rate
    except (av.FFmpegError, ValueError, OSError) as error:
        if isinstance(error, AudioFileError):
            raise
        if not position or isinstance(error, OSError):
            raise AudioFileError(f"The sound of {path} cannot be decoded: {error}.") from error
        logger.warning("%s is damaged or cut off after %.3f s (%s): the rest is lost.", path, position / rate, error)
    if not position:
        raise AudioFileError(f"{path} holds no samples.")


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[av.container.InputContainer]:
    with _WholeSamples(path) as file:
        begin = file.read(4)
        file.seek(0)
        source: Any = file if file.room else str(path)
        found = [name for mark, name in _WITHOUT_HEADER.items() if begin.startswith(mark)]
        # With a format and options PyAV 15.1 ends in a segmentation fault.
        how: dict[str, Any] = {"format": found[0]} if found else {"options": {"format_whitelist": _FORMATS}}
        with av.open(source, **how) as opened:
            yield opened


class _WholeSamples(io.FileIO):
    """A file; of a WAV file whose samples have room for more bits than they hold, such as 24 in 32, one that says the room.

    What they hold stands in the upper bits. FFmpeg goes by the number of bits: it takes 24 in 32 for Cool Edit's floats,
    and 16 in 32 for two samples.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        self._places: list[int] = []  # of numbers of bits
        self.room = b""
        """What a number of bits is to be; nothing: as it is."""
        with contextlib.suppress(struct.error):
            self._look()
        self.seek(0)

    def _look(self) -> None:
        form, _, kind = struct.unpack("<4sI4s", self.read(12))
        if form == b"RIFX" and kind == b"WAVE":
            raise AudioFileError(f"{self.name} holds big-endian numbers (RIFX), which FFmpeg misreads: convert it.")
        if form not in (b"RIFF", b"RF64") or kind != b"WAVE":
            return
        for _ in range(_MOST_CHUNKS):
            name, size = struct.unpack("<4sI", self.read(8))
            if name == b"fmt ":
                break
            self.seek(size + size % 2, io.SEEK_CUR)
        else:
            return
        place = self.tell()
        tag, n_channels, _, _, n_bytes, n_bits = struct.unpack("<HHIIHH", self.read(16))
        held = [n_bits]
        if tag == _EXTENSIBLE:
            _, valid, _, tag = struct.unpack("<HHIH", self.read(10))
            held.append(valid or n_bits)
        room = 8 * n_bytes // max(n_channels, 1)
        if tag in _NUMBERS and max(held) <= room and -(-min(held) // 8) * 8 < room:
            self.room, self._places = struct.pack("<H", room), [place + 14, place + 18][: len(held)]

    def read(self, size: int | None = -1, /) -> bytes:
        begin = self.tell()
        found = bytearray(super().read(size))
        for place in self._places:
            for i, byte in enumerate(self.room, place - begin):
                if 0 <= i < len(found):
                    found[i] = byte
        return bytes(found)


def _begin(container: av.container.InputContainer) -> float | None:
    """When a file begins, by its own clock [s]: with its first picture, or its earliest sound; None: with the first read."""
    cover = av.stream.Disposition.attached_pic
    streams: list[Any] = [each for each in container.streams.video if not each.disposition & cover]
    streams = streams or ([*container.streams.audio] if len(container.streams.audio) > 1 else [])
    timed = [each for each in streams if each.start_time is not None and each.time_base]
    return min((float(each.start_time * each.time_base) for each in timed), default=None)


def _warn_of_delay(path: Path, container: av.container.InputContainer) -> None:
    """Says by how much sound may come late in formats that do not say how much silence an encoder put before it."""
    stream = container.streams.audio[0]
    codec, kind = stream.codec_context.name, container.format.name
    n_samples = 1024 if kind == "aac" else 1105 if codec.startswith("mp3") and kind in ("avi", "mpegts") else 0
    if n_samples and stream.rate:
        logger.warning(
            "%s: this format does not say how much silence its encoder put before the sound. It may come %.0f ms late; "
            "keep WAV or FLAC, or say it with --offset.",
            path,
            1000 * n_samples / stream.rate,
        )


def write_audio(path: str | Path, waveform: np.ndarray, sample_rate: int) -> Path:
    """Writes sound as 16-bit WAV or FLAC, as the file's name ends.

    Args:
        path: Of the file, `.wav` or `.flac`; its folder is made.
        waveform: (n,) or (n, channels), int16 PCM or floats in [-1, 1].
        sample_rate: Samples per second [Hz].

    Returns:
        The path.

    Raises:
        AudioFileError: The name ends otherwise.
        ValueError: The samples are neither, or the shape is another.
    """
    path, samples = Path(path), to_pcm_s16(waveform)
    ending = path.suffix.lower()
    if ending not in _CODECS:
        raise AudioFileError(f"{path}: sound is written as .wav or .flac; choose such a name.")
    if samples.ndim not in (1, 2):
        raise ValueError(f"Sound has shape {samples.shape}; wanted (n,) or (n, channels).")
    samples = samples.reshape(len(samples), -1)
    layout = {1: "mono", 2: "stereo"}.get(samples.shape[1], f"{samples.shape[1]}c")
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format=ending[1:], options={"fflags": "+bitexact"}) as container:
        stream: Any = container.add_stream(_CODECS[ending], rate=sample_rate, layout=layout)
        for start in range(0, len(samples), _BLOCK):
            block = np.ascontiguousarray(samples[start : start + _BLOCK])
            frame = av.AudioFrame.from_ndarray(block.reshape(1, -1), format="s16", layout=layout)
            frame.sample_rate, frame.pts = sample_rate, start
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def resample(waveform: np.ndarray, sample_rate: int, new_sample_rate: int) -> np.ndarray:
    """Sound at another sample rate, band-limited.

    Args:
        waveform: (n,) or (n, channels), int16 PCM or floats in [-1, 1].
        sample_rate: What it has [Hz].
        new_sample_rate: The wanted rate [Hz].

    Returns:
        As many seconds at the new rate, in the same form.
    """
    if sample_rate == new_sample_rate or not len(waveform):
        return waveform
    import torch
    import torchaudio

    is_pcm = waveform.dtype == np.int16
    floats = torch.from_numpy(waveform.astype(np.float32) / (32768 if is_pcm else 1))
    channels_first = floats.reshape(len(floats), -1).T  # (channels, n)
    if max(sample_rate, new_sample_rate) > _MOST_PHASES * math.gcd(sample_rate, new_sample_rate):
        converted = _resample_odd_rates(channels_first.numpy(), sample_rate, new_sample_rate)
    else:
        with torch.autocast("cpu", enabled=False):  # training asks within its own number format
            converted = torchaudio.functional.resample(
                channels_first,
                sample_rate,
                new_sample_rate,
                lowpass_filter_width=_FILTER_WIDTH,
                rolloff=_ROLLOFF,
                resampling_method="sinc_interp_kaiser",
                beta=14.769656459379492,
            ).numpy()
    result = converted.T.reshape(-1, *waveform.shape[1:])
    return to_pcm_s16(result) if is_pcm else result.astype(waveform.dtype)


def _resample_odd_rates(waveform: np.ndarray, sample_rate: int, new_sample_rate: int) -> np.ndarray:
    """(channels, n) float32 by FFmpeg's resampler, for rates with hardly a common divisor: it interpolates its filter."""
    n_samples = -(-waveform.shape[1] * new_sample_rate // sample_rate)
    layout = f"{len(waveform)}c"
    resampler = av.AudioResampler(format="fltp", layout=layout, rate=new_sample_rate)
    frames: list[av.AudioFrame] = []
    for first in range(0, waveform.shape[1], sample_rate):  # a frame of FFmpeg holds less than 2 GiB
        piece = np.ascontiguousarray(waveform[:, first : first + sample_rate])
        frame = av.AudioFrame.from_ndarray(piece, format="fltp", layout=layout)
        frame.sample_rate, frame.pts = sample_rate, first
        frames += resampler.resample(frame)
    frames += resampler.resample(None)
    found = np.concatenate([frame.to_ndarray() for frame in frames], axis=1)[:, :n_samples]
    return np.pad(found, ((0, 0), (0, n_samples - found.shape[1])))


def _kernels() -> np.ndarray:
    """(_PHASES + 1, 2 * HALF): a windowed sinc for every fraction of a sample."""
    fraction = np.arange(_PHASES + 1)[:, None] / _PHASES
    distance = np.arange(1 - HALF, HALF + 1) - fraction
    kernels = np.sinc(distance) * np.cos(np.pi * distance / (2 * HALF)) ** 2
    return kernels / kernels.sum(axis=1, keepdims=True)


_KERNELS = _kernels()


def interpolate(samples: np.ndarray, places: np.ndarray) -> np.ndarray:
    """What sound is between its samples.

    Args:
        samples: (n,) or (n, channels) int16.
        places: (m,), each at least `HALF - 1` samples after the first and `HALF` before the last one.

    Returns:
        (m,) or (m, channels) int16.
    """
    whole = np.floor(places).astype(np.int64)
    phase = (places - whole) * _PHASES
    index = phase.astype(np.int64)
    share = (phase - index)[:, None]
    kernel = (1 - share) * _KERNELS[index] + share * _KERNELS[index + 1]  # (m, 2 * HALF)
    around = samples[whole[:, None] + np.arange(1 - HALF, HALF + 1)]  # (m, 2 * HALF, ...)
    summed = (kernel.reshape(*kernel.shape, *[1] * (samples.ndim - 1)) * around).sum(axis=1)
    return np.clip(np.rint(summed), -32768, 32767).astype(np.int16)


def section(samples: np.ndarray, start: int, stop: int) -> np.ndarray:
    """Samples (n, ...) from one number to before another, which may lie outside: there they are 0."""
    there = np.asarray(samples[max(start, 0) : max(stop, 0)])
    before = min(max(-start, 0), stop - start)
    padding = [(before, stop - start - before - len(there)), *[(0, 0)] * (samples.ndim - 1)]
    return np.pad(there, padding)


def cut_into_frames(
    waveform: np.ndarray,
    sample_rate: int,
    fps: float,
    n_frames: int,
    offset: float = 0.0,
    pad: bool = False,
    new_sample_rate: int | None = None,
    speed: float = 1.0,
) -> np.ndarray:
    """The blocks of sound that belong to an episode's frames: for each, what was heard since the frame before.

    The block of frame i ends when frame i is taken. What was heard before the file began, at most the first frame's
    block when `offset` is 0, is silence. Of a memory map of hours only the episode's part is read.

    Args:
        waveform: (n,) or (n, channels), the file's samples; int16 where they are to be resampled.
        sample_rate: Its samples per second [Hz].
        fps: Frames per second [Hz].
        n_frames: The episode's length.
        offset: Where in the file the episode's first frame was taken [s]; negative if the file begins after it.
        pad: Fill what the file lacks at its beginning and its end with silence.
        new_sample_rate: Rate of the blocks [Hz], which `fps` divides. None: `sample_rate`.
        speed: Seconds of the file in a second of the frames' clock, in which `offset` is given; 1.001: the recorder's
            clock is 0.1 % fast.

    Returns:
        (n_frames, S) or (n_frames, S, channels), in the waveform's dtype.

    Raises:
        ValueError: The frame rate does not divide the new sample rate.
        AudioFileError: The file begins too late or ends too early, and `pad` is off.
    """
    rate = new_sample_rate or sample_rate
    size = samples_per_frame(rate, fps)
    start = round(offset * rate) - size  # in samples of the new rate, as all but `first`, `last` and `margin`
    stop = start + n_frames * size
    old, new = sample_rate // math.gcd(sample_rate, rate), rate // math.gcd(sample_rate, rate)
    n_steady = int((len(waveform) - 1) / speed) + 1 if len(waveform) else 0
    n_there = -(-n_steady * new // old)
    lacking = {"beginning": max(-start - size, 0), "end": max(stop - n_there, 0)}
    if any(lacking.values()) and not pad:
        lacks = [f"{missing / rate:.3f} s at its {end}" for end, missing in lacking.items() if missing]
        raise AudioFileError(
            f"it lasts {n_there / rate:.3f} s; {n_frames} frames at {fps} per second from {offset:.3f} s on "
            f"need {' and '.join(lacks)} more. Correct the offset, or fill with silence: pad=true."
        )
    # The part begins where both rates have a sample, so that it is resampled as the whole would be.
    margin = 0 if old == new else math.ceil(_FILTER_WIDTH / (min(old, new) * _ROLLOFF) + 1) * old
    first = max(start // new * old - margin, 0)
    last = min(-(-stop // new) * old + margin, n_steady)
    part = resample(_without_drift(waveform, first, max(first, last), speed), sample_rate, rate)
    skipped = first // old * new
    return section(part, start - skipped, stop - skipped).reshape(n_frames, size, *waveform.shape[1:])


def _without_drift(waveform: np.ndarray, first: int, last: int, speed: float) -> np.ndarray:
    """The samples from `first` to before `last` that a recorder without drift would have made; sample 0 stays."""
    if speed == 1 or first == last:
        return np.asarray(waveform[first:last])
    begin, end = int(first * speed) - HALF, int(last * speed) + HALF + 1
    samples = section(waveform, begin, end)
    edges = [*range(first, last, _PLACES_AT_ONCE), last]
    return np.concatenate([interpolate(samples, np.arange(a, b) * speed - begin) for a, b in itertools.pairwise(edges)])


def _to_samples(frame: Any) -> np.ndarray:
    """(n, channels) int16 of a decoded frame, whatever its format."""
    values = frame.to_ndarray()  # (channels, n) or, interleaved, (1, n * channels)
    n_channels = frame.layout.nb_channels
    values = values.T if frame.format.is_planar else values.reshape(-1, n_channels)
    if values.dtype == np.uint8:
        return (values.astype(np.int16) - 128) * 256
    if values.dtype == np.int32:  # 24 bits are shifted up to these
        return np.clip((values.astype(np.int64) + 2**15) >> 16, -32768, 32767).astype(np.int16)
    return to_pcm_s16(values)
