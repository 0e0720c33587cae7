"""What recording takes: frames per second beside stock LeRobot, waits at a robot's pace, and a microphone's picture.

    python benchmarks/recording.py

Frames of one camera and one microphone are added as fast as they are taken, and the episode is saved: by
`DurableWriter`, after which it survives a power cut, and by `LeRobotDataset` alone, in turns. The limit is compressing the
pictures. Then frames of a robot come at its rate: the longest time that `add_frame` takes is the longest that a frame waits for
the disk, and the next one is late if that is longer than a frame.

A microphone's picture is drawn as its camera draws it: new columns of the spectrogram, the strip, the timecode. Beside it,
the whole spectrogram drawn from nothing. Its error is what LeRobot's video encoder makes of it at its defaults, in grey
levels, of 255, between keyframes and in them.
"""

import argparse
import io
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
from common import CAMERAS, Row, dataset_features, frames, in_turns, medians, parser_for, run, seconds_of
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from PIL import Image

from lerobot_playbyear.audio.microphone_pictures import (
    Strip,
    n_kept,
    n_rows,
    read_timecode,
    write_strip,
    write_timecode,
)
from lerobot_playbyear.audio.sound_picture import RollingSpectrogram
from lerobot_playbyear.datasets.durable import DurableWriter

FPS, N_FRAMES = 20, 200
ROBOT_FPS, SECONDS = 30, 60  # at a robot's pace
SIZE, N_PICTURES, KEY = 224, 400, "observation.images.mic"


def as_fast_as_it_goes(folder: Path, turns: int) -> Row:
    """Ours, stock, and compression alone."""
    features = dataset_features((84, 84), 16000, FPS)
    episode = list(frames(features, N_FRAMES))
    options = {"image_writer_threads": 4, "video_backend": "pyav"}
    stock = LeRobotDataset.create("benchmark/stock", FPS, features, root=folder / "stock", **options)

    def write(writer: DurableWriter | LeRobotDataset) -> None:
        for frame in episode:
            writer.add_frame(dict(frame))
        writer.save_episode()

    def compress() -> None:
        for frame in episode:
            Image.fromarray(frame[CAMERAS[0]]).save(io.BytesIO(), format="PNG", compress_level=1)

    with DurableWriter("benchmark/ours", folder / "ours", FPS, features) as ours:
        works = {"ours": lambda: write(ours), "stock": lambda: write(stock), "limit": compress}
        rates = {name: N_FRAMES / took for name, took in medians(in_turns(works, turns)).items()}
    stock.finalize()
    beside = ("stock LeRobotDataset, which a crash can cost the session", rates["stock"])
    name = "recording, 84 px pictures, one 16 kHz microphone, saved for good"
    return Row(name, rates["ours"], "frames/s", *beside, "compressing the pictures", rates["limit"])


def at_a_robots_pace(folder: Path) -> list[Row]:
    """A camera's video of 640 x 480 and two microphones of 48 kHz."""
    waits, features = [], dataset_features((480, 640), 48000, ROBOT_FPS, 2, "video")
    encoder = RGBEncoderConfig(vcodec="h264", preset="veryfast")
    with DurableWriter("benchmark/robot", folder / "robot", ROBOT_FPS, features, rgb_encoder=encoder) as writer:
        begun = time.perf_counter()
        for i, frame in enumerate(frames(features, SECONDS * ROBOT_FPS)):
            time.sleep(max(0.0, begun + i / ROBOT_FPS - time.perf_counter()))
            waits.append(seconds_of(partial(writer.add_frame, frame)))
        saving = seconds_of(writer.save_episode)
    late = sum(wait > 1 / ROBOT_FPS for wait in waits)
    name = f"{ROBOT_FPS} Hz, 640x480 video, two microphones: {late} of {len(waits)} frames late, longest wait"
    limit = {"limit_is": "a frame", "limit": 1e3 / ROBOT_FPS}
    return [Row(name, 1e3 * max(waits), "ms", **limit), Row(f"saving the {SECONDS} s", saving, "s")]


