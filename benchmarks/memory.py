"""The memory that commands need for one very long episode: two hours, two cameras, two microphones of 48 kHz.

    python benchmarks/memory.py                      # half an hour and more on two cores; needs 12 GB of disk
    python benchmarks/memory.py --only inspect push  # these; figures of the others stay
    python benchmarks/memory.py --table              # of the figures that are there

Each command runs in a process of its own that may not allocate more than the limit (`RLIMIT_DATA`, on Linux), while the
memory that it and its children occupy is looked at ten times a second. That counts pages of files which are mapped,
and which the system takes back when it needs them. A command fails its row by failing, or by exceeding the limit.

The episode is made once and kept in `--folder`. What is repaired is what a killed recording leaves: a data file without its
end, and no table of episodes. The Hub is the one of the tests, on loopback, and throws large files away.
"""

import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil
from common import machine, merge, occupied, parser_for

GIB = 2**30
_EVERY_S = 0.1
_KILLED_S = 6 * 3600
_TESTS = Path(__file__).parents[1] / "tests"


@dataclass(frozen=True)
class Result:
    """What a command needed.

    Attributes:
        command: Its name.
        minutes: Of the episode.
        peak_gib: The most that it and its children occupied.
        own_gib: The same without pages of mapped files.
        seconds: How long it took.
        cpu_seconds: How long processors worked for it, which tells more on a busy machine.
        failure: Why it failed; empty where it did not.
        load: The mean of what the machine did meanwhile, the command included.
    """

    command: str
    minutes: float
    peak_gib: float
    own_gib: float
    seconds: float
    cpu_seconds: float
    failure: str
    load: float = 0.0


def measure(name: str, command: list[str], minutes: float, limit: int, environment: dict[str, str]) -> Result:
    """Runs a command under the limit [bytes]."""
    started, cpu_before = time.perf_counter(), _cpu_seconds()
    log = Path(environment["HF_HOME"]).with_name(f"{name}.log")
    with log.open("w") as output:
        process = subprocess.Popen(
            command,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**os.environ, **environment},
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (limit, limit)),
        )
        watched = psutil.Process(process.pid)
        sizes, loads = [(0, 0)], [os.getloadavg()[0]]
        while process.poll() is None and time.perf_counter() - started < _KILLED_S:
            with suppress(psutil.Error):  # one of them has just ended
                sizes.append(occupied(watched, *watched.children(recursive=True)))
            loads.append(os.getloadavg()[0])
            time.sleep(_EVERY_S)
        process.kill()
        status = process.wait()
    peak, own = (max(column) for column in zip(*sizes, strict=True))
    failure = "more than the limit" if peak > limit else ""
    if status:
        last = (log.read_text().strip().splitlines() or [""])[-1]
        failure = f"status {status}: {last[:200]}"
    return Result(
        command=name,
        minutes=minutes,
        peak_gib=round(peak / GIB, 2),
        own_gib=round(own / GIB, 2),
        seconds=round(time.perf_counter() - started),
        cpu_seconds=round(_cpu_seconds() - cpu_before),
        failure=failure,
        load=round(statistics.fmean(loads), 1),
    )


