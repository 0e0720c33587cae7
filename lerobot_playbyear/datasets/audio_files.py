"""Sound in files: WAV, FLAC and the sound tracks of videos in, WAV and FLAC out, and how a recording meets frames."""

import math
import wave
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import av
import numpy as np

from lerobot_playbyear.datasets.features import samples_per_frame, to_pcm_s16

_GAP_SECONDS = 0.02  # between two packets of a sound track; smaller ones are rounding
_SILENCE_AT_ONCE = 2**14  # samples
_FLAC_BLOCK = 4096  # samples
_FILTER_WIDTH, _ROLLOFF = 64, 0.9475937167399596  # of the resampler
_MOST_PHASES = 4096  # of its filter, which takes the square of them in memory


class AudioFileError(ValueError):
    """A sound file cannot be used; the message says why, and what to do."""


class Channels(Protocol):
    """What is needed of sound that may not be in memory: its shape (n, channels), and slices of it."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __len__(self) -> int: ...

    def __getitem__(self, span: slice, /) -> np.ndarray: ...


def read_audio(path: str | Path) -> tuple[np.ndarray, int]:
    """Reads the sound of a file: WAV, FLAC, MP3, or a video's sound track; whatever FFmpeg reads.

    Args:
        path: The file.

    Returns:
        The samples, (n, channels) int16 PCM, and the sample rate [Hz]. Sample 0 is at the file's time 0: a sound
        track that begins after its video begins with silence. 16-bit files come out bit for bit; others are rounded.

    Raises:
        AudioFileError: The file is missing, or holds no sound that can be decoded.
    """
    parts = list(audio_pieces(path))
    return np.concatenate([samples for samples, _ in parts]), parts[0][1]


def audio_pieces(path: str | Path, formats: str = "") -> Iterator[tuple[np.ndarray, int]]:
    """As `read_audio`, in pieces of bounded size, each with the sample rate; silence, how long it may be, is no exception.

    Args:
        path: The file.
        formats: FFmpeg's names of the formats that it may have, separated by commas; empty: any. A stranger's file of some
            formats (playlists) would have others opened.

    Raises:
        AudioFileError: The file is missing, or holds no sound that can be decoded.
    """
    path = Path(path)
    if not path.is_file():
        raise AudioFileError(f"There is no sound file {path}.")
    position = rate = 0
    try:
        with av.open(str(path), options={"format_whitelist": formats} if formats else {}) as container:
            if not container.streams.audio:
                raise AudioFileError(f"{path} holds no sound.")
            rate = container.streams.audio[0].rate
            for frame in container.decode(audio=0):
                samples = _to_samples(frame)  # (n, channels)
                start = round(frame.time * rate) if frame.time is not None else position
                if position == 0 and start < 0:
                    samples, start = samples[-start:], 0
                if start - position > (_GAP_SECONDS * rate if position else 0):
                    while position < start:  # a file may say that it goes on after years
                        silence = np.zeros((min(start - position, _SILENCE_AT_ONCE), samples.shape[1]), np.int16)
                        position += len(silence)
                        yield silence, rate
                position += len(samples)
                yield samples, rate
    except (av.FFmpegError, ValueError) as error:
        if isinstance(error, AudioFileError):
            raise
        raise AudioFileError(f"The sound of {path} cannot be decoded: {error}.") from error
    if not position:
        raise AudioFileError(f"{path} holds no samples.")


def pcm_channels(waveform: np.ndarray) -> np.ndarray:
    """Sound (n,) or (n, channels) as (n, channels) int16 PCM. Raises as `to_pcm_s16`, also where the shape is another."""
    samples = to_pcm_s16(waveform)
    if samples.ndim not in (1, 2):
        raise ValueError(f"Sound has shape {samples.shape}; wanted (n,) or (n, channels).")
    return samples[:, None] if samples.ndim == 1 else samples


def write_wav(path: str | Path, waveform: np.ndarray, sample_rate: int) -> Path:
    """Write sound as a 16-bit WAV file.

    Args:
        path: The file to write; its folder is made.
        waveform: (n,) or (n, channels), int16 PCM or floats in [-1, 1].
        sample_rate: Samples per second [Hz].

    Returns:
        The path of the file.

    Raises:
        ValueError: If the samples are neither, or the shape is another.
    """
    samples = pcm_channels(waveform)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with wave.open(str(path), "wb") as file:
        file.setnchannels(samples.shape[1])
        file.setsampwidth(2)
        file.setframerate(sample_rate)
        file.writeframes(np.ascontiguousarray(samples).astype("<i2").tobytes())
    return path


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
    path = Path(path)
    if path.suffix.lower() == ".wav":
        return write_wav(path, waveform, sample_rate)
    if path.suffix.lower() != ".flac":
        raise AudioFileError(f"{path}: sound is written as .wav or .flac; choose such a name.")
    samples = pcm_channels(waveform)
    path.parent.mkdir(parents=True, exist_ok=True)
    layout = "mono" if samples.shape[1] == 1 else "stereo" if samples.shape[1] == 2 else f"{samples.shape[1]}c"
    with av.open(str(path), "w", format="flac") as container:
        stream: Any = container.add_stream("flac", rate=sample_rate, layout=layout)
        for start in range(0, len(samples), _FLAC_BLOCK):
            block = np.ascontiguousarray(samples[start : start + _FLAC_BLOCK])
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
        new_sample_rate: What it shall have [Hz].

    Returns:
        As many seconds at the new rate, in the same form.
    """
    if sample_rate == new_sample_rate:
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
    resampled = np.zeros((len(waveform), n_samples), np.float32)
    for channel, values in enumerate(waveform):
        resampler = av.AudioResampler(format="flt", layout="mono", rate=new_sample_rate)
        parts = []
        for first in range(0, len(values), sample_rate):
            piece = np.ascontiguousarray(values[None, first : first + sample_rate])
            frame = av.AudioFrame.from_ndarray(piece, format="flt", layout="mono")
            frame.sample_rate, frame.pts = sample_rate, first
            parts += [part.to_ndarray().reshape(-1) for part in resampler.resample(frame)]
        parts += [part.to_ndarray().reshape(-1) for part in resampler.resample(None)]
        values = np.concatenate(parts)[:n_samples]
        resampled[channel, : len(values)] = values
    return resampled