class Drawn:
    """A microphone's pictures of a sound, step by step."""

    def __init__(self, rate: int) -> None:
        self.sound, self.rate, self.counter = contacts(rate), rate, 3 * rate
        self.rows = n_rows(rate, SIZE)
        self.spectrogram = self.new()

    def new(self) -> RollingSpectrogram:
        return RollingSpectrogram(self.rate, SIZE - self.rows, SIZE, -90, -20)

    def next(self) -> np.ndarray:
        self.counter += round(1.005 * self.rate / FPS)
        if self.counter > len(self.sound):
            self.counter = 3 * self.rate + self.counter % 97
        grey = self.spectrogram.draw(self.counter, lambda start, stop: self.sound[start:stop])
        picture = np.zeros((SIZE, SIZE, 3), np.uint8)
        picture[: len(grey)] = grey[:, :, None]
        kept = self.sound[self.counter - n_kept(self.rate) : self.counter]
        write_strip(picture, Strip(7, self.counter, self.rate, kept, -90, -20))
        write_timecode(picture, 7, self.counter)
        return picture

    def whole(self) -> None:
        self.new().draw(self.counter, lambda start, stop: self.sound[start:stop])


def contacts(rate: int, seconds: int = 30) -> np.ndarray:
    """A quiet room with knocks, some loud and some faint, (n,) int16."""
    rng, n = np.random.default_rng(0), seconds * rate
    wave, time_s = rng.normal(0, 8, n), np.arange(rate // 4) / rate
    for at in rng.uniform(0, seconds - 1, 2 * seconds):
        knock = np.exp(-time_s / 0.03) * np.sin(2 * np.pi * rng.uniform(300, 5000) * time_s)
        wave[round(at * rate) :][: len(knock)] += 10 ** rng.uniform(2, 4) * knock
    return np.clip(np.rint(wave), -32768, 32767).astype(np.int16)


def encoded(drawn: Drawn, root: Path) -> Row:
    """How many timecodes are wrong after encoding, and the spectrogram's error."""
    camera = {"dtype": "video", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]}
    features = {KEY: camera, "action": {"dtype": "float32", "shape": (1,), "names": None}}
    dataset = LeRobotDataset.create("benchmark/film", FPS, features, root=root)
    pictures, counters = [], []
    for _ in range(N_PICTURES):
        pictures.append(drawn.next())
        counters.append(drawn.counter)
        dataset.add_frame({"action": np.zeros(1, np.float32), KEY: pictures[-1], "task": "listen"})
    dataset.save_episode()
    dataset.finalize()
    film = LeRobotDataset("benchmark/film", root=root, video_backend="pyav", return_uint8=True)
    decoded = [film[i][KEY].permute(1, 2, 0).numpy() for i in range(N_PICTURES)]
    wrong = sum(read_timecode(picture) != (7, counter) for picture, counter in zip(decoded, counters, strict=True))
    inside = slice(64, SIZE - drawn.rows)
    drawn_and_seen = zip(pictures, decoded, strict=True)
    errors = [np.abs(a[inside, :, 0].astype(int) - b[inside].mean(axis=-1)).mean() for a, b in drawn_and_seen]
    name = f"{drawn.rate} Hz: error between keyframes, {wrong} of {N_PICTURES} timecodes wrong"
    return Row(name, float(np.mean(errors[1::2])), "grey levels", "in keyframes", float(np.mean(errors[::2])))


def measure(args: argparse.Namespace) -> list[Row]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = [as_fast_as_it_goes(folder, args.turns), *at_a_robots_pace(folder)]
        for rate in (16000, 48000):
            drawn = Drawn(rate)
            seconds = medians(in_turns({"next": drawn.next, "whole": drawn.whole}, 20 * args.turns, 5))
            beside = ("the whole spectrogram", 1e3 * seconds["whole"])
            rows.append(Row(f"{rate} Hz: a microphone's picture", 1e3 * seconds["next"], "ms", *beside))
            rows.append(encoded(Drawn(rate), folder / str(rate)))
    return rows


if __name__ == "__main__":
    run(parser_for(__doc__, turns=5), measure)
