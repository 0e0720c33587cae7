"""What a microphone costs a control loop at 20 Hz, and what LeRobot's video encoder does to its picture.

    python benchmarks/microphone.py

A picture is drawn as the camera draws it: new columns of the spectrogram, the strip, the timecode. Beside it, the whole
spectrogram drawn from nothing. The encoder is LeRobot's at its defaults; errors are in grey levels, of 255, in
keyframes and in the pictures between them.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from common import Row, in_turns, medians, parser_for, run
from lerobot.datasets import LeRobotDataset

from lerobot_playbyear.audio.control_steps import ControlStepSound
from lerobot_playbyear.audio.rolling_spectrogram import RollingSpectrogram
from lerobot_playbyear.audio.sample_strip import Strip, n_kept, n_rows, read_timecode, write_strip, write_timecode

FPS, SIZE, N_PICTURES, KEY = 20, 224, 400, "observation.images.mic"


class Drawn:
    """A microphone's pictures of a sound, step by step."""

    def __init__(self, sound: np.ndarray, rate: int) -> None:
        self.sound, self.rate, self.counter = sound, rate, 3 * rate
        self.rows = n_rows(rate, SIZE)
        self.spectrogram = RollingSpectrogram(rate, SIZE - self.rows, SIZE, -90, -20)

    def strip(self) -> Strip:
        return Strip(7, self.counter, self.rate, self.sound[self.counter - n_kept(self.rate) : self.counter], -90, -20)

    def next(self) -> np.ndarray:
        self.counter += round(1.005 * self.rate / FPS)
        if self.counter > len(self.sound):
            self.counter = 3 * self.rate + self.counter % 97
        grey = self.spectrogram.draw(self.counter, lambda start, stop: self.sound[start:stop])
        picture = np.zeros((SIZE, SIZE, 3), np.uint8)
        picture[: len(grey)] = grey[:, :, None]
        write_strip(picture, self.strip())
        write_timecode(picture, 7, self.counter)
        return picture

    def whole(self) -> None:
        RollingSpectrogram(self.rate, SIZE - self.rows, SIZE, -90, -20).draw(
            self.counter, lambda start, stop: self.sound[start:stop]
        )


def contacts(rate: int, seconds: int = 30) -> np.ndarray:
    """A quiet room with knocks, some loud and some faint, (n,) int16."""
    rng, n = np.random.default_rng(0), seconds * rate
    wave = rng.normal(0, 8, n)
    for at in rng.uniform(0, seconds - 1, 2 * seconds):
        time_s = np.arange(rate // 4) / rate
        knock = np.exp(-time_s / 0.03) * np.sin(2 * np.pi * rng.uniform(300, 5000) * time_s)
        wave[round(at * rate) :][: len(knock)] += 10 ** rng.uniform(2, 4) * knock
    return np.clip(np.rint(wave), -32768, 32767).astype(np.int16)


def encoded(drawn: Drawn) -> tuple[int, float, float]:
    """How many timecodes are wrong after encoding, and the spectrogram's error in keyframes and between."""
    feature = {"dtype": "video", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]}
    pictures, counters = [], []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "film"
        action = {"dtype": "float32", "shape": (1,), "names": None}
        dataset = LeRobotDataset.create("me/film", FPS, {"action": action, KEY: feature}, root=root)
        for _ in range(N_PICTURES):
            pictures.append(drawn.next())
            counters.append(drawn.counter)
            dataset.add_frame({"action": np.zeros(1, np.float32), KEY: pictures[-1], "task": "listen"})
        dataset.save_episode()
        dataset.finalize()
        film = LeRobotDataset("me/film", root=root, video_backend="pyav", return_uint8=True)
        decoded = [film[i][KEY].permute(1, 2, 0).numpy() for i in range(N_PICTURES)]
    wrong = sum(read_timecode(picture) != (7, counter) for picture, counter in zip(decoded, counters, strict=True))
    inside = slice(64, SIZE - drawn.rows)
    errors = [
        float(np.abs(a[inside, :, 0].astype(int) - b[inside].mean(axis=-1)).mean())
        for a, b in zip(pictures, decoded, strict=True)
    ]
    return wrong, float(np.mean(errors[::2])), float(np.mean(errors[1::2]))


def measure(args: argparse.Namespace) -> list[Row]:
    """Three rows for each rate."""
    rows = []
    for rate in (16000, 48000):
        drawn = Drawn(contacts(rate), rate)
        steps = ControlStepSound(rate // FPS)
        steps.next(drawn.strip())

        def hear(drawn: Drawn = drawn, steps: ControlStepSound = steps) -> None:
            drawn.counter += (
                round(1.005 * drawn.rate / FPS) if drawn.counter < len(drawn.sound) - drawn.rate else -drawn.rate
            )
            steps.next(drawn.strip())

        ms = {
            name: 1000 * value
            for name, value in medians(
                in_turns({"next": drawn.next, "whole": drawn.whole, "hear": hear}, args.turns, 5)
            ).items()
        }
        wrong, keyframes, between = encoded(Drawn(contacts(rate), rate))
        wanted = {"wanted": "at most 2 ms", "holds": ms["next"] <= 2}
        rows += [
            Row(f"a picture, {rate} Hz", ms["next"], "ms", "the whole spectrogram", ms["whole"], **wanted),
            Row(f"the sound of a control step while acting, {rate} Hz", ms["hear"], "ms"),
            Row(
                f"error between keyframes, {rate} Hz, {wrong} of {N_PICTURES} timecodes wrong",
                between,
                "grey levels",
                "in keyframes",
                keyframes,
            ),
        ]
    return rows


if __name__ == "__main__":
    run("microphone", parser_for(__doc__, turns=100), measure)