class Resampled:
    """Sound at another sample rate, as `resample` makes it, computed where it is indexed.

    Args:
        sound: (n, channels) int16 PCM.
        sample_rate: What it has [Hz].
        new_sample_rate: What it shall have [Hz].
    """

    def __init__(self, sound: Channels, sample_rate: int, new_sample_rate: int) -> None:
        divisor = math.gcd(sample_rate, new_sample_rate)
        self._sound, self._rates = sound, (sample_rate, new_sample_rate)
        self._old, self._new = sample_rate // divisor, new_sample_rate // divisor
        reach = _FILTER_WIDTH * self._old / (min(self._old, self._new) * _ROLLOFF)  # samples on each side of one
        self._margin = math.ceil(reach / self._old + 1) * self._old
        self.shape = (-(-len(sound) * self._new // self._old), sound.shape[1])

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, span: slice) -> np.ndarray:
        start, stop, _ = span.indices(len(self))
        if self._old == self._new or start >= stop:
            return self._sound[start:stop]
        first = start // self._new * self._old - self._margin
        last = -(-stop // self._new) * self._old + self._margin
        inside = self._sound[max(first, 0) : last]
        padded = np.pad(inside, ((max(-first, 0), last - max(first, 0) - len(inside)), (0, 0)))
        skipped = (self._margin // self._old) * self._new + start % self._new
        return resample(padded, *self._rates)[skipped : skipped + stop - start]


def cut_into_frames(
    waveform: np.ndarray, sample_rate: int, fps: int, n_frames: int, offset: float = 0.0, pad: bool = False
) -> np.ndarray:
    """The blocks of sound that belong to an episode's frames: for each, what was heard since the frame before.

    The block of frame i ends when frame i is taken. What was heard before the file began, at most the first frame's
    block when `offset` is 0, is silence.

    Args:
        waveform: (n,), the file's samples.
        sample_rate: Its samples per second [Hz], a multiple of `fps`.
        fps: Frames per second [Hz].
        n_frames: The episode's length.
        offset: Where in the file the episode's first frame was taken [s]; negative if the file begins after it.
        pad: Fill what the file lacks at its beginning and its end with silence.

    Returns:
        (n_frames, S), in the waveform's dtype.

    Raises:
        ValueError: The frame rate does not divide the sample rate.
        AudioFileError: The file begins too late or ends too early, and `pad` is off.
    """
    cut = Cut(waveform[:, None], sample_rate, fps, n_frames, offset, pad)
    return cut[:].reshape(n_frames, -1)


class Cut:
    """The sound of an episode's frames, (n_frames * S, channels), as `cut_into_frames` has it, read where it is indexed.

    Args:
        sound: (n, channels), the file's samples.
        sample_rate, fps, n_frames, offset, pad: As for `cut_into_frames`.

    Raises:
        ValueError, AudioFileError: As for `cut_into_frames`.
    """

    def __init__(
        self, sound: Channels, sample_rate: int, fps: int, n_frames: int, offset: float = 0.0, pad: bool = False
    ) -> None:
        size = samples_per_frame(sample_rate, fps)
        self._sound, self._start = sound, round(offset * sample_rate) - size
        self.shape = (n_frames * size, sound.shape[1])
        missing_before = max(-self._start - size, 0)
        missing_after = max(self._start + n_frames * size - len(sound), 0)
        if (missing_before or missing_after) and not pad:
            lacks = [
                f"{missing / sample_rate:.3f} s at its {end}"
                for missing, end in ((missing_before, "beginning"), (missing_after, "end"))
                if missing
            ]
            raise AudioFileError(
                f"it lasts {len(sound) / sample_rate:.3f} s; {n_frames} frames at {fps} per second from {offset:.3f} s on "
                f"need {' and '.join(lacks)} more. Correct the offset, or fill with silence: pad=true."
            )

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, span: slice) -> np.ndarray:
        start, stop, _ = (edge + self._start for edge in span.indices(len(self)))
        found = self._sound[max(start, 0) : max(stop, 0)]
        before = min(max(-start, 0), stop - start)
        return np.pad(found, ((before, stop - start - before - len(found)), (0, 0)))


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
