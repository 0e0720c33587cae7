"""What corrections are worth in version 1, beside what the same effort brings otherwise, as the field counts it.

    python -m experiments.interactive --task=OccludedGrasp-v1 --kept=100
    python -m experiments.interactive --task=OccludedGrasp-v1 --n_demonstrations=5 --kept=100 --rounds=2
    python -m experiments.interactive --task=KeyBag-Hard-v1 --course=paper

1. A policy is trained on demonstrations.
2. In each round `playbyear-dagger` collects attempts that the expert had to help in, by one of the `METHODS`, and a policy
   learns from all demonstrations and corrections: with `--learn=new_weights` from the beginning, with `--learn=online` as
   attempts come.
3. The first control makes as many further updates on the demonstrations alone. The second learns, for as many updates, from
   further demonstrations instead: as many as have the expert's steps that the corrections took.

All are evaluated on the same seeds, which nothing else uses; `first_search` counts the successes of the hand's first closing.
Resumes where it was interrupted.
"""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from experiments.protocol import (
    N_DEMONSTRATIONS,
    NEW_TASKS,
    RESULTS,
    RUNS,
    STEPS,
    command_line,
    dataset_root,
    library_versions,
    load,
    options_of,
    record,
    save,
    shown,
)
from experiments.training import Job, clocked, evaluate, train
from lerobot_playbyear.dagger.figures import Totals

STUDY = "interactive"
METHODS: dict[str, tuple[str, ...]] = {
    "hg_dagger": (),
    "dagger": ("--method.type=dagger",),
    "no_handback": ("--method.type=no_handback",),
    "sirius": ("--method.type=weighted",),
    "iwr": ("--method.type=weighted", "--method.paper=iwr"),
    "robot_gated": ("--method.type=robot_gated",),
    "early": ("--takeover_delay_s=-0.5",),
    "late": ("--takeover_delay_s=0.5",),
    "all_frames": ("--learn_from=all",),
    "person": ("--expert.person=true",),
    "person_robot_gated": ("--method.type=robot_gated", "--expert.person=true"),
}
WEIGHING = ("sirius", "iwr", "all_frames")
"""Those that say what is learned from; the others say who acts, and what is kept."""
COURSES = {"own": {}, "paper": {"KeyBag-Easy-v1": 12}}
"""Attempts that are kept in other tasks before the task itself; the paper's order for the bag."""
BATCH_SIZE = 12
CONTROLS = ("updates", "demonstrations")


@dataclass
class Outcome:
    """A policy's evaluation, and what it took to get there.

    Attributes:
        kept, expert_steps: Kept attempts, and steps in which the expert acted, in these and in those that were not kept.
        takeovers, switches, person_seconds, autonomy: As in `metrics.jsonl`, of all attempts so far.
        updates: Since the first policy.
        n_demonstrations: That it learned from.
        success, first_search: Percentages of the evaluation's episodes.
        failures: How the others ended.
    """

    kept: int
    expert_steps: int
    updates: int
    n_demonstrations: int
    success: float
    first_search: float | None
    failures: str
    takeovers: int = 0
    switches: int = 0
    person_seconds: float = 0.0
    autonomy: float = 1.0


@dataclass
class Interactive:
    """One policy's way through corrections, and what else the effort would have brought.

    Attributes:
        task, method, learn, course, training_seed: What was done.
        first_seed, n_episodes: Of every evaluation.
        outcomes: Of the first policy, and after every round (or every so many kept attempts).
        controls: By their names.
        commands: In order.
    """

    task: str
    method: str
    learn: str
    course: str
    training_seed: int
    first_seed: int
    n_episodes: int
    outcomes: list[Outcome]
    controls: dict[str, Outcome]
    commands: list[str]
    versions: dict[str, str] = field(default_factory=library_versions)


