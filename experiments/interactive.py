"""What corrections are worth in version 1, beside what the same effort brings otherwise, as the field counts it.

    python -m experiments.interactive --task=OccludedGrasp-v1 --kept=100
    python -m experiments.interactive --task=OccludedGrasp-v1 --n_demonstrations=5 --kept=100 --rounds=2
    python -m experiments.interactive --task=KeyBag-Hard-v1 --course=paper --policy.auxiliary_onset=0

1. A policy is trained on demonstrations, with the preset `cpu` and what is given as `--policy.NAME=VALUE`. Where
   `experiments.ablations` has trained it, that one is taken. All policies that follow have the same options.
2. In each round `playbyear-dagger` collects attempts that the expert had to help in, by one of the `METHODS`, and a policy
   learns from all demonstrations and corrections: with `--learn=new_weights` from the beginning, with `--learn=online` as
   attempts come. A collection ends early where the policy needs no help in 200 attempts in a row.
3. The control `updates` learns from the demonstrations alone, and begins as the corrected policy does: with new weights, or
   with the first policy. The control `demonstrations` learns from further ones, too: as many as have the expert's steps that
   the corrections took. The weights of both get as many updates in all as those of the corrected policy.

All are evaluated on the same seeds, which nothing else uses; `first_search` counts the successes of the hand's first closing.

What takes time are updates; collecting makes none, and takes as long as its attempts.

| part | updates | is made once for all methods of a training seed |
|---|---|---|
| first policy | 1,250 | yes |
| corrected policy | new_weights: `--updates` (1,250) a round; online: these, less those of 4 kept attempts | no |
| `updates` | new_weights: `--updates`, but none if they are 1,250; online: as many as the corrections | if it is as many |
| `demonstrations` | new_weights: `--updates`; online: 1,250, and as many as the corrections | if it has as many of both |

With `--grow` the last round has twice `--updates`; all that comes before is shared with the study without it.
So with one round the first method takes 3,750, and each further one 1,250 to 2,500; online they take 6,250, and 1,250 to
5,000.

Resumes where it was interrupted. Studies may run at the same time; those of one training wait for each other. They wait for
`experiments.ablations`, too, but that does not wait for them: do not start it while a study trains the same policy.
"""

import json
import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from experiments.interactive_methods import COURSES, METHODS, WEIGHING, check
from experiments.interactive_parts import alone, demonstrated, finished, first_job, metrics_of, newest, trained
from experiments.protocol import (
    N_DEMONSTRATIONS,
    NEW_TASKS,
    RESULTS,
    RUNS,
    STEPS,
    command_line,
    library_versions,
    load,
    options_of,
    save,
)
from experiments.training import Job, evaluate
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.dagger.report import Totals

STUDY = "interactive"
BATCH_SIZE = 12
CONTROLS = ("updates", "demonstrations")


@dataclass
class Outcome:
    """A policy's evaluation, and what it took to get there.

    Attributes:
        updates: That its weights got in all, those on demonstrations alone included.
        n_demonstrations: That it learned from.
        success, first_search: Percentages of the evaluation's episodes.
        failures: How the others ended.
        kept, attempts: Attempts that were kept, and that were made: so many scenes were set up, with `redo` and after a failure
            that is shown again each twice. `attempts` is 0 in results that are older than it.
        expert_steps: Steps in which the expert acted, in these and in those that were not kept; of the control
            `demonstrations`, in the further ones.
        takeovers, switches, person_seconds, autonomy: As in `metrics.jsonl`, of all attempts so far.
        by_contents: Success with each of the contents; empty where a task has none.
        ends: How each episode of the evaluation ended, in the order of the seeds.
    """

    updates: int
    n_demonstrations: int
    success: float
    first_search: float | None
    failures: str
    kept: int = 0
    attempts: int = 0
    expert_steps: int = 0
    takeovers: int = 0
    switches: int = 0
    person_seconds: float = 0.0
    autonomy: float = 1.0
    by_contents: str = ""
    ends: list[str] = field(default_factory=list, repr=False)


