"""Manipulation tasks in which the target is hidden from every camera and only contact sound reveals it."""

import warnings

from gymnasium.envs import registration

from gym_playbyear import opengl  # noqa: F401  (first: whether MuJoCo can be imported)
from gym_playbyear.registry import Registry

__version__ = "0.1.0"

_OWN = {
    "OccludedGrasp-v1": "gym_playbyear.tasks.occluded:occluded_grasp",
    "OccludedPickPlace-v1": "gym_playbyear.tasks.occluded:occluded_pick_place",
    "TellApart-v1": "gym_playbyear.tasks.tell_apart:tell_apart",
    "KeyBag-Easy-v1": "gym_playbyear.tasks.key_bag:key_bag_easy",
    "KeyBag-Hard-v1": "gym_playbyear.tasks.key_bag:key_bag_hard",
}
TASKS = tuple(_OWN)
"""Our own."""

ALL_TASKS = Registry("tasks", _OWN)
"""Ours, and those that other distributions bring (`gym_playbyear.registry`)."""


def register_tasks() -> None:
    """Registers every task with Gymnasium as `gym_playbyear/<name>`. Importing this package does it; call it again when a
    distribution with tasks was installed since then."""
    for name in ALL_TASKS:
        if f"gym_playbyear/{name}" in registration.registry:
            continue
        try:
            registration.register(f"gym_playbyear/{name}", "gym_playbyear.environment:TaskEnv", kwargs={"task": name})
        except Exception as error:  # whatever another distribution calls its task: the others go on
            warnings.warn(f"Another distribution's task {name!r} is left out: {error}", stacklevel=2)


register_tasks()
