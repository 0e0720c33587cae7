"""Does the hand of LeRobot's own policies wait for the touch?

    python -m experiments.others_twin --task=OccludedGrasp-v1 --minutes=28

Plays what `experiments.others` trained once more, on the same seeds, in the twin world: the hand passes through the hidden
object, so that there is no touch to hear or to feel, and all else is the same. A policy that closes its hand as often there
did not wait for the touch. How often it closes is put into its result.
"""

from dataclasses import asdict

from experiments.others import CONDITIONS, SEEDS, SETTINGS, STUDY, OtherResult, environment_options
from experiments.protocol import NEW_TASKS, RESULTS, command_line, load, save
from experiments.training import Job, evaluate

TWIN = "--env.hidden_object=false"


def played_in_the_twin_world(result: OtherResult, variant: str) -> OtherResult:
    """The result with the closings of the twin world.

    Args:
        result: Of a policy whose checkpoint is still there.
        variant: Setting and minutes, as in the checkpoint's folder.
    """
    job = Job(
        STUDY,
        result.task,
        result.condition,
        result.training_seed,
        steps=result.steps,
        threads=result.threads,
        variant=variant,
    )
    told = evaluate(job, result.commands, *environment_options(job.task, job.condition), TWIN, name="twin")
    result.twin_closings = told.n_closings
    return result


def main() -> None:
    parser = command_line(__doc__, "task")
    parser.set_defaults(task=NEW_TASKS[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS[:1], help="of the policies' training")
    parser.add_argument("--minutes", type=float, default=20.0, help="that the trainings were given")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=["act", "diffusion"])
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=CONDITIONS)
    options = parser.parse_args()
    names = [(s, c, n) for n in options.seeds for s in options.settings for c in options.conditions]
    for setting, condition, seed in names:
        variant = f"{setting}-{options.minutes:g}min"
        path = RESULTS / STUDY / f"{options.task}-{condition}-{variant}-seed{seed}.json"
        if not path.exists():
            continue
        result = OtherResult(**load(path))
        if not result.twin_closings:
            save(path, asdict(played_in_the_twin_world(result, variant)))
        closed, in_twin = (sum(n > 0 for n in counts) for counts in (result.n_closings, result.twin_closings))
        n = len(result.successes)
        print(
            f"{path.stem}: closes its hand in {closed} of {n} episodes with a touch, in {in_twin} without",
            flush=True,
        )


if __name__ == "__main__":
    main()
