"""What the study of corrections compares, and which of its options go together."""

from argparse import Namespace
from collections.abc import Sequence

_ASKING = ("--method.type=robot_gated", "--method.intervention_share=0.45")
"""The gates of the simulator take 21 to 50 % of the steps from policies of five demonstrations."""
METHODS: dict[str, tuple[str, ...]] = {
    "skip": (),
    "hg_dagger": ("--skip_s=0",),
    "no_handback": ("--method.type=no_handback",),
    "redo": ("--method.type=redo",),
    "robot_gated_no_handback": (*_ASKING, "--method.redo_failed=false"),
    "robot_gated_redo": _ASKING,
    "person": ("--expert.person=true",),
    "person_robot_gated": (*_ASKING, "--expert.person=true"),
}
"""`skip` is `playbyear-dagger` as it is by default, `hg_dagger` learns from whole corrections, as it was published."""
WEIGHING = ("hg_dagger", "redo")
"""Those that say what is learned from; the others say who acts, and what is kept."""
COURSES = {"own": {}, "paper": {"KeyBag-Easy-v1": 12}}
"""Attempts that are kept in other tasks before the task itself; the paper's order for the bag."""


def check(options: Namespace, training: Sequence[str]) -> None:
    """Looks at a command line of the study before any work is done.

    Args:
        options: Its own.
        training: What is passed on to trainings.

    Raises:
        ValueError: They do not go together.
    """
    for option in training:
        if not option.startswith("--policy.") or "=" not in option or option.startswith("--policy.path"):
            raise ValueError(
                f"{option} is not passed on, only --policy.NAME=VALUE are: those a checkpoint holds, and so the policies that "
                "learn from corrections have them, too."
            )
    if options.course != "own" and not options.task.startswith("KeyBag"):
        raise ValueError(f"--course={options.course} is for the bags, and not for --task={options.task}.")
    first, others = options.kept // options.rounds, {**COURSES[options.course], options.task: 0}
    if first <= max(others.values()):
        raise ValueError(
            f"--kept={options.kept} with --rounds={options.rounds} and --course={options.course}: {first} attempts in the "
            f"first round are too few; give more than {max(others.values())} a round."
        )
    if options.learn == "online" and options.grow:
        raise ValueError("--grow is for --learn=new_weights: online a policy learns more with every attempt anyway.")
    if options.learn == "online" and options.updates * options.rounds < options.kept:
        raise ValueError(f"--updates={options.updates}: give at least one for every attempt that is kept.")
