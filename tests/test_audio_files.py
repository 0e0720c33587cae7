"""Sound from files and from a microphone's callback, and back into files."""

import itertools
import wave
from fractions import Fraction

import av
import numpy as np
import pytest

from lerobot_playbyear.audio import cut_into_frames, read_audio, resample, write_audio
from lerobot_playbyear.audio.audio_files import AudioFileError, audio_pieces

RATE, FPS = 16000, 20
SIZE = RATE // FPS


def noise(n_samples: int, n_channels: int | None = None, seed: int = 0) -> np.ndarray:
    shape = (n_samples,) if n_channels is None else (n_samples, n_channels)
    return np.random.default_rng(seed).integers(-32768, 32768, shape).astype(np.int16)


def tone(frequency: float, sample_rate: int, seconds: float) -> np.ndarray:
    return (10000 * np.sin(2 * np.pi * frequency * np.arange(round(seconds * sample_rate)) / sample_rate)).astype(
        np.int16
    )


# Files


@pytest.mark.parametrize("ending", ["wav", "flac"])
@pytest.mark.parametrize("n_channels", [None, 1, 2])
def test_16_bits_come_back_bit_for_bit(tmp_path, ending, n_channels):
    waveform = noise(12345, n_channels)
    samples, rate = read_audio(write_audio(tmp_path / "deep" / f"sound.{ending}", waveform, 44100))
    assert rate == 44100
    assert samples.dtype == np.int16
    np.testing.assert_array_equal(samples, waveform.reshape(len(waveform), -1))


@pytest.mark.parametrize(("width", "tolerance"), [(1, 256), (3, 1), (4, 1)])
def test_other_depths_are_rounded_to_16_bits(tmp_path, width, tolerance):
    """PCM of 8, 24 and 32 bits, as a recorder may write it."""
    waveform = tone(440, RATE, 0.5)
    if width == 1:
        data = ((waveform.astype(np.int32) >> 8) + 128).astype(np.uint8).tobytes()
    else:
        wide = (waveform.astype(np.int64) << 8 * (width - 2)).astype("<i8").view(np.uint8).reshape(-1, 8)
        data = wide[:, :width].tobytes()
    with wave.open(str(tmp_path / "sound.wav"), "wb") as file:
        file.setparams((1, width, RATE, len(waveform), "NONE", ""))
        file.writeframes(data)
    samples, _ = read_audio(tmp_path / "sound.wav")
    assert np.abs(samples[:, 0].astype(int) - waveform).max() <= tolerance


def write_film(path, seconds: float, sound: np.ndarray | None, sound_from: float = 0.0) -> None:
    with av.open(str(path), "w") as film:
        video = film.add_stream("libx264", rate=FPS)
        video.width = video.height = 64
        audio = None if sound is None else film.add_stream("flac" if path.suffix == ".mkv" else "aac", rate=RATE)
        if audio is not None:
            audio.layout = "mono"
        for _ in range(round(seconds * FPS)):
            film.mux(video.encode(av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8), "rgb24")))
        film.mux(video.encode(None))
        if audio is not None:
            frame = av.AudioFrame.from_ndarray(sound.reshape(1, -1), "s16", "mono")
            frame.sample_rate, frame.pts, frame.time_base = RATE, round(sound_from * RATE), Fraction(1, RATE)
            film.mux(audio.encode(frame))
            film.mux(audio.encode(None))


