"""The memory that commands need for one very long episode, and training for data that memory would not hold.

    python benchmarks/memory.py                      # two hours; an hour and more on two cores; 12 GB of disk
    python benchmarks/memory.py --store              # 50 episodes of 30 s, half an hour and 25 GB of disk
    python benchmarks/memory.py --minutes=1 --only inspect push

Two cameras of 640 x 480 at 30 Hz, as video, and two microphones of 48 kHz. Each command runs in a process of its own that may
not allocate more than the limit (`RLIMIT_DATA`, on Linux), while the memory that it and its children occupy is looked at ten
times a second. That counts pages of files which are mapped, and which the system takes back when it needs them: the first
figure is without them. A command that fails ends the benchmark with what it said.

What is repaired is what a killed recording leaves: a data file without its end, and no table of episodes. The Hub is the one of
the tests, on loopback, and throws large files away. The dataset is made once and kept in `--folder`.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
import wave
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
from common import CAMERAS, MICROPHONES, Row, dataset_features, occupied, parser_for, record, run
from lerobot.datasets.video_utils import concatenate_video_files

GIB = 2**30
FPS, SAMPLE_RATE, SIZE = 30, 48000, (480, 640)


def measure(name: str, command: list[str], limit: int, environment: dict[str, str]) -> Row:
    """Runs a command under the limit [bytes]."""
    limited = {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))}
    told = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    started, sizes = time.perf_counter(), [(0, 0)]
    process = subprocess.Popen(command, env={**os.environ, **environment}, **limited, **told)
    watched = psutil.Process(process.pid)
    while process.poll() is None:
        with suppress(psutil.Error):  # one of them has just ended
            sizes.append(occupied(watched, *watched.children(recursive=True)))
        time.sleep(0.1)
    if process.returncode:
        raise RuntimeError(f"{name}: status {process.returncode}: {process.stdout.read()[-500:]}")
    peak, own = (max(column) / 2**20 for column in zip(*sizes, strict=True))
    name = f"{name}, {time.perf_counter() - started:,.0f} s"
    return Row(name, own, "MiB", "with mapped files", peak, "may allocate", limit / 2**20)


# One very long episode


def make(folder: Path, minutes: int) -> None:
    """Makes `heard` and `silent`, an episode with and without its microphones, and `0.wav`, which has both."""
    for name, n_microphones in (("heard", 2), ("silent", 0)):
        features = dataset_features(SIZE, SAMPLE_RATE, FPS, n_microphones, "video", len(CAMERAS))
        record(folder / name, f"benchmark/{name}", FPS, features, [60 * FPS])
        lengthen(folder / name, minutes)
    sound = np.random.default_rng(0).normal(0, 300, (60 * SAMPLE_RATE, len(MICROPHONES))).astype(np.int16)
    with wave.open(str(folder / "0.wav"), "wb") as file:
        file.setparams((len(MICROPHONES), 2, SAMPLE_RATE, 0, "NONE", ""))
        for _ in range(minutes):
            file.writeframes(sound.tobytes())


def lengthen(root: Path, times: int) -> None:
    """Makes the only episode of a dataset so many times as long: its rows and its pictures are repeated."""
    info = json.loads((root / "meta/info.json").read_text())
    info["total_frames"] *= times
    n = info["total_frames"]
    (root / "meta/info.json").write_text(json.dumps(info))
    (path,) = root.glob("data/*/*.parquet")
    columns = {"index": np.arange(n), "frame_index": np.arange(n), "timestamp": (np.arange(n) / FPS).astype(np.float32)}
    rewrite(path, times, columns)
    for video in root.glob("videos/*/*/*.mp4"):
        minute = video.rename(video.with_name("minute.mp4"))
        concatenate_video_files([minute] * times, video)
        minute.unlink()
    (path,) = root.glob("meta/episodes/*/*.parquet")
    ends = {f"videos/{key}/to_timestamp": np.array([n / FPS]) for key in CAMERAS}
    rewrite(path, 1, {"length": np.array([n]), "dataset_to_index": np.array([n]), **ends})


def rewrite(path: Path, times: int, columns: dict[str, np.ndarray]) -> None:
    """Repeats the rows of a table, as one row group, with other values in some columns."""
    table = pa.concat_tables([pq.read_table(path)] * times)
    for name, values in columns.items():
        place = table.column_names.index(name)
        table = table.set_column(place, table.schema.field(place), pa.array(values))
    pq.write_table(table, path, row_group_size=len(table), compression="snappy")


def inspect(folder: Path) -> list[str]:
    return ["inspect", *_named("dataset", folder / "heard"), "--json"]


def page(folder: Path) -> list[str]:
    return [*inspect(folder)[:-1], f"--html={folder / 'page.html'}"]


def repair(folder: Path) -> list[str]:
    """Of a copy that lacks what a killed recording lacks."""
    root = folder / "killed"
    for old in folder.glob("killed*"):
        shutil.rmtree(old)
    shutil.copytree(folder / "heard", root)
    shutil.rmtree(root / "meta" / "episodes")
    (data,) = root.glob("data/*/*.parquet")
    os.truncate(data, data.stat().st_size - 8)
    return ["repair", f"--root={root}"]


def attach(folder: Path) -> list[str]:
    shutil.rmtree(folder / "attached", ignore_errors=True)
    places = (*_named("dataset", folder / "silent"), *_named("output", folder / "attached"))
    return ["attach_audio", *places, f"--files={folder}/{{episode}}.wav", "--microphone=left,right", "--pad=true"]


def push(folder: Path) -> list[str]:
    return ["push", *_named("dataset", folder / "heard")]


COMMANDS: dict[str, Callable[[Path], list[str]]] = {
    prepare.__name__: prepare for prepare in (inspect, repair, attach, push, page)
}


def _named(kind: str, root: Path) -> list[str]:
    return [f"--{kind}.repo_id=tester/{root.name}", f"--{kind}.root={root}"]


@contextmanager
def hub() -> Iterator[dict[str, str]]:
    """The Hub of the tests; what makes a client come to it."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from support.hub import Answer, HubServer

    class Forgetful(HubServer):
        def store(self, request: object, oid: str) -> Answer:
            self.objects[oid] = b""
            return Answer()

    with Forgetful() as server:
        yield server.environment()


