"""The moment of a sound in a file is that of the file, whatever its format says about clocks and encoders."""

import logging
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch

from lerobot_playbyear.audio import read_audio, write_audio
from lerobot_playbyear.audio.audio_files import AudioFileError
from lerobot_playbyear.policy.sound_augmentation import RecordedNoise, noise_floor

CLICK_S, LASTS_S = 1.0, 2.0


def write(path: Path, codec: str, rate: int, has_pictures: bool, begins_s: float = 0, late_s: float = 0) -> Path:
    """A click in silence, in a file whose clock begins at `begins_s`; sound `late_s` after the pictures."""
    samples = np.zeros(int(LASTS_S * rate), np.float32)
    first = int(CLICK_S * rate)
    samples[first : first + rate // 500] = 0.9 * np.sin(2 * np.pi * 1000 * np.arange(rate // 500) / rate)
    formats = {".aac": "adts", ".m4a": "ipod", ".mkv": "matroska", ".ts": "mpegts"}
    with av.open(str(path), "w", format=formats.get(path.suffix)) as file:
        pictures: Any = file.add_stream("libx264", rate=20) if has_pictures else None
        sound: Any = file.add_stream(codec, rate=rate, layout="mono")
        if pictures:
            pictures.width = pictures.height = 32
            for number in range(40):
                picture = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), "rgb24")
                picture.pts, picture.time_base = number + round(20 * begins_s), Fraction(1, 20)
                file.mux(pictures.encode(picture))
            file.mux(pictures.encode(None))
        kind, size = sound.codec_context.format.name, sound.codec_context.frame_size or 1024
        scale, dtype = {"flt": (1, np.float32), "s16": (2**15 - 1, np.int16), "s32": (2**30, np.int32)}[kind[:3]]
        for start in range(0, len(samples), size):
            block = (scale * samples[start : start + size]).astype(dtype)[None]
            frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(block), format=kind, layout="mono")
            frame.sample_rate, frame.time_base = rate, Fraction(1, rate)
            frame.pts = start + round((begins_s + late_s) * rate)
            file.mux(sound.encode(frame))
        file.mux(sound.encode(None))
    return path


def click(path: Path) -> float:
    """When the click is heard [s]."""
    samples, rate = read_audio(path)
    loud = np.abs(samples[:, 0].astype(float))
    return int(np.flatnonzero(loud > 0.3 * loud.max())[0]) / rate


@pytest.mark.parametrize(
    ("name", "codec", "rate", "has_pictures", "begins_s"),
    [
        ("sound.mkv", "pcm_s16le", 16000, False, 10),
        ("film.mkv", "flac", 16000, True, 10),
        ("film.mkv", "aac", 48000, True, 10),
        ("film.mkv", "aac", 48000, True, 0),
        ("film.mp4", "aac", 48000, True, 10),
        ("film.ts", "aac", 48000, True, 0),
        ("film.flv", "aac", 44100, True, 0),
        ("sound.webm", "libopus", 48000, False, 0),
        ("sound.mp3", "libmp3lame", 44100, False, 0),
        ("sound.mp3", "libmp3lame", 16000, False, 0),
        ("sound.m4a", "aac", 48000, False, 0),
        ("sound.ogg", "libopus", 48000, False, 0),
    ],
)
def test_a_click_is_heard_when_it_was(tmp_path, caplog, name, codec, rate, has_pictures, begins_s):
    assert click(write(tmp_path / name, codec, rate, has_pictures, begins_s)) == pytest.approx(CLICK_S, abs=0.001)
    assert not caplog.records


@pytest.mark.parametrize("begins_s", [0, 10])
@pytest.mark.parametrize("name", ["film.mkv", "film.mp4"])
def test_sound_that_begins_after_the_pictures_comes_later(tmp_path, name, begins_s):
    path = write(tmp_path / name, "flac" if name == "film.mkv" else "aac", 48000, True, begins_s, late_s=0.5)
    assert click(path) == pytest.approx(CLICK_S + 0.5, abs=0.001)


@pytest.mark.parametrize(
    ("name", "codec", "delay_ms"),
    [("sound.aac", "aac", 21), ("film.avi", "libmp3lame", 23), ("film.ts", "libmp3lame", 23)],
)
def test_formats_that_do_not_say_their_delay_are_told(tmp_path, caplog, name, codec, delay_ms):
    path = write(tmp_path / name, codec, 48000, name != "sound.aac")
    assert click(path) == pytest.approx(CLICK_S, abs=0.03)
    assert (
        f"does not say how much silence its encoder put before the sound. It may come {delay_ms} ms late" in caplog.text
    )