@dataclass
class Interactive:
    """One policy's way through corrections, and what else the effort would have brought.

    Attributes:
        task, method, learn, course, training_seed, training_options: What was done.
        first_seed, n_episodes: Of every evaluation.
        outcomes: Of the first policy, and after every round.
        controls: By their names.
        commands: In order; what several parts share is named once.
    """

    task: str
    method: str
    learn: str
    course: str
    training_seed: int
    training_options: list[str]
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
        self.job, self.options = job, options
        how = [options.method, options.learn, *([] if options.course == "own" else [options.course])]
        self.how = "-".join([*how, f"{options.kept}kept", f"{options.rounds}rounds", f"{options.updates}updates"])
        self.name = f"{job.name}-{self.how}"
        self.path = RESULTS / STUDY / f"{self.name}{'-grow' if options.grow else ''}.json"
        self.corrections = RUNS / "datasets" / f"{STUDY}-{self.name}"
        self.commands: list[str] = []
        self.folders: list[Path] = []

    def run(self) -> Interactive:
        options, job = self.options, self.job
        self.demonstrations, self.n_frames = demonstrated(job.task, job.n_demonstrations)
        outcomes = [self._outcome_of(job)]
        policy, updates = job.checkpoint, job.steps
        for number in range(1, options.rounds + 1):
            kept = options.kept * number // options.rounds
            if options.learn == "online":
                policy, updates = self._learn_online(kept)
            else:
                self._collect(policy, number, kept)
                if any(line.get("outcome") == "kept" for line in metrics_of(self.folders)):
                    updates = options.updates * (2 if options.grow and number == options.rounds else 1)
                    policy = self._learn_anew(number, updates)
            outcomes.append(self._outcome_of_round(number, policy, updates))
            print(f"{self.name}: {outcomes[-1]}", flush=True)
        controls = {name: self._control(name, outcomes[-1]) for name in options.controls}
        return Interactive(
            *(job.task, options.method, options.learn, options.course, job.training_seed, list(job.options)),
            *(job.evaluation_seeds.start, len(job.evaluation_seeds), outcomes, controls),
            list(dict.fromkeys(self.commands)),
        )

    def _dagger(self, policy: Path, name: str, *options: str) -> Path:
        """Runs `playbyear-dagger`, or what is missing of it. Returns its folder."""
        folder = RUNS / "dagger" / f"{self.name}-{name}"
        command = [
            "playbyear-dagger",
            f"--policy.path={policy}",
            *options_of(self.demonstrations),
            *options_of(self.corrections, "interventions"),
            f"--batch_size={BATCH_SIZE}",
            f"--seed={self.job.training_seed}",
            "--eval_every=0",
            f"--output_dir={folder}",
            "--resume=true",
            *options,
        ]
        self.commands.append(finished(command, folder, self.job.threads))
        return folder

    def _attempts(self, policy: Path, name: str, task: str, kept: int, updates_per_episode: int) -> Path:
        """Attempts at a task until the run has kept so many. Returns its folder."""
        environment = ["--env.type=playbyear", f"--env.task={task}", *METHODS[self.options.method]]
        if task != self.job.task:  # the policy hears by the microphones that it knows
            environment.append(f"--env.microphones={json.dumps(PlaybyearEnvConfig(task=self.job.task).microphones)}")
        how = (f"--num_episodes={kept}", f"--updates_per_episode={updates_per_episode}", "--max_attempts=200")
        folder = self._dagger(policy, name, *environment, *how)
        if folder not in self.folders:
            self.folders.append(folder)
        return folder

    def _collect(self, policy: Path, number: int, kept: int) -> None:
        """Attempts of a policy that stays as it is."""
        course = {**(COURSES[self.options.course] if number == 1 else {}), self.job.task: kept}
        before = self.options.kept * (number - 1) // self.options.rounds
        for task, n in course.items():
            self._attempts(policy, f"collect{number}-{task}", task, n - before, 0)
            before = n

    def _learn_anew(self, number: int, updates: int) -> Path:
        """A policy that learns everything; the first one gives its options and its normalisation. Returns its checkpoint."""
        learned = (f"--steps={updates}", "--updates_per_episode=500", "--num_episodes=0")
        weights = METHODS[self.options.method] if self.options.method in WEIGHING else ()
        name = f"learn{number}{self._grown(updates)}"
        folder = self._dagger(self.job.checkpoint, name, *learned, "--new_weights=true", *weights)
        return newest(folder)

    def _grown(self, updates: int) -> str:
        """What tells a round that has more than `--updates` from the same round with those."""
        grown = self.options.learn == "new_weights" and updates > self.options.updates
        return f"-{updates}updates" if grown else ""

    def _learn_online(self, kept: int) -> tuple[Path, int]:
        """HG-DAgger as it is meant: updates after every kept attempt; a further round goes on with the same runs.

        Returns:
            The checkpoint, and the updates of its weights; those of the first policy where none were made.
        """
        per_episode = self.options.updates * self.options.rounds // self.options.kept
        policy, updates, before = self.job.checkpoint, self.job.steps, 0
        for task, n in {**COURSES[self.options.course], self.job.task: kept}.items():
            folder = self._attempts(policy, f"online-{task}", task, n - before, per_episode)
            before = n
            state = load(folder / "dagger_state.json")
            if state["checkpoint"] is not None:
                policy, updates = newest(folder), updates + state["step"]
        return policy, updates

    def _control(self, name: str, last: Outcome) -> Outcome:
        """What as many updates bring without corrections."""
        job = self.job
        if name == "demonstrations":
            n = job.n_demonstrations + math.ceil(last.expert_steps * job.n_demonstrations / self.n_frames)
            n_frames = demonstrated(job.task, n)[1]
            control = replace(first_job(job.task, job.training_seed, n, job.options, job.threads), steps=last.updates)
            return self._outcome_of(control, n_frames - self.n_frames)
        if self.options.learn == "new_weights":
            return self._outcome_of(replace(job, steps=last.updates))
        further = last.updates - job.steps
        if not further:
            return self._outcome_of(job)
        start = (f"--policy.path={job.checkpoint}", "--policy.push_to_hub=false", f"--batch_size={BATCH_SIZE}")
        variant = "-".join(filter(None, [job.variant, f"control-of-{job.steps}steps"]))
        control = replace(job, steps=further, variant=variant, start=(*start, f"--save_freq={further}"))
        return replace(self._outcome_of(control), updates=last.updates)

    def _outcome_of(self, job: Job, expert_steps: int = 0) -> Outcome:
        """Trains and evaluates a policy that other studies may have trained and evaluated."""
        self.commands.append(trained(job))
        outcome = self._evaluated(job, "", job.checkpoint, job.steps)
        return replace(outcome, expert_steps=expert_steps)  # depends on what it is a control of

    def _outcome_of_round(self, number: int, policy: Path, updates: int) -> Outcome:
        lines = list(metrics_of(self.folders))
        totals = Totals.of(lines)
        figures = ("attempts", "expert_steps", "takeovers", "switches", "person_seconds", "autonomy")
        spent = {figure: getattr(totals, figure) for figure in figures}
        kept = sum(line.get("outcome") == "kept" for line in lines)
        name = f"-{self.how}-round{number}{self._grown(updates)}"
        return self._evaluated(self.job, name, policy, updates, kept=kept, **spent)

    def _evaluated(self, job: Job, name: str, policy: Path, updates: int, **spent: Any) -> Outcome:
        """Evaluates a policy, unless that was done; what it had taken by then is kept with it."""
        path = RUNS / STUDY / f"{job.name}{name}.json"
        with alone(path):
            if not path.exists():
                commands: list[str] = []
                told = evaluate(job, commands, name=f"{STUDY}{name}", checkpoint=policy)
                first = None if told.first_search_rate is None else 100 * told.first_search_rate
                figures = (100 * told.rate, first, told.failures)
                more = {"by_contents": told.by_contents, "ends": told.ends}
                outcome = Outcome(updates, job.n_demonstrations, *figures, **more, **spent)
                save(path, {**asdict(outcome), "commands": commands})
        saved = load(path)
        self.commands += saved.pop("commands")
        return Outcome(**saved)


