"""The whole published budget on one GPU, in minutes: 1.6 million windows offline, and as many with 100 corrected attempts.

    python benchmarks/published_budget.py                    # on a GPU with 16 cores
    python benchmarks/published_budget.py --smoke            # all of it tiny, on a CPU

As published, 1,000 updates of 16 windows follow every kept attempt, one after the other. Here the same number of windows is
learned in updates of 384, and attempts are collected in several processes on the CPU cores while the GPU learns from those
before: in every round the policy acts that the round before last has left. The same command goes on where it was stopped.
"""

import argparse
import json
import os
import time
from pathlib import Path

from lerobot_playbyear.datasets.files import parse_json, write_atomically
from lerobot_playbyear.reproduce.plan import Step
from lerobot_playbyear.reproduce.steps import carry_out, forked, prepare
from lerobot_playbyear.reproduce.table import Table, machine, rate, told, versions

FIRST_ATTEMPT, HELD_OUT = 10_000, 70_000  # seeds, as in the plan of playbyear-reproduce
SEEDS_OF_A_PART = 200
TINY = (
    "--preset=cpu --policy.image_size=16 --policy.vision_width=4 --policy.n_memory_steps=2 --policy.hidden_size=32 "
    "--batch_size=2"
)


class Budget:
    """One run of it.

    Args:
        options: The command line's.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.folder = options, options.output_dir
        self.env = f"--env.type=playbyear --env.task={options.task}" + (" --env.image_size=16" * options.smoke)
        self.demos = f"--dataset.repo_id=budget/demos --dataset.root={self.folder / 'demos'}"

    def run(self) -> dict[str, object]:
        """All rounds. Returns a row for the table."""
        options, n = self.options, self.options.n_rounds
        train = TINY if options.smoke else "--preset=gpu"
        self.clocked(
            "record",
            [
                self.step(
                    "demos",
                    f"playbyear-record {self.env} {self.demos} --dataset.num_episodes={options.n} --resume=true",
                )
            ],
        )
        offline = (
            f"playbyear-train {train} {self.demos} --output_dir={self.folder / 'offline'} --steps={options.steps} "
            f"--save_freq={options.steps} --env_eval_freq=0 --seed={options.seed} --wandb.enable=false"
        )
        self.clocked("offline", [self.step("offline", offline)])
        policies = [self.folder / "offline"]
        for number in range(1, n + 2):  # in the first nothing is learned yet, in the last nothing is collected any more
            steps = self.collecting(number, policies[-1]) if number <= n else []
            if number > 1:
                steps.append(self.learning(number - 1, policies[-1]))
            self.clocked(f"round {number}", steps)
            if number <= n:
                self.clocked(f"merging {number}", [self.merging(number)])
            if number > 1:
                policies.append(self.folder / f"learned-{number - 1}")
        return self.judged(policies)

    def collecting(self, number: int, run: Path) -> list[Step]:
        """Attempts of a policy that stays as it is, a part in each process."""
        options, steps = self.options, []
        for part in range(options.n_parts):
            name = f"collected-{number}-{part}"
            first = FIRST_ATTEMPT + SEEDS_OF_A_PART * (number * options.n_parts + part)
            command = (
                f"playbyear-dagger --policy.path={_last(run)} --policy.device=cpu {self.env} {self.demos} "
                f"--interventions.repo_id=budget/attempts --interventions.root={self.folder / name / 'attempts'} "
                f"--num_episodes={options.n_kept} --updates_per_episode=0 --eval_every=0 --max_attempts={SEEDS_OF_A_PART} "
                f"--episode_seed={first} --seed={options.seed} --output_dir={self.folder / name} --resume=true {options.method}"
            )
            steps.append(self.step(name, command))
        return steps

    def merging(self, number: int) -> Step:
        """All attempts so far as one dataset."""
        parts = [
            f"{self.folder}/collected-{n}-{part}/attempts"
            for n in range(1, number + 1)
            for part in range(self.options.n_parts)
        ]
        name, roots = f"merged-{number}", " ".join(parts)
        own = f"--root={self.folder / name} --repo_id=budget/attempts"
        return self.step(name, f"python examples/merge_recordings.py --roots {roots} {own}")

    def learning(self, number: int, run: Path) -> Step:
        """The updates that follow a round's attempts."""
        options, name = self.options, f"learned-{number}"
        command = (
            f"playbyear-dagger --policy.path={_last(run)} {self.demos} --num_episodes=0 {options.method} "
            f"--interventions.repo_id=budget/attempts --interventions.root={self.folder / f'merged-{number}'} "
            f"--steps={options.steps // options.n_rounds} --updates_per_episode={options.steps} "
            f"--batch_size={options.batch_size} --seed={options.seed} --output_dir={self.folder / name} --resume=true"
        )
        return self.step(name, command)

    def judged(self, policies: list[Path]) -> dict[str, object]:
        """Success before and after, and what it took."""
        tried = {"offline": policies[0], "after": policies[-1]}
        n = self.options.n_episodes
        for name, run in tried.items():
            file = self.folder / f"evaluated-{name}" / "attempts.jsonl"
            command = (
                f"lerobot-eval --policy.path={_last(run)} --policy.device=cpu {self.env} --env.attempts_file={file} "
                f"--eval.n_episodes={n} --eval.batch_size={min(n, 25)} --eval.use_async_envs=false --seed={HELD_OUT} "
                f"--output_dir={file.parent}"
            )
            self.side_by_side([Step("evaluate", file.parent, tuple(command.split()))])
        found = {name: told(self.folder / f"evaluated-{name}" / "attempts.jsonl", HELD_OUT, n) for name in tried}
        minutes = {name: round(spent / 60, 2) for name, spent in self.spent().items()}
        return {
            **{"study": "published_budget", "task": self.options.task, "variant": "larger_updates"},
            **{"seed": self.options.seed, "size": "smoke" if self.options.smoke else "gpu"},
            **{**found["after"], "before": found["offline"]["successes"], "minutes": minutes},
            **{"total_minutes": round(sum(minutes.values()), 1), "versions": versions(), "machine": machine()},
            "commands": ["python benchmarks/published_budget.py" + " --smoke" * self.options.smoke],
        }

    # Doing it

    def step(self, name: str, command: str) -> Step:
        return Step(name, self.folder / name, tuple(command.split()))

    def clocked(self, name: str, steps: list[Step]) -> None:
        """Carries steps out side by side, and notes how long that took until all were done."""
        path, start = self.folder / "seconds.json", time.monotonic()
        if name in self.spent():
            return
        self.side_by_side(steps)
        write_atomically(path, json.dumps({**self.spent(), name: round(time.monotonic() - start, 1)}, indent=1))
        print(f"{name}: {time.monotonic() - start:.0f} s", flush=True)

    def side_by_side(self, steps: list[Step]) -> None:
        """Each step in a fork of this process, which never asks for the GPU itself."""
        forks = [forked(lambda step=step: int(carry_out(step) < 0)) for step in steps]
        ended = [os.waitpid(pid, 0)[1] for pid in forks]
        if any(ended):
            raise SystemExit("A command failed; the same command goes on.")

    def spent(self) -> dict[str, float]:
        path = self.folder / "seconds.json"
        return dict(parse_json(path.read_bytes())) if path.exists() else {}


def _last(run: Path) -> Path:
    return run / "checkpoints" / "last" / "pretrained_model"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="OccludedGrasp-v1")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--smoke", action="store_true", help="all of it tiny, on a CPU")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/published_budget"))
    parser.add_argument("--results", type=Path, default=Path("results"))
    options = parser.parse_args()
    usual = {"n": 50, "steps": 4167, "n_rounds": 10, "n_parts": 5, "n_kept": 2, "batch_size": 24, "n_episodes": 100}
    tiny = {"n": 2, "steps": 4, "n_rounds": 2, "n_parts": 2, "n_kept": 1, "batch_size": 2, "n_episodes": 2}
    for name, value in (tiny if options.smoke else usual).items():
        setattr(options, name, value)
    options.method = "--method.type=redo" if options.smoke else "--method.type=hg_dagger --skip_s=0"
    options.output_dir.mkdir(parents=True, exist_ok=True)
    prepare()
    row = Budget(options).run()
    Table(options.results).put([row])
    print(
        f"{rate(str(row['successes'])):.0f} %, before {rate(str(row['before'])):.0f} %, {row['total_minutes']} minutes in all"
    )


if __name__ == "__main__":
    main()
