"""Everyone who plays a task to find out whether it needs hearing: its expert, its blind scripts, all deaf scripts."""

from typing import Any

from gym_playbyear.adversaries.scripts import SCRIPTS, Outcome, ScriptMaker, play
from gym_playbyear.adversaries.view import DeafTask, camera_numbers
from gym_playbyear.task import Task

EXPERT = "expert"
KINDS = (EXPERT, "blind", "deaf")


def players(task: str | Task, **options: Any) -> dict[str, str]:
    """The names of a task's players, each with its kind.

    Args:
        task: Its name, such as `OccludedGrasp-v1`, or the task.
        options: Of `TaskEnv`.
    """
    deaf_task = DeafTask(task, **options)
    deaf_task.begin(0)
    blind, deaf = list(deaf_task.env.blind_baselines()), list(deaf_scripts(deaf_task))
    deaf_task.close()
    return {EXPERT: EXPERT, **dict.fromkeys(blind, "blind"), **dict.fromkeys(deaf, "deaf")}


def deaf_scripts(deaf_task: DeafTask) -> dict[str, ScriptMaker]:
    """The deaf scripts that know how to play a task, after its episode began.

    A task brings its own (`Task.deaf`). Those that are for all look for an object on a line.
    """
    own = dict(deaf_task.env.deaf_scripts())
    return own or (SCRIPTS if "hidden_range" in camera_numbers(deaf_task.env) else {})


def promised_limits(task: str | Task, **options: Any) -> dict[str, float]:
    """The limits that a task sets for itself (`check_limits` of its environment), by name."""
    deaf_task = DeafTask(task, **options)
    limits = dict(getattr(deaf_task.env, "check_limits", {}))
    deaf_task.close()
    return limits


def outcomes(task: str | Task, name: str, seeds: range, options: dict[str, Any] | None = None) -> list[Outcome]:
    """How a player's attempts end, one for each seed.

    Args:
        task: Its name, or the task.
        name: Of the player.
        seeds: Of the episodes.
        options: Of `TaskEnv`.
    """
    deaf_task = DeafTask(task, **(options or {}))
    deaf_task.begin(seeds[0])
    scripts = deaf_scripts(deaf_task)
    if name in scripts:
        found = [play(deaf_task, scripts[name], seed) for seed in seeds]
    else:
        found = [_play_behind_the_scenes(deaf_task, name, seed) for seed in seeds]
    deaf_task.close()
    return found


def _play_behind_the_scenes(deaf_task: DeafTask, name: str, seed: int) -> Outcome:
    """An attempt of a script that looks at the environment: the expert, or a blind one."""
    view = deaf_task.begin(seed)
    env = deaf_task.env
    script = env.scripted_expert() if name == EXPERT else env.blind_baselines()[name]
    done = False
    while not done:
        view, done, info = deaf_task.advance(script.act())
    return Outcome(bool(info["is_success"]), str(info["end"]), view.step)
