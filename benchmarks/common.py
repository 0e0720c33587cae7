"""What the benchmarks share: turns of measuring, helpers in processes of their own, datasets of noise, and the table."""

import argparse
import contextlib
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from lerobot_playbyear.datasets import audio_feature

_LESS_IS_BETTER = ("ms", "s", "MiB")
_VERSIONS = ("torch", "lerobot", "mujoco", "numpy")


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes:
        what: What was measured.
        ours: The figure, a median.
        unit: Of all figures of the row; in ms, s and MiB less is better.
        beside: What it is compared with, measured in the same run.
        theirs: The figure of that.
        limit_is: What bounds the figure on this machine.
        limit: That bound, measured in the same run.
    """

    what: str
    ours: float
    unit: str
    beside: str = ""
    theirs: float | None = None
    limit_is: str = ""
    limit: float | None = None

    @property
    def times_better(self) -> float | None:
        """How many times better ours is than what it is compared with."""
        if not self.theirs or not self.ours:
            return None
        return self.theirs / self.ours if self.unit in _LESS_IS_BETTER else self.ours / self.theirs

    def __str__(self) -> str:
        beside = f"{self.beside}: {_figure(self.theirs)}" if self.beside else ""
        times = f"{self.times_better:.3g}" if self.times_better else ""
        limit = f"{self.limit_is}: {_figure(self.limit)}" if self.limit_is else ""
        return f"| {self.what} | {_figure(self.ours)} {self.unit} | {beside} | {times} | {limit} |"


def _figure(value: float | None) -> str:
    if value is None:
        return "not measured"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def parser_for(doc: str | None, turns: int) -> argparse.ArgumentParser:
    """A command line that prints the module's docstring as help, with the number of turns."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, help="JSON file for the figures")
    parser.add_argument("--turns", type=int, default=turns)
    return parser


def run(parser: argparse.ArgumentParser, measure: Callable[[argparse.Namespace], Sequence[Row]]) -> None:
    """What a benchmark does: measures with the options of the command line, and prints the table and what ran."""
    args, started = parser.parse_args(), machine()
    rows = measure(args)
    print("| what | ours | beside it | times better | limit |", "|---|---|---|---|---|", *rows, sep="\n")
    print(", ".join(f"{name} {value}" for name, value in started.items()))
    if args.output is not None:
        args.output.write_text(json.dumps({"machine": started, "rows": [asdict(row) for row in rows]}, indent=1) + "\n")


def machine() -> dict[str, object]:
    """What runs, and whether it runs alone."""
    info = Path("/proc/cpuinfo")
    model = re.search(r"^model name\s*: (.*)", info.read_text(), re.MULTILINE) if info.is_file() else None
    return {
        "processor": model[1] if model else platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": os.environ.get("OMP_NUM_THREADS", str(os.cpu_count())),
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in _VERSIONS},
        "load_before": round(os.getloadavg()[0], 2),
    }


