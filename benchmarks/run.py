"""All benchmarks, one after the other, and their table.

    python benchmarks/run.py          # or: make bench
    python benchmarks/run.py --table  # of the figures that are there

Each script runs in a process of its own and can be run alone. Figures go to `outputs/bench.json`. A machine that does
nothing else gives the steadiest figures; what is compared is measured in turns, so that ratios hold on a busy one as well.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

from common import machine, markdown, parser_for, rows_of

SCRIPTS = ("startup", "training", "acting", "windows", "recording", "environment")
SECTIONS = (*SCRIPTS, "scaling", "large", "processes")  # the last three are measured by hand


def print_table(path: Path) -> None:
    """The whole table and what it was measured on, in Markdown."""
    figures = json.loads(path.read_text())
    measured = {name: figures[name] for name in SECTIONS if name in figures}
    print("\n" + "\n".join(markdown([row for section in measured.values() for row in rows_of(section)])))
    for name, section in measured.items():
        print(f"\n{name}: " + ", ".join(f"{key} {value}" for key, value in section["machine"].items()))


def main() -> int:
    parser = parser_for(__doc__)
    parser.add_argument("--table", action="store_true", help="measure nothing")
    args = parser.parse_args()
    failed = []
    for name in () if args.table else SCRIPTS:
        print(f"== {name} (load {machine()['load_before']})", flush=True)
        start = time.perf_counter()
        script = Path(__file__).with_name(f"{name}.py")
        command = [sys.executable, str(script), f"--output={args.output}"]
        if subprocess.run(command, check=False).returncode:
            failed.append(name)
        print(f"took {time.perf_counter() - start:.0f} s", flush=True)
    print_table(args.output)
    if failed:
        print(f"\nDid not run: {', '.join(failed)}", file=sys.stderr)
    return len(failed)


if __name__ == "__main__":
    sys.exit(main())