def test_a_videos_sound_track_is_read_in_time_with_its_pictures(tmp_path):
    click = np.zeros(RATE, np.int16)
    click[4000:4010] = 30000
    write_film(tmp_path / "film.mkv", 2, click, sound_from=0.5)
    samples, rate = read_audio(tmp_path / "film.mkv")
    assert rate == RATE
    assert abs(int(np.argmax(samples[:, 0])) - (4000 + RATE // 2)) < 0.002 * RATE  # Matroska counts milliseconds


def test_a_gap_of_hours_is_silence_in_small_pieces(tmp_path):
    """A few kilobytes say that sound goes on after three hours: 345 MB of silence."""
    write_sound_with_a_gap(tmp_path / "gap.mkv", gap_s=3 * 3600)
    assert (tmp_path / "gap.mkv").stat().st_size < 100_000
    pieces = list(itertools.islice(audio_pieces(tmp_path / "gap.mkv"), 100))
    assert max(len(samples) for samples, _ in pieces) < 2 * RATE
    sound = np.concatenate([samples for samples, _ in pieces])
    assert (sound[:RATE] == 1000).all()
    assert not sound[RATE:].any()


def test_sound_after_a_gap_is_at_its_time(tmp_path):
    write_sound_with_a_gap(tmp_path / "gap.mkv", gap_s=5)
    sound, _ = read_audio(tmp_path / "gap.mkv")
    assert len(sound) == 7 * RATE
    assert np.flatnonzero(np.diff(sound[:, 0])).tolist() == [RATE - 1, 6 * RATE - 1]


def write_sound_with_a_gap(path, gap_s: float) -> None:
    """A second of sound, a gap without any packet, and another second."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=RATE, layout="mono")
        for start_s in (0, 1 + gap_s):
            frame = av.AudioFrame.from_ndarray(np.full((1, RATE), 1000, np.int16), "s16", "mono")
            frame.sample_rate, frame.pts, frame.time_base = RATE, round(start_s * RATE), Fraction(1, RATE)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def test_what_holds_no_sound_is_named(tmp_path):
    (tmp_path / "text.wav").write_bytes(b"hello")
    (tmp_path / "empty.flac").touch()
    write_film(tmp_path / "silent.mp4", 0.5, None)
    said = {"text.wav": "cannot be decoded", "empty.flac": "holds no samples", "silent.mp4": "holds no sound"}
    for name, message in said.items():
        with pytest.raises(AudioFileError, match=f"{name}.*{message}"):
            read_audio(tmp_path / name)
    with pytest.raises(AudioFileError, match=r"written as \.wav or \.flac"):
        write_audio(tmp_path / "sound.mp3", noise(10), RATE)
    with pytest.raises(ValueError, match="NaN"):
        write_audio(tmp_path / "sound.flac", np.array([np.nan]), RATE)


# Sample rates


@pytest.mark.parametrize(("old", "new"), [(44100, 48000), (48000, 16000), (16000, 48000)])
def test_resampling_keeps_a_tone(old, new):
    result = resample(tone(1000, old, 1), old, new)
    expected = tone(1000, new, 1)
    assert result.dtype == np.int16
    assert len(result) == new
    middle = slice(new // 10, -new // 10)
    assert np.abs(result[middle].astype(int) - expected[middle]).max() < 60


def test_resampling_removes_what_the_new_rate_cannot_hold():
    assert np.abs(resample(tone(12000, 48000, 1), 48000, 16000)[1600:-1600]).max() < 30


# From a file to frames


def test_a_frames_block_ends_when_the_frame_is_taken():
    waveform = np.arange(RATE * 2, dtype=np.int16)
    blocks = cut_into_frames(waveform, RATE, FPS, 10, offset=0.5)
    assert blocks.shape == (10, SIZE)
    assert blocks[0, -1] == RATE // 2 - 1
    np.testing.assert_array_equal(blocks.ravel(), waveform[RATE // 2 - SIZE : RATE // 2 + 9 * SIZE])


def test_a_file_that_is_too_short_is_refused_or_filled():
    waveform = np.ones(5 * SIZE, np.int16)
    cut_into_frames(waveform, RATE, FPS, 6)  # exactly enough
    with pytest.raises(AudioFileError, match=r"lasts 0\.250 s; 7 frames .* need 0\.050 s at its end more.*pad=true"):
        cut_into_frames(waveform, RATE, FPS, 7)
    with pytest.raises(AudioFileError, match=r"0\.100 s at its beginning"):
        cut_into_frames(waveform, RATE, FPS, 3, offset=-0.1)
    padded = cut_into_frames(waveform, RATE, FPS, 10, offset=-0.1, pad=True)
    assert padded.any(axis=1).tolist() == [False] * 3 + [True] * 5 + [False] * 2
    assert not cut_into_frames(waveform, RATE, FPS, 4, offset=9, pad=True).any()
    assert not cut_into_frames(waveform, RATE, FPS, 4, offset=-9, pad=True).any()


# The contract of columns


def test_float_sound_is_written_at_full_scale(tmp_path):
    path = write_audio(tmp_path / "float.wav", np.array([-1.5, -1.0, 0.0, 0.5, 1.0], dtype=np.float32), 8000)

    with wave.open(str(path)) as file:
        samples = np.frombuffer(file.readframes(5), dtype="<i2")
    assert samples.tolist() == [-32768, -32768, 0, 16384, 32767]
