"""All deaf scripts by name, and how they are played."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from gym_playbyear.adversaries.script import DeafScript
from gym_playbyear.adversaries.shoving import SHOVES, ShovingScript
from gym_playbyear.adversaries.tapping import TAPS, TappingScript
from gym_playbyear.adversaries.view import DeafTask, TaskFacts

ScriptMaker = Callable[[TaskFacts, np.random.Generator], DeafScript]

SCRIPTS: dict[str, ScriptMaker] = {
    **{name: partial(TappingScript, tap=tap) for name, tap in TAPS.items()},
    **{name: partial(ShovingScript, shove=shove) for name, shove in SHOVES.items()},
}
"""Each makes a script for one episode from the task's facts and a random generator."""

_SCRIPT_STREAM = 11  # tells a script's random numbers from the sensors' with the same seed


@dataclass(frozen=True)
class Outcome:
    """How an attempt ended.

    Attributes:
        success: Whether the task was solved.
        end: `success`, `time`, `failed`, or what the task calls it.
        n_steps: Steps of the attempt.
    """

    success: bool
    end: str
    n_steps: int


def play(task: DeafTask, make_script: ScriptMaker, seed: int, **options: Any) -> Outcome:
    """Plays one attempt of a deaf script.

    Args:
        task: The task as a deaf player meets it.
        make_script: One of `SCRIPTS`, or your own.
        seed: Of the episode.
        options: Of the environment's reset.
    """
    view = task.begin(seed, **options)
    script = make_script(task.facts, np.random.default_rng([seed, _SCRIPT_STREAM]))
    done = False
    while not done:
        view, done, info = task.advance(script.act(view))
    return Outcome(bool(info["is_success"]), str(info["end"]), view.step)