def main() -> None:
    parser = command_line(__doc__, "task", "seeds", "threads")
    parser.set_defaults(task=NEW_TASKS[0], seeds=[1])
    parser.add_argument("--n_demonstrations", type=int, default=N_DEMONSTRATIONS)
    parser.add_argument("--method", choices=METHODS, default="skip")
    parser.add_argument("--learn", choices=("new_weights", "online"), default="new_weights")
    parser.add_argument("--course", choices=COURSES, default="own", help="what is attempted first")
    parser.add_argument("--kept", type=int, default=100, help="attempts that are kept in all")
    parser.add_argument("--rounds", type=int, default=1, help="in which they are collected and learned from")
    parser.add_argument("--updates", type=int, default=STEPS, help="of each round")
    parser.add_argument(
        "--grow", action="store_true", help="the last round has twice --updates, as it learns from more"
    )
    parser.add_argument("--controls", nargs="*", choices=CONTROLS, default=CONTROLS)
    options, training = parser.parse_known_args()
    try:
        check(options, training)
    except ValueError as error:
        parser.error(str(error))
    for seed in options.seeds:
        job = first_job(options.task, seed, options.n_demonstrations, training, options.threads)
        study = Study(job, options)
        with alone(RUNS / STUDY / study.name):
            if not study.path.exists():
                save(study.path, asdict(study.run()))
        result = load(study.path)
        for name, outcome in (*enumerate(result["outcomes"]), *result["controls"].items()):
            print(f"{study.name}, {name}: {Outcome(**outcome)}", flush=True)


if __name__ == "__main__":
    main()