@pytest.mark.parametrize("name", ["sound.wav", "sound.flac", "sound.mp3"])
def test_what_is_left_of_a_file_that_was_cut_off_is_read(tmp_path, caplog, name):
    path, noise = tmp_path / name, np.random.default_rng(0).integers(-9000, 9000, 16000).astype(np.int16)
    if name == "sound.mp3":
        write(path, "libmp3lame", 16000, False)
    else:
        write_audio(path, noise, 16000)
    whole = read_audio(path)[0]
    path.write_bytes(path.read_bytes()[: -path.stat().st_size // 4 - 1])
    with caplog.at_level(logging.WARNING):
        rest = read_audio(path)[0]
    assert 0.5 * len(whole) < len(rest) < len(whole)
    assert (rest[: len(rest) - 4096] == whole[: len(rest) - 4096]).all()
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(AudioFileError):
        read_audio(path)


def wav(
    path: Path, samples: np.ndarray, tag: int, n_bits: int, valid: int | None = None, form: bytes = b"RIFF"
) -> Path:
    """One channel; with `valid` as an extensible WAV, with a chunk of other things before its format, as recorders write it."""
    size = samples.itemsize
    head = struct.pack("<HHIIHH", tag if valid is None else 0xFFFE, 1, 16000, 16000 * size, size, n_bits)
    if valid is not None:
        head += struct.pack("<HHIH", 22, valid, 4, tag) + bytes.fromhex("000000001000800000aa00389b71")
    chunks = {b"bext": b"fmt " * 150 + b"!", b"fmt ": head, b"data": samples.tobytes()}
    body = b"".join(name + struct.pack("<I", len(each)) + each + bytes(len(each) % 2) for name, each in chunks.items())
    path.write_bytes(form + struct.pack("<I", 4 + len(body)) + b"WAVE" + body)
    return path


@pytest.mark.parametrize(
    ("dtype", "tag", "n_bits", "valid"),
    [
        ("<i4", 1, 32, 24),
        ("<i4", 1, 24, 24),
        ("<i4", 1, 24, None),
        ("<i4", 1, 32, 20),
        ("<i4", 1, 32, 16),
        ("<i2", 1, 16, 12),
        ("<i2", 1, 16, 8),
        ("<f4", 3, 32, 24),
        ("<f8", 3, 64, 53),
    ],
)
def test_samples_with_room_for_more_bits_than_they_hold_are_read_as_they_are(tmp_path, dtype, tag, n_bits, valid):
    sound = np.random.default_rng(0).integers(-9000, 9000, 1001)
    full = {"i": 2 ** (8 * np.dtype(dtype).itemsize - 16), "f": 1 / 32768}[dtype[1]]
    samples, rate = read_audio(wav(tmp_path / "sound.wav", (sound * full).astype(dtype), tag, n_bits, valid))
    assert rate == 16000
    assert np.abs(samples[:, 0] - sound).max() <= (dtype[1] == "f")


def test_a_wav_file_that_ffmpeg_misreads_is_refused(tmp_path):
    path = wav(tmp_path / "sound.wav", np.zeros(100, ">i2"), 1, 16, form=b"RIFX")
    with pytest.raises(AudioFileError, match=r"big-endian numbers \(RIFX\)"):
        read_audio(path)


@pytest.mark.parametrize("offset", [0.01, -0.3])
def test_an_offset_is_no_loudness(tmp_path, offset):
    """Which a cheap sound card's converter adds."""
    noise = 0.001 * torch.randn(2, 16000, generator=torch.Generator().manual_seed(0))
    assert noise_floor(noise + offset).flatten().tolist() == pytest.approx(
        noise_floor(noise).flatten().tolist(), rel=1e-3
    )
    for name, added in (("plain", 0.0), ("offset", offset)):
        write_audio(tmp_path / name / "noise.wav", (100 * noise[0] + added).numpy(), 16000)
    plain, shifted = (RecordedNoise(tmp_path / name, 16000).excerpts(1, 16000) for name in ("plain", "offset"))
    assert float(shifted.std()) == pytest.approx(float(plain.std()), rel=0.05)
    assert abs(float(shifted.mean())) < 0.05
