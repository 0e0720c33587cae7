"""What the benchmarks share: turns of measuring, helpers in processes of their own, the table, and the file of figures."""

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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

import psutil

BENCH = Path("outputs/bench.json")
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
        wanted: What the figures ought to be, in words.
        holds: Whether they are.
    """

    what: str
    ours: float
    unit: str
    beside: str = ""
    theirs: float | None = None
    limit_is: str = ""
    limit: float | None = None
    wanted: str = ""
    holds: bool | None = None

    @property
    def times_better(self) -> float | None:
        """How many times better ours is than what it is compared with."""
        if not self.theirs or not self.ours:
            return None
        return self.theirs / self.ours if self.unit in _LESS_IS_BETTER else self.ours / self.theirs


def parser_for(doc: str | None, turns: int | None = None) -> argparse.ArgumentParser:
    """A command line that prints the module's docstring as help, with the number of turns where one is given."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=BENCH, help="JSON file that the figures are merged into")
    if turns is not None:
        parser.add_argument("--turns", type=int, default=turns)
    return parser


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
        environment: Variables besides this process's.
    """

    def __init__(self, *command: str, **environment: str) -> None:
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **environment},
        )

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

    def measure(self, question: str = "") -> float:
        """Asks and waits."""
        self.ask(question)
        return self.answer()

    def close(self) -> None:
        """Ends it."""
        self._process.stdin.close()
        self._process.wait(timeout=60)


def serve(work: Callable[[str], float]) -> None:
    """What a helper does: answers every line from the one who started it."""
    for line in sys.stdin:
        print("answer", work(line.strip()), flush=True)


def machine() -> dict[str, object]:
    """What ran, and whether it ran alone."""
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


def report(section: str, rows: Sequence[Row], output: Path, started: dict[str, object]) -> None:
    """Prints a benchmark's rows and merges them into the file of figures.

    Args:
        section: The benchmark's name.
        rows: Its results.
        output: The file.
        started: `machine()` from before the work.
    """
    print("\n".join(markdown(rows)), flush=True)
    entries = [{**asdict(row), "times_better": row.times_better} for row in rows]
    merge({section: {"machine": started, "rows": entries}}, output)


def run(section: str, parser: argparse.ArgumentParser, measure: Callable[[argparse.Namespace], Sequence[Row]]) -> None:
    """What a benchmark does: measures with the options of the command line, and reports."""
    args, started = parser.parse_args(), machine()
    report(section, measure(args), args.output, started)


def merge(sections: dict[str, object], output: Path) -> None:
    """Puts sections into the file of figures; the others stay."""
    figures = json.loads(output.read_text()) if output.is_file() else {}
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps({**figures, **sections}, indent=1) + "\n")


def occupied(*processes: psutil.Process) -> tuple[int, int]:
    """Bytes of memory of processes, and those of them that are no files, which the system cannot take back."""
    memories = [process.memory_info() for process in processes]
    total = sum(memory.rss for memory in memories)
    return total, total - sum(getattr(memory, "shared", 0) for memory in memories)


def rows_of(section: Mapping[str, object]) -> list[Row]:
    """The rows in a section of the file of figures."""
    entries = section["rows"]
    assert isinstance(entries, list)
    return [Row(**{key: value for key, value in entry.items() if key != "times_better"}) for entry in entries]


def markdown(rows: Sequence[Row]) -> list[str]:
    """The table, line by line."""
    lines = ["| what | ours | beside it | times better | limit | wanted |", "|---|---|---|---|---|---|"]
    for row in rows:
        beside = f"{row.beside}: {_figure(row.theirs)}" if row.beside else ""
        times = f"{row.times_better:.3g}" if row.times_better else ""
        limit = f"{row.limit_is}: {_figure(row.limit)}" if row.limit_is else ""
        wanted = row.wanted + ("" if row.holds is None else ": holds" if row.holds else ": **does not hold**")
        lines.append(f"| {row.what} | {_figure(row.ours)} {row.unit} | {beside} | {times} | {limit} | {wanted} |")
    return lines


def _figure(value: float | None) -> str:
    if value is None:
        return "not measured"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