def program(command: str) -> tuple[str, ...]:
    """Starts a command of ours, also where it is not installed."""
    return sys.executable, "-c", f"from lerobot_playbyear.scripts.commands import {command}; {command}()"


def long_episode(folder: Path, minutes: int, limit: int, only: list[str]) -> list[Row]:
    """Makes the episode where it is not there, and measures the commands."""
    if not (folder / "0.wav").is_file():
        make(folder, minutes)
    with hub() as environment:
        home = {**environment, "HF_HOME": str(folder / "home")}
        commands = {name: COMMANDS[name](folder) for name in only}
        return [
            measure(f"{name}, {minutes} minutes", [*program(command), *options], limit, home)
            for name, (command, *options) in commands.items()
        ]


# Data larger than memory


def store(folder: Path, limit: int) -> list[Row]:
    """Makes the store on disk, and trains from it."""
    root, episodes = folder / "data", [30 * FPS] * 50
    if not root.exists():
        features = dataset_features(SIZE, SAMPLE_RATE, FPS, 2, "video", len(CAMERAS))
        record(root, "tester/data", FPS, features, episodes)
    for made in ("store", "train"):
        shutil.rmtree(folder / made, ignore_errors=True)
    train = [
        *(*program("train"), "--policy.type=playbyear", "--policy.device=cpu"),
        *(f"--policy.fps={FPS}", "--policy.image_size=224", "--policy.vision_width=16", "--policy.push_to_hub=false"),
        *(*_named("dataset", root), "--store=disk", f"--store.cache={folder / 'store'}", "--batch_size=1"),
    ]
    pictures = sum(episodes) * len(CAMERAS) * SIZE[0] * SIZE[1] * 3 / GIB
    home = {"HF_HOME": str(folder / "home")}
    return [
        measure(name, [*train, f"--steps={steps}", f"--output_dir={folder}/train/{steps}"], limit, home)
        for name, steps in ((f"a store of {pictures:.0f} GiB of pictures, one update", 1), ("20 updates from it", 20))
    ]


def benchmark(args: argparse.Namespace) -> list[Row]:
    limit, folder = round(args.limit * GIB), args.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    return store(folder, limit) if args.store else long_episode(folder, args.minutes, limit, args.only)


if __name__ == "__main__":
    parser = parser_for(__doc__, turns=1)
    parser.add_argument("--folder", type=Path, default=Path("outputs/memory"), help="for the episode and the copies")
    parser.add_argument("--minutes", type=int, default=120, help="of the episode")
    parser.add_argument("--limit", type=float, default=4, help="[GiB]")
    parser.add_argument("--only", nargs="*", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--store", action="store_true", help="measure training from a store on the disk instead")
    run(parser, benchmark)