def _cpu_seconds() -> float:
    """Of all children that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def inspect(folder: Path) -> list[str]:
    return _module("inspect", *_named("dataset", "benchmark/heard", folder / "episode" / "heard"), "--json")


def page(folder: Path) -> list[str]:
    return [*inspect(folder)[:-1], f"--html={folder / 'page.html'}"]


def repair(folder: Path) -> list[str]:
    """Of a copy that shares the videos and lacks what a killed recording lacks."""
    heard, root = folder / "episode" / "heard", folder / "killed"
    shutil.rmtree(root, ignore_errors=True)
    shutil.copytree(heard, root, copy_function=os.link)
    shutil.rmtree(root / "meta" / "episodes")
    (data,) = root.glob("data/*/*.parquet")
    data.unlink()
    shutil.copyfile(heard / data.relative_to(root), data)
    os.truncate(data, data.stat().st_size - 8)
    return _module("repair", f"--root={root}")


def attach(folder: Path) -> list[str]:
    shutil.rmtree(folder / "attached", ignore_errors=True)
    silent = _named("dataset", "benchmark/silent", folder / "episode" / "silent")
    attached = _named("output", "benchmark/attached", folder / "attached")
    files = f"--files={folder}/episode/sound/{{episode}}.wav"
    return _module("attach_audio", *silent, *attached, files, "--microphone=left,right")


def push(folder: Path) -> list[str]:
    return _module("push", *_named("dataset", "tester/heard", folder / "episode" / "heard"))


COMMANDS: dict[str, Callable[[Path], list[str]]] = {
    "playbyear-inspect": inspect,
    "playbyear-repair": repair,
    "playbyear-attach-audio": attach,
    "playbyear-push": push,
    "playbyear-inspect --html": page,
}


def _named(kind: str, repo_id: str, root: Path) -> list[str]:
    return [f"--{kind}.repo_id={repo_id}", f"--{kind}.root={root}"]


def _module(name: str, *options: str) -> list[str]:
    return [sys.executable, "-m", f"lerobot_playbyear.scripts.{name}", *options]


@contextmanager
def hub() -> Iterator[dict[str, str]]:
    """The Hub of the tests; what makes a client come to it."""
    sys.path.insert(0, str(_TESTS))
    from support import hub as hub_server

    class Forgetful(hub_server.HubServer):
        def store(self, request: "hub_server._Handler", oid: str) -> hub_server.Answer:
            self.objects[oid] = b""
            return hub_server.Answer()

        def verify(self, request: "hub_server._Handler") -> hub_server.Answer:
            return hub_server.Answer({})

    with Forgetful() as server:
        yield server.environment()


def run(folder: Path, minutes: float, limit: int, only: list[str] | None, output: Path) -> list[Result]:
    """Makes the episode where it is not there, and measures the commands."""
    episode = folder / "episode"
    marker = episode / "minutes"
    if not marker.is_file() or float(marker.read_text()) != minutes:
        from long_episode import make

        shutil.rmtree(episode, ignore_errors=True)
        print(f"making {minutes:g} minutes", flush=True)
        make(episode, minutes)
    results = []
    with hub() as environment:
        for name, prepare in COMMANDS.items():
            if only is not None and prepare.__name__ not in only:
                continue
            home = folder / "home"
            shutil.rmtree(home, ignore_errors=True)
            command, started = prepare(folder), machine()
            results.append(measure(name, command, minutes, limit, {**environment, "HF_HOME": str(home)}))
            kept = json.loads(output.read_text()).get("memory", {}) if output.is_file() else {}
            merge({"memory": {**kept, name: {"machine": started, **asdict(results[-1])}}}, output)
            print(table(results)[-1], flush=True)
    return results


def table(results: list[Result]) -> list[str]:
    """Markdown, line by line."""
    lines = [
        "| command | peak memory [GiB] | without mapped files [GiB] | time [s] | of a processor [s] |",
        "|---|---|---|---|---|",
    ]
    for result in results:
        failure = f" **failed**: {result.failure}" if result.failure else ""
        lines.append(
            f"| `{result.command}` | {result.peak_gib:.2f}{failure} | {result.own_gib:.2f} | {result.seconds:,.0f} "
            f"| {result.cpu_seconds:,.0f} |"
        )
    return lines


def main() -> int:
    parser = parser_for(__doc__)
    parser.add_argument("--folder", type=Path, default=Path("outputs/memory"), help="for the episode and the copies")
    parser.add_argument("--minutes", type=float, default=120, help="of the episode")
    parser.add_argument("--limit", type=float, default=4, help="[GiB]")
    parser.add_argument("--only", nargs="*", choices=[prepare.__name__ for prepare in COMMANDS.values()])
    parser.add_argument("--table", action="store_true", help="measure nothing")
    args = parser.parse_args()
    if not args.table:
        run(args.folder.absolute(), args.minutes, round(args.limit * GIB), args.only, args.output)
    kept = json.loads(args.output.read_text())["memory"].values()
    results = [Result(**{key: value for key, value in each.items() if key != "machine"}) for each in kept]
    print("\n".join(table(results)))
    return sum(bool(result.failure) for result in results)


if __name__ == "__main__":
    sys.exit(main())