def seconds_of(work: Callable[[], object]) -> float:
    """How long a call takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def in_turns[K](works: Mapping[K, Callable[[], object]], n_turns: int, warm_up: int = 1) -> dict[K, list[float]]:
    """Times several pieces of work in turns, so that whatever else the machine does hits all of them.

    Args:
        works: Each called once per turn.
        n_turns: How often.
        warm_up: Turns before these that do not count.

    Returns:
        The seconds of every call.
    """
    seconds: dict[K, list[float]] = {name: [] for name in works}
    for turn in range(warm_up + n_turns):
        for name, work in works.items():
            took = seconds_of(work)
            if turn >= warm_up:
                seconds[name].append(took)
    return seconds


def medians[K](seconds: Mapping[K, Sequence[float]]) -> dict[K, float]:
    """The median of every list."""
    return {name: statistics.median(values) for name, values in seconds.items()}


class Helper:
    """A script that measures in a process of its own, whenever it is asked to: a line in, a line with a number out.

    Args:
        command: What to run.
        environment: Variables in addition to this process's.
    """

    def __init__(self, *command: str, **environment: str) -> None:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen(command, env={**os.environ, **environment}, **pipes)

    def ask(self, question: str = "") -> None:
        """Lets it begin."""
        with contextlib.suppress(BrokenPipeError):  # `answer` tells why
            self._process.stdin.write(question + "\n")
            self._process.stdin.flush()

    def answer(self) -> float:
        """Waits for its number."""
        for line in self._process.stdout:
            if line.startswith("answer "):
                return float(line.split()[1])
        raise RuntimeError(f"A helper did not run:\n{self._process.stderr.read()[-2000:]}")

    def close(self) -> None:
        """Ends it."""
        self._process.stdin.close()
        self._process.wait(timeout=60)


def serve(work: Callable[[str], float]) -> None:
    """What a helper does: answers every line from the one who started it."""
    for line in sys.stdin:
        print("answer", work(line.strip()), flush=True)


def occupied(*processes: psutil.Process) -> tuple[int, int]:
    """Bytes of memory of processes, and those of them that are no files, which the system cannot take back."""
    memories = [process.memory_info() for process in processes]
    total = sum(memory.rss for memory in memories)
    return total, total - sum(getattr(memory, "shared", 0) for memory in memories)


# Datasets of noise that compresses about like a camera's and a microphone's

CAMERAS = ("observation.images.front", "observation.images.wrist")
MICROPHONES = ("observation.audio.left", "observation.audio.right")


def dataset_features(
    image_size: tuple[int, int],
    sample_rate: int,
    fps: int,
    n_microphones: int = 1,
    dtype: str = "image",
    n_cameras: int = 1,
) -> dict[str, dict[str, Any]]:
    """Cameras, microphones, the arm's state and the action."""
    camera = {"dtype": dtype, "shape": (*image_size, 3), "names": ["height", "width", "channels"]}
    return {
        **{key: dict(camera) for key in CAMERAS[:n_cameras]},
        **{key: audio_feature(sample_rate, fps) for key in MICROPHONES[:n_microphones]},
        "observation.state": {"dtype": "float32", "shape": (7,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
    }


def frames(features: dict[str, dict[str, Any]], n: int, seed: int = 0) -> Iterator[dict[str, Any]]:
    """The frames of an episode, as `add_frame` takes them: a scene of smooth shapes that moves, and noise."""
    rng = np.random.default_rng(seed)
    height, width, _ = features[CAMERAS[0]]["shape"]
    y, x = np.mgrid[0:height, 0:width] / width
    scene = np.stack([127 + 90 * np.sin(a * x + b * y) for a, b in ((9, 4), (3, 11), (14, 2))], axis=-1)
    moved = [np.roll(scene, 3 * i, axis=1) + rng.normal(0, 2, scene.shape) for i in range(40)]
    pictures = [np.clip(picture, 0, 255).astype(np.uint8) for picture in moved]
    for i in range(n):
        frame: dict[str, Any] = {"task": "listen"}
        for key, feature in features.items():
            if feature["dtype"] == "int16":
                frame[key] = rng.normal(0, 300, feature["shape"]).astype(np.int16)
            elif feature["dtype"] == "float32":
                frame[key] = rng.normal(size=feature["shape"]).astype(np.float32)
            else:
                frame[key] = pictures[i % 40]
        yield frame


def record(root: Path, repo_id: str, fps: int, features: dict[str, dict[str, Any]], lengths: Sequence[int]) -> None:
    """Writes a dataset of episodes of so many frames."""
    from lerobot_playbyear.datasets.durable import DurableWriter

    with DurableWriter(repo_id, root, fps, features) as writer:
        for seed, length in enumerate(lengths):
            for frame in frames(features, length, seed):
                writer.add_frame(frame)
            writer.save_episode()
