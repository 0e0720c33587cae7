"""How long our commands take to answer, beside LeRobot's own `--help`.

    python benchmarks/startup.py

For every command: `--help`, the refusal of an option that does not exist, and the first work, which is when it lists or opens
the first folder or file that it was given; the process ends there. All are processes as a person starts them, in turns; the
first turn, which fills the disk's cache and saves compiled modules, does not count.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from common import Row, in_turns, medians, parser_for, run

_LEROBOT = "lerobot-train --help"
_LIGHT = ("inspect", "repair", "attach_audio", "push")
_TO_FIRST_WORK = """
import os, sys
folder = sys.argv.pop(1)
def watch(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and str(arguments[0]).startswith(folder):
        os._exit(77)
sys.addaudithook(watch)
from lerobot_playbyear.scripts.{name} import main
main()
"""


def first_work_of(folder: Path) -> dict[str, list[str]]:
    """The options with which each command begins to work on something in a folder."""
    data = ["--dataset.repo_id=a/b", f"--dataset.root={folder / 'dataset'}"]
    env = ["--env.type=playbyear", "--env.task=OccludedGrasp-v1"]
    policy = f"--policy.path={folder / 'policy'}"
    demos = ["--demos.repo_id=a/b", f"--demos.root={folder / 'dataset'}", "--interventions.repo_id=a/c"]
    return {
        "inspect": data,
        "repair": [f"--root={folder / 'dataset'}"],
        "attach_audio": [
            *data,
            "--output.repo_id=a/c",
            f"--output.root={folder / 'copy'}",
            "--files=sound/{episode}.wav",
        ],
        "push": data,
        "train": [*data, "--preset=cpu", f"--output_dir={folder / 'train'}"],
        "record": [*env, "--dataset.repo_id=a/b", f"--dataset.root={folder / 'recording'}"],
        "dagger": [*env, *demos, policy],
        "video": [*env, policy, f"--output={folder / 'film.mp4'}"],
    }


def make_inputs(folder: Path) -> None:
    """Just enough to be found: nothing reads further."""
    for name in ("dataset/meta/info.json", "dataset/data/chunk-000/file-000.parquet", "policy/config.json"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("{}")
    (folder / "recording").mkdir()


def call(command: list[str], status: int) -> None:
    """Runs a command that has to end in this way. It saves the modules that it compiles, whatever the environment says."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode != status:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}, not {status}:\n{done.stderr[-2000:]}")


def works(folder: Path) -> dict[str, Callable[[], None]]:
    """What is timed, by its name in the table."""
    timed = {_LEROBOT: partial(call, [sys.executable, "-m", "lerobot.scripts.lerobot_train", "--help"], 0)}
    for name, options in first_work_of(folder).items():
        command = f"playbyear-{name.replace('_', '-')}"
        module = [sys.executable, "-m", f"lerobot_playbyear.scripts.{name}"]
        watched = [sys.executable, "-c", _TO_FIRST_WORK.format(name=name), str(folder)]
        timed[f"{command} --help"] = partial(call, [*module, "--help"], 0)
        timed[f"{command} with a misspelt option"] = partial(call, [*module, "--misspelt=1"], 2)
        timed[f"{command}, to its first work"] = partial(call, [*watched, *options], 77)
    return timed


def rows(seconds: dict[str, float]) -> list[Row]:
    """The table's: all beside LeRobot's own."""
    theirs, table = seconds[_LEROBOT], []
    for name, ours in seconds.items():
        if name == _LEROBOT:
            continue
        if "first work" not in name:
            wanted, holds = "under 2 s", ours < 2
        elif name.split(",")[0].removeprefix("playbyear-").replace("-", "_") in _LIGHT:
            wanted, holds = "under 5 s", ours < 5
        else:
            wanted, holds = "no slower", ours <= theirs
        table.append(Row(name, ours, "s", _LEROBOT, theirs, wanted=wanted, holds=holds))
    return table


def measure(args: argparse.Namespace) -> list[Row]:
    with TemporaryDirectory() as folder:
        make_inputs(Path(folder))
        return rows(medians(in_turns(works(Path(folder)), args.n_turns)))


if __name__ == "__main__":
    parser = parser_for(__doc__)
    parser.add_argument("--n_turns", type=int, default=3)
    run("startup", parser, measure)
