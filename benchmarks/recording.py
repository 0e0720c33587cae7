"""Whether recording keeps up, and how much room it takes.

    python benchmarks/recording.py

Frames are made at the rate of the robot. A frame is late if writing the one before it took longer than a frame; the
longest time that `add_frame` takes is the longest that a frame waits for the disk. `save_episode` runs between
episodes. Then, what sound and metadata take on the disk.
"""

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.configs.video import RGBEncoderConfig

from lerobot_playbyear.datasets import audio_feature
from lerobot_playbyear.datasets.durable import DurableWriter

RATE = 48000
SECONDS = 20
N_EPISODES = 3


@dataclass
class Case:
    name: str
    fps: int
    height: int
    width: int
    microphones: int
    dtype: str
    streaming: bool = False


CASES = (
    Case("20 Hz, 84x84 pictures, one microphone", 20, 84, 84, 1, "image"),
    Case("30 Hz, 640x480 pictures, two microphones", 30, 480, 640, 2, "image"),
    Case("30 Hz, 640x480 video, two microphones", 30, 480, 640, 2, "video"),
    Case("30 Hz, 640x480 video as it comes in, two microphones", 30, 480, 640, 2, "video", streaming=True),
)


def features(case: Case) -> dict[str, dict]:
    return {
        "observation.images.front": {
            "dtype": case.dtype,
            "shape": (case.height, case.width, 3),
            "names": ["height", "width", "channels"],
        },
        **{f"observation.audio.{i}": audio_feature(RATE, case.fps) for i in range(case.microphones)},
        "observation.state": {"dtype": "float32", "shape": (7,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
    }


def pictures(case: Case, rng: np.random.Generator) -> Callable[[int], np.ndarray]:
    """A scene of smooth shapes that moves, with a camera's noise, as pictures compress about like a camera's."""
    y, x = np.mgrid[0 : case.height, 0 : case.width] / case.width
    scene = np.stack([127 + 90 * np.sin(a * x + b * y) for a, b in ((9, 4), (3, 11), (14, 2))], axis=-1)
    noise = [rng.normal(0, 2, scene.shape) for _ in range(4)]
    rolled = [np.clip(np.roll(scene, 3 * i, axis=1) + noise[i % 4], 0, 255).astype(np.uint8) for i in range(40)]
    return lambda i: rolled[i % 40]


def measure(case: Case, root: Path) -> None:
    rng = np.random.default_rng(0)
    picture = pictures(case, rng)
    encoder = RGBEncoderConfig(vcodec="h264", preset="veryfast") if case.dtype == "video" else None
    waits, saves, late = [], [], 0
    with DurableWriter(
        "benchmark/recording", root, case.fps, features(case), streaming_encoding=case.streaming, rgb_encoder=encoder
    ) as writer:
        for _ in range(N_EPISODES):
            begun = time.perf_counter()
            for i in range(SECONDS * case.fps):
                frame = {
                    "observation.images.front": picture(i),
                    "observation.state": rng.normal(size=7).astype(np.float32),
                    "action": rng.normal(size=4).astype(np.float32),
                    "task": "listen",
                }
                for k in range(case.microphones):
                    frame[f"observation.audio.{k}"] = rng.normal(0, 300, RATE // case.fps).astype(np.int16)
                due = begun + i / case.fps
                late += time.perf_counter() > due + 1 / case.fps
                time.sleep(max(0.0, due - time.perf_counter()))
                started = time.perf_counter()
                writer.add_frame(frame)
                waits.append(time.perf_counter() - started)
            started = time.perf_counter()
            writer.save_episode()
            saves.append(time.perf_counter() - started)
    print(
        f"{case.name}: {len(waits)} frames, {late} late; longest wait {1e3 * max(waits):.1f} ms "
        f"(99 %: {1e3 * np.quantile(waits, 0.99):.1f} ms; a frame is {1e3 / case.fps:.0f} ms); "
        f"save_episode of {SECONDS} s: {np.mean(saves):.1f} s, at most {max(saves):.1f} s"
    )


def measure_room(folder: Path) -> None:
    own = {"observation.audio.gripper": audio_feature(RATE, 20)}
    own["action"] = {"dtype": "float32", "shape": (4,), "names": None}
    rng = np.random.default_rng(0)
    sounds: dict[str, Callable[[], np.ndarray]] = {
        "noise at full scale": lambda: rng.integers(-32768, 32768, RATE // 20),
        "a quiet room (noise of 100 of 32,768)": lambda: rng.normal(0, 100, RATE // 20),
        "silence": lambda: np.zeros(RATE // 20),
    }
    for number, (name, sound) in enumerate(sounds.items()):
        root = folder / str(number)
        sizes = []
        with DurableWriter("benchmark/room", root, 20, own) as writer:
            for _ in range(10):
                for _ in range(5 * 20):
                    block = sound().astype(np.int16)
                    action = rng.normal(size=4).astype(np.float32)
                    writer.add_frame({"observation.audio.gripper": block, "action": action, "task": "listen"})
                writer.save_episode()
                sizes.append(sum(path.stat().st_size for path in (root / "meta").rglob("*") if path.is_file()))
        data = sum(path.stat().st_size for path in (root / "data").rglob("*.parquet"))
        print(
            f"{name}: {data / (10 * 5 * RATE):.3f} bytes per sample; metadata {sizes[0] / 1e3:.0f} kB with the first "
            f"episode, {(sizes[-1] - sizes[0]) / 9e3:.1f} kB for each further one"
        )


def main() -> None:
    os.environ.setdefault("SVT_LOG", "1")
    print(f"{os.cpu_count()} processor cores")
    with tempfile.TemporaryDirectory() as folder:
        for number, case in enumerate(CASES):
            measure(case, Path(folder) / f"case{number}")
        measure_room(Path(folder))


if __name__ == "__main__":
    main()