class Study:
    """One run of all parts, or of what is missing of them.

    Args:
        job: The training of the first policy.
        options: The command line's.
    """

    def __init__(self, job: Job, options: Any):
        assert job.dataset is not None
        self.job, self.options, self.demonstrations = job, options, job.dataset
        how = [options.method, options.learn, *([] if options.course == "own" else [options.course])]
        size = [f"{options.kept}kept", f"{options.rounds}rounds", f"{options.updates}updates"]
        self.name = "-".join([job.name, *how, *size])
        self.path = RESULTS / STUDY / f"{self.name}.json"
        self.corrections = RUNS / "datasets" / f"interactive-{self.name}"
        self.commands: list[str] = []
        self.folders: list[Path] = []

    def run(self) -> Interactive:
        options, job = self.options, self.job
        record(job.task, job.n_demonstrations, self.demonstrations)
        command, _ = train(job)
        self.commands.append(command)
        outcomes = [self._outcome("first", job, job.checkpoint, 0)]
        policy = job.checkpoint
        for number in range(1, options.rounds + 1):
            kept = options.kept * number // options.rounds
            if options.learn == "online":
                policy, updates = self._learn_online(policy, kept)
            else:
                self._collect(policy, number, kept)
                policy, updates = self._learn_anew(job, number), options.updates * number
            outcomes.append(self._outcome(f"round{number}", job, policy, updates, self.folders))
            print(f"{self.name}: {outcomes[-1]}", flush=True)
        controls = {name: self._control(name, outcomes[-1]) for name in options.controls}
        return Interactive(
            *(job.task, options.method, options.learn, options.course, job.training_seed),
            *(job.evaluation_seeds.start, len(job.evaluation_seeds), outcomes, controls, self.commands),
        )

    def _dagger(self, policy: Path, name: str, *options: str) -> Path:
        """Runs `playbyear-dagger`, or what is missing of it. Returns its folder."""
        folder = RUNS / "dagger" / f"{self.name}-{name}"
        command = [
            "playbyear-dagger",
            f"--policy.path={policy}",
            *options_of(self.demonstrations, "demos"),
            *options_of(self.corrections, "interventions"),
            f"--batch_size={BATCH_SIZE}",
            f"--seed={self.job.training_seed}",
            "--eval_every=0",
            f"--output_dir={folder}",
            "--resume=true",
            *options,
        ]
        clocked(command, folder, self.job.threads)
        self.commands.append(shown(command))
        return folder

    def _environment(self, task: str) -> tuple[str, ...]:
        return ("--env.type=playbyear", f"--env.task={task}", *METHODS[self.options.method])

    def _collect(self, policy: Path, number: int, kept: int) -> None:
        """Attempts of a policy that stays as it is, until the dataset holds so many."""
        course = {**(COURSES[self.options.course] if number == 1 else {}), self.job.task: kept}
        for task, n in course.items():
            name = f"collect{number}-{task}"
            folder = self._dagger(
                policy,
                name,
                *self._environment(task),
                f"--episodes={n}",
                "--updates_per_episode=0",
                "--max_attempts=200",
            )
            self.folders.append(folder)

    def _learn_anew(self, job: Job, number: int) -> Path:
        learned = [
            f"--updates={self.options.updates}",
            "--updates_per_episode=500",
            "--episodes=0",
            "--new_weights=true",
        ]
        weights = METHODS[self.options.method] if self.options.method in WEIGHING else ()
        folder = self._dagger(job.checkpoint, f"learn{number}", *learned, *weights)
        return folder / "checkpoints" / "last" / "pretrained_model"

    def _learn_online(self, policy: Path, kept: int) -> tuple[Path, int]:
        """HG-DAgger as it is meant: updates after every kept attempt; a further round goes on with the same run."""
        per_episode = self.options.updates * self.options.rounds // self.options.kept
        updates = (f"--updates_per_episode={per_episode}", f"--save_every={self.options.kept // self.options.rounds}")
        first = self.job.checkpoint
        folder = self._dagger(first, "online", *self._environment(self.job.task), f"--episodes={kept}", *updates)
        if folder not in self.folders:
            self.folders.append(folder)
        state = json.loads((folder / "dagger_state.json").read_text())
        return folder / "checkpoints" / "last" / "pretrained_model", state["step"]

    def _outcome(self, name: str, job: Job, policy: Path, updates: int, folders: Iterable[Path] = ()) -> Outcome:
        """Evaluates a policy; `folders`: the runs whose corrections it learned from, none for controls."""
        path = RUNS / "interactive" / f"{self.name}-{name}.json"
        if not path.exists():
            commands: list[str] = []
            told = evaluate(job, commands, name=f"{STUDY}-{self.name}-{name}", checkpoint=policy)
            rate = told.first_search_rate
            lines = list(_metrics(folders))
            totals, kept = Totals.of(lines), sum(line.get("outcome") == "kept" for line in lines)
            outcome = Outcome(
                *(kept, totals.expert_steps, updates, job.n_demonstrations),
                *(100 * told.rate, None if rate is None else 100 * rate, told.failures),
                *(totals.takeovers, totals.switches, totals.person_seconds, totals.autonomy),
            )
            save(path, {**asdict(outcome), "commands": commands})
        saved = load(path)
        self.commands += saved.pop("commands")
        return Outcome(**saved)

    def _control(self, name: str, last: Outcome) -> Outcome:
        job = self.job
        if name == "updates":
            start = (f"--policy.path={job.checkpoint}", "--policy.push_to_hub=false", f"--batch_size={BATCH_SIZE}")
            control = replace(
                job,
                steps=last.updates,
                variant=f"control-of-{job.steps}steps",
                start=(*start, f"--save_freq={last.updates}"),
            )
        else:
            meta = load(self.demonstrations / "meta" / "info.json")
            further = max(1, round(last.expert_steps * meta["total_episodes"] / meta["total_frames"]))
            more = job.n_demonstrations + further
            control = replace(job, n_demonstrations=more, dataset=demonstrations(job.task, more))
            record(job.task, more, control.dataset)
        command, _ = train(control)
        self.commands.append(command)
        return self._outcome(f"control-{name}", control, control.checkpoint, last.updates)


