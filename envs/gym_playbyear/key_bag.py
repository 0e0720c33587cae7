"""Keys in a bag (paper, section "Real Robot Key Extraction Environment")."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from gym_playbyear.arena import TABLE
from gym_playbyear.arm import FINGER_FRICTION, ArmConfig
from gym_playbyear.bag import BAG, BOTTOM_THICKNESS, RIM, Torn, bag, set_bottom
from gym_playbyear.bag_contents import CONTENTS, contents_prop, drop, middle_of
from gym_playbyear.bag_experts import STRATEGIES, BagExpert, BlindBag
from gym_playbyear.bag_gate import BagGate
from gym_playbyear.proprioception import SensorNoise
from gym_playbyear.rules import Groped, Pressed, Solved
from gym_playbyear.task import Camera, Task

CAMERA = Camera("front", 'pos="0.75 0 1.16" xyaxes="0 1 0 -0.22 0 0.975" fovy="40"')
_VISIBLE = RIM + 0.01


@dataclass(frozen=True)
class BagNumbers:
    offset: tuple[float, float]
    bottom: tuple[float, float]
    horizon: int = 75
    max_press: float = 25.0
    max_tear: float = 11.0
    closings: int = 2
    hold_s: float = 0.4
    arm: ArmConfig = field(
        default_factory=lambda: ArmConfig(
            max_opening=0.07, grip_force=20.0, workspace=((-0.06, -0.07, 0.803), (0.06, 0.07, 1.15))
        )
    )
    sensors: SensorNoise = field(default_factory=SensorNoise)


EASY = BagNumbers(offset=(0.0, 0.008), bottom=(0.025, 0.10))
HARD = BagNumbers(offset=(0.01, 0.03), bottom=(0.025, 0.065))


def key_bag_easy(*, contents: str = "keys") -> Task:
    return _task("KeyBag-Easy-v1", EASY, contents)


def key_bag_hard(*, contents: str = "keys") -> Task:
    return _task("KeyBag-Hard-v1", HARD, contents)


def _task(name: str, numbers: BagNumbers, contents: str, **scripts: Any) -> Task:
    return Task(
        name=name,
        description="Find the keys in the bag by touch and sound, grasp them and lift them out.",
        arm=numbers.arm,
        arena=TABLE,
        props=(bag(), contents_prop(contents)),
        place=_place,
        success=Solved(_is_out, CONTENTS, numbers.hold_s),
        ends=(
            Pressed(CONTENTS, numbers.max_press, FINGER_FRICTION),
            Torn(numbers.max_tear),
            Groped(numbers.closings),
        ),
        expert=BagExpert,
        gate=BagGate,
        blind={strategy: partial(BlindBag, strategy=strategy) for strategy in STRATEGIES},
        horizon=numbers.horizon,
        control_hz=5,
        sample_rate=48000,
        cameras=(CAMERA,),
        start=(0.0, 0.0, RIM + 0.05),
        start_spread=0.01,
        sensors=numbers.sensors,
        felt=CONTENTS,
        numbers=numbers,
    )


def _place(env: Any, options: dict[str, Any]) -> dict[str, Any]:
    numbers = env.variant
    rng = env.np_random
    height = options.get("bottom", rng.uniform(*numbers.bottom))
    set_bottom(env, height)
    radius, angle = np.sqrt(rng.uniform(*np.square(numbers.offset))), rng.uniform(-np.pi, np.pi)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    height = env.model.body(BAG).pos[2] + height + BOTTOM_THICKNESS
    drop(env, np.array([x, y]), rng.uniform(-np.pi, np.pi), height, rng)
    return {}


def _is_out(env: Any) -> bool:
    return bool(middle_of(env)[2] > _VISIBLE and env.contact_forces[f"gripper-{CONTENTS}"] > 0.5)
