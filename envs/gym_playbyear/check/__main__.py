"""Checks whether a task needs hearing: plays it with its expert, with deaf scripts, and in twin environments.

    python -m gym_playbyear.check OccludedGrasp-v1 --episodes=100 --output=check.json

The expert must solve the task. Blind scripts, which know what the camera shows and feel nothing, must fail. So must deaf
scripts, which feel with the arm. Only the sound may tell that the hidden object was touched. The exit status is 1 if a limit is
broken.
"""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from gym_playbyear.check.report import FIRST_SEED, KINDS, as_text, check


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m gym_playbyear.check", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", help="such as OccludedGrasp-v1")
    parser.add_argument(
        "--episodes", type=int, default=100, help="episodes of each player and of the twin test (default: 100)"
    )
    parser.add_argument(
        "--seed", type=int, default=FIRST_SEED, help=f"seed of the first episode (default: {FIRST_SEED})"
    )
    parser.add_argument("--players", nargs="+", help=f"only these: {', '.join(KINDS)}, or names of scripts")
    parser.add_argument("--no-twin", action="store_true", help="do not compare twin environments")
    parser.add_argument("--jobs", type=int, default=1, help="processes side by side (default: 1)")
    parser.add_argument("--horizon", type=int, help="control steps of an episode (default: the task's own)")
    parser.add_argument("--options", type=json.loads, default={}, help='of the task, as JSON: {"contents": "pens"}')
    parser.add_argument("--no-verdict", action="store_true", help="exit with 0 also if a limit is broken")
    parser.add_argument("--learned", type=Path, nargs="+", default=[], help="results of examples/learned_adversary")
    parser.add_argument(
        "--output", type=Path, help="a JSON file for the results; the same command continues a stopped check"
    )
    arguments = parser.parse_args()
    progress = None
    if arguments.output:  # before the hours that it takes
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        progress = arguments.output.with_suffix(".partial")
    report = check(
        arguments.task,
        arguments.episodes,
        first_seed=arguments.seed,
        names=arguments.players,
        twin=not arguments.no_twin,
        jobs=arguments.jobs,
        learned=[json.loads(path.read_text()) for path in arguments.learned],
        options=arguments.options | ({} if arguments.horizon is None else {"horizon": arguments.horizon}),
        progress=progress,
    )
    print(as_text(report))
    if progress is not None:
        arguments.output.write_text(json.dumps(asdict(report), indent=1) + "\n")
        progress.unlink(missing_ok=True)
    return 1 if report.broken and not arguments.no_verdict else 0


if __name__ == "__main__":
    sys.exit(main())
