"""A plan whose commands take no time, and what they are: a cell of it does all that a real one does."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

_COMMAND = """
import sys
from lerobot_playbyear.scripts.commands import reproduce
sys.argv[0] = "playbyear-reproduce"
reproduce()
"""

_STEP = """
import json, os, pathlib, sys, time
kind, folder, count, seconds, *more = sys.argv[1:]
folder = pathlib.Path(folder)
if kind == "fails" and not (folder.parent / "mended").exists():
    sys.exit("it is broken")
time.sleep(float(seconds))
folder.mkdir(parents=True, exist_ok=True)
if kind == "evaluate":
    first, n = int(more[0]), int(more[1])
    failed = {"is_success": False, "end": "time", "failure": "dropped", "acted_early": True}
    solved = {"is_success": True, "end": "success", "acted_early": False}, failed
    lines = [{"seed": s, "steps": 3, **solved[s % 3 == 0]} for s in range(first, first + n)]
    (folder / "attempts.jsonl").write_text("".join(json.dumps(line) + "\\n" for line in lines))
else:
    for name in ("000001", "last"):
        (folder / "checkpoints" / name / "pretrained_model").mkdir(parents=True, exist_ok=True)
with open(count, "a") as file:
    file.write(str(folder) + "\\n")
"""


def write_plan(folder: Path, seconds: float = 0.0, kind: str = "makes", n_seeds: int = 2) -> Path:
    """A plan of two tasks, three variants and some seeds.

    Args:
        folder: Of the plan and of its program. Every command that ended well is noted in `count` there.
        seconds: Of each command.
        kind: Of the command that trains: `makes`, or `fails` until there is a file `mended` beside what it makes.
        n_seeds: Of trainings.
    """
    program = folder / "step.py"
    program.write_text(_STEP)
    call = f"python {program} %s $folder {folder / 'count'} {seconds}"
    film = f"python {program} film $folder {folder / 'count'} 0 $mode"
    text: dict[str, Any] = {
        "seeds": {"seed_choice": 10, "seed_held_out": 100},
        "sizes": {
            "tiny": {
                "seeds": list(range(1, n_seeds + 1)),
                **{"steps": 4, "rl_steps": 1, "every": 1, "warmup": 1, "updates": 1, "kept": 2},
                **{"n_choice": 1, "n_held_out": 3, "training": "", "online": ""},
            }
        },
        "defaults": {"policy": "full", "steps_factor": 1, "rl_factor": 1},
        "policies": {"full": "", "no_audio": "--policy.use_audio=false"},
        "learning": "",
        "steps": {
            "record": {"folder": "data/$task", "command": call % "makes"},
            "train": {"folder": "train/$task-$policy-$seed", "command": call % kind},
            "teach": {"folder": "taught/$task-$policy-$seed", "command": call % "makes", "rounds": "$kept"},
            "evaluate": {"command": f"{call % 'evaluate'} $first_seed $n_episodes"},
            "film": {"command": film},
        },
        "courses": {"offline": ["record", "train"], "interventions": ["record", "train", "teach"]},
        "variants": {
            "full": {"course": "interventions"},
            "no_interventions": {"course": "offline"},
            "no_audio": {"course": "offline", "policy": "no_audio"},
        },
        "studies": {
            "parts": {
                "title": "Parts",
                "about": "Each part removed.",
                "first": 2,
                "paper": {"full": "70 %"},
                "tasks": {"Grasp": {}, "Place": {}},
                "variants": ["full", "no_interventions", "no_audio"],
            }
        },
    }
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump(text))
    return path


def arguments(folder: Path, action: str, *options: str) -> list[str]:
    """A command line of `playbyear-reproduce` on the plan in a folder, of a process that need not import LeRobot."""
    given = (f"--plan={folder / 'plan.yaml'}", f"--output_dir={folder / 'out'}", f"--results={folder / 'results'}")
    words = [option for option in options if not option.startswith("-")]
    return [sys.executable, "-c", _COMMAND, action, *words, "--size=tiny", *given, *(set(options) - set(words))]


def call(
    folder: Path, action: str, *options: str, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs it to its end, with more in its environment."""
    own = {**os.environ, **(environment or {})}
    return subprocess.run(arguments(folder, action, *options), capture_output=True, text=True, check=False, env=own)


def rows(folder: Path) -> list[dict[str, Any]]:
    """The table's."""
    path = folder / "results/parts.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def counted(folder: Path) -> list[str]:
    """The folders of the commands that ended well, in their order."""
    path = folder / "count"
    return path.read_text().splitlines() if path.exists() else []
