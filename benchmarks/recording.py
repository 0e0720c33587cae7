"""Frames per second that recording can take, beside stock LeRobot; with `--paced`, whether it keeps up, and the room it takes.

    python benchmarks/recording.py
    python benchmarks/recording.py --paced

Frames of one camera and one microphone are added as fast as they are taken, and the episode is saved: by
`DurableWriter`, after which it survives a power cut, and by `LeRobotDataset` alone, in turns. The limit is compressing the
pictures. With `--paced` frames come at the rate of the robot instead, for a minute each: the longest time that `add_frame`
takes is the longest that a frame waits for the disk, and the next one is late if that is longer than a frame.
"""

import io
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import datasets
import numpy as np
from common import Row, in_turns, machine, medians, parser_for, report, seconds_of
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from PIL import Image
from scenes import CAMERAS, dataset_features, frames

from lerobot_playbyear.datasets import audio_feature
from lerobot_playbyear.datasets.durable import DurableWriter

SECONDS = 20  # of a paced episode
N_EPISODES = 3
_ROOM_RATE = 48000  # Hz


class Case(NamedTuple):
    """A robot's sensors."""

    name: str
    fps: int
    features: dict[str, dict[str, Any]]


_ROBOT = ((480, 640), 48000, 30, 2)  # pixels, Hz, Hz, microphones
_FILMED = dataset_features(*_ROBOT, "video")
SIMULATION = Case("84 px pictures, one 16 kHz microphone", 20, dataset_features((84, 84), 16000, 20))
PACED = (
    Case("20 Hz, 84x84 pictures, one microphone", 20, dataset_features((84, 84), 48000, 20)),
    Case("30 Hz, 640x480 pictures, two microphones", 30, dataset_features(*_ROBOT)),
    Case("30 Hz, 640x480 video, two microphones", 30, _FILMED),
)


def measure(folder: Path, n_frames: int, turns: int) -> list[Row]:
    """As fast as it goes: ours, stock, and compression alone."""
    features, fps = SIMULATION.features, SIMULATION.fps
    episode = list(frames(features, n_frames))
    options = {"image_writer_threads": 4, "video_backend": "pyav"}
    stock = LeRobotDataset.create("benchmark/stock", fps, features, root=folder / "stock", **options)

    def write(writer: DurableWriter | LeRobotDataset) -> None:
        for frame in episode:
            writer.add_frame(dict(frame))
        writer.save_episode()

    def compress() -> None:
        for frame in episode:
            Image.fromarray(frame[CAMERAS[0]]).save(io.BytesIO(), format="PNG", compress_level=1)

    with DurableWriter("benchmark/ours", folder / "ours", fps, features) as ours:
        works = {"ours": lambda: write(ours), "stock": lambda: write(stock), "limit": compress}
        seconds = medians(in_turns(works, turns))
    stock.finalize()
    rates = {name: n_frames / value for name, value in seconds.items()}
    return [
        Row(
            f"recording, {SIMULATION.name}, saved for good",
            rates["ours"],
            "frames/s",
            "stock LeRobotDataset, which a crash can cost the session",
            rates["stock"],
            "compressing the pictures",
            rates["limit"],
            f"at least {fps}",
            rates["ours"] >= fps,
        )
    ]


def measure_paced(case: Case, root: Path) -> None:
    waits, saves = [], []
    is_filmed = case.features[CAMERAS[0]]["dtype"] == "video"
    encoder = RGBEncoderConfig(vcodec="h264", preset="veryfast") if is_filmed else None
    with DurableWriter("benchmark/recording", root, case.fps, case.features, rgb_encoder=encoder) as writer:
        for episode in range(N_EPISODES):
            begun = time.perf_counter()
            for i, frame in enumerate(frames(case.features, SECONDS * case.fps, episode)):
                time.sleep(max(0.0, begun + i / case.fps - time.perf_counter()))
                waits.append(seconds_of(partial(writer.add_frame, frame)))
            saves.append(seconds_of(writer.save_episode))
    late = sum(wait > 1 / case.fps for wait in waits)
    print(
        f"{case.name}: {len(waits)} frames, {late} late; longest wait {1e3 * max(waits):.1f} ms "
        f"(99 %: {1e3 * np.quantile(waits, 0.99):.1f} ms; a frame is {1e3 / case.fps:.0f} ms); "
        f"save_episode of {SECONDS} s: {np.mean(saves):.1f} s, at most {max(saves):.1f} s"
    )


def measure_room(folder: Path) -> None:
    n, rng = _ROOM_RATE // 20, np.random.default_rng(0)
    own = {
        "observation.audio.gripper": audio_feature(_ROOM_RATE, 20),
        "action": {"dtype": "float32", "shape": (4,), "names": None},
    }
    sounds: dict[str, Callable[[], np.ndarray]] = {
        "noise at full scale": lambda: rng.integers(-32768, 32768, n),
        "a quiet room (noise of 100 of 32,768)": lambda: rng.normal(0, 100, n),
        "silence": lambda: np.zeros(n),
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
            f"{name}: {data / (10 * 5 * _ROOM_RATE):.3f} bytes per sample; metadata {sizes[0] / 1e3:.0f} kB with the "
            f"first episode, {(sizes[-1] - sizes[0]) / 9e3:.1f} kB for each further one"
        )


def main() -> None:
    os.environ.setdefault("SVT_LOG", "1")
    datasets.disable_progress_bars()
    parser = parser_for(__doc__, turns=5)
    parser.add_argument("--paced", action="store_true", help="at the rate of the robot instead; takes 5 minutes")
    parser.add_argument("--frames", type=int, default=200, help="of an episode")
    args = parser.parse_args()
    started = machine()
    with tempfile.TemporaryDirectory() as folder:
        if not args.paced:
            report("recording", measure(Path(folder), args.frames, args.turns), args.output, started)
            return
        for number, case in enumerate(PACED):
            measure_paced(case, Path(folder) / f"case{number}")
        measure_room(Path(folder))


if __name__ == "__main__":
    main()