def demonstrations(task: str, n: int) -> Path:
    """A dataset of the first n demonstrations and no more: `playbyear-dagger` learns from all that it is given."""
    return dataset_root(task) if n == N_DEMONSTRATIONS else RUNS / "datasets" / f"{task}-{n}"


def _metrics(folders: Iterable[Path]) -> Iterable[dict[str, Any]]:
    """The lines of some runs' attempts."""
    for folder in folders:
        yield from (json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines())


def main() -> None:
    parser = command_line(__doc__, "task", "seeds", "threads")
    parser.set_defaults(task=NEW_TASKS[0], seeds=[1])
    parser.add_argument("--n_demonstrations", type=int, default=N_DEMONSTRATIONS)
    parser.add_argument("--method", choices=METHODS, default="hg_dagger")
    parser.add_argument("--learn", choices=("new_weights", "online"), default="new_weights")
    parser.add_argument("--course", choices=COURSES, default="own", help="what is attempted first")
    parser.add_argument("--kept", type=int, default=100, help="attempts that are kept in all")
    parser.add_argument("--rounds", type=int, default=1, help="in which they are collected and learned from")
    parser.add_argument("--updates", type=int, default=STEPS, help="of each round")
    parser.add_argument("--controls", nargs="*", choices=CONTROLS, default=CONTROLS)
    options = parser.parse_args()
    for seed in options.seeds:
        n = options.n_demonstrations
        dataset = demonstrations(options.task, n)
        job = Job("ablations", options.task, "full", seed, n, threads=options.threads, dataset=dataset)
        study = Study(job, options)
        if not study.path.exists():
            save(study.path, asdict(study.run()))
        result = load(study.path)
        for line in (*result["outcomes"], *result["controls"].items()):
            print(f"{study.name}: {line}", flush=True)


if __name__ == "__main__":
    main()
