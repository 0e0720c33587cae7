"""Keys in a bag (paper, section "Real Robot Key Extraction Environment", table I and appendix A)."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from gym_playbyear.check.key_bag import GROPES, GropingScript
from gym_playbyear.experts.blind import BLIND_GROPES, BlindBag
from gym_playbyear.experts.key_bag import FINGERS, BagExpert, BagGate, TallThingsExpert
from gym_playbyear.panda import Panda, SensorNoise
from gym_playbyear.task import Camera, Task
from gym_playbyear.tasks.arena import TABLE, TABLE_TOP
from gym_playbyear.tasks.bag import (
    BAG_MIDDLE,
    BOTTOM_THICKNESS,
    CONTENTS,
    FRICTION,
    RIM,
    Torn,
    bag,
    contents_prop,
    drop,
    middle_of,
    set_bottom,
    walls_seen,
)
from gym_playbyear.terminations import ClosedUnheard, Groped, Pressed, Success

CAMERA = Camera("front", 'pos="0.75 0 1.16" xyaxes="0 1 0 -0.22 0 0.975" fovy="40"')
_OUT = RIM + 0.01  # m, world: what is in the middle of the bag and higher than this is seen
_HOLDS = 0.5  # N


_MAX_PRESS, _MAX_TEAR = 30.0, 12.0  # N: with which the hand may come down on the things, and push the bag
_CLOSINGS = 2  # the how-manieth closing on nothing ends the attempt
_HOLD_SECONDS = 0.4  # for so long the things have to be held in sight
_WORKSPACE = ((-0.06, -0.07, 0.803), (0.06, 0.07, 1.15))  # m, world
_SENSORS = SensorNoise(wander=0.0006)


@dataclass(frozen=True)
class Places:
    """Where the things may lie, which decides whether a bag can be emptied without hearing.

    sides: of the bag's middle, along the line on which the fingers open, on which they may be dropped, -1 or 1; sideways: how
    far from it, least and most [m]; around: and around that place, at most [m]; bottom: height of the bag's bottom above the
    table, least and most [m]. Of the expert, where it was measured to teach best: how far it goes aside from what it felt [m],
    and which share of the rest in a step.
    """

    sides: tuple[int, ...]
    sideways: tuple[float, float] = (0.02, 0.03)
    around: float = 0.004
    bottom: tuple[float, float] = (0.025, 0.10)
    aside: float = 0.027
    share: float = 0.5

    @property
    def middles(self) -> list[np.ndarray]:
        """Of the sides on which the things may lie, the middle of where they are dropped, (2,) each [m, world]."""
        return [BAG_MIDDLE + np.array([0.0, side * np.mean(self.sideways)]) for side in self.sides]

    def draw_place(self, rng: np.random.Generator) -> np.ndarray:
        """Where the things are dropped, (2,) [m, world]."""
        radius, angle = self.around * np.sqrt(rng.uniform()), rng.uniform(-np.pi, np.pi)
        sideways = rng.choice(self.sides) * rng.uniform(*self.sideways)
        return BAG_MIDDLE + np.array([radius * np.cos(angle), radius * np.sin(angle) + sideways])


EASY = Places(sides=(1,))
HARD = Places(sides=(-1, 1), sideways=(0.028, 0.038), aside=0.029, share=1.0)


def key_bag_easy(*, contents: str = "keys") -> Task:
    """
    ## Description
    An opaque bag stands on the table, and in it lies a ring with four metal things: a lever opener, a cap opener, a
    medallion and a whistle. The camera sees the arm and the bag's outside. The keys lie below the right finger, but how high
    they lie nobody sees: the bag's bottom rests on a springy heap of paper. The arm has to go down until it hears that it
    touches them, go around them, grasp them, and lift them out. After Du et al., "Play it by Ear" (RSS 2022), who did it with
    a real robot.

    ## Action Space
    `Box(-1, 1, (4,), float32)`: displacement of the end effector along x, y, z in units of 0.05 m per step, and the gripper
    (> 0 closes). The hand's orientation is fixed. 5 steps per second. After a change of the gripper command the next one is
    ignored for ten steps, as on the authors' robot. What lies beyond [-1, 1] is clipped.

    ## Observation Space
    A dictionary:
    - `pixels.front`: `(image_size, image_size, 3)` uint8, the camera in front of the bag. Its walls bend;
    - `agent_pos`: `(7,)` float32, end effector x, y, z [m, from the robot's base], two finger positions [m], two finger
      velocities [m/s], with the noise and resolution of a real arm's encoders, and an error of its place that wanders by
      0.6 mm;
    - `audio.<microphone>`: `(sample_rate / 5,)` int16, what the microphone heard during the last step (`sound="waveform"`):
      keys that knock on each other, the bag and the hand, the bag that crackles while it bends;
    - `contact_force`: `(6,)` float32, mean net contact force [N] and torque [Nm] on the keys (`sound="contact_force"`).

    ## Rewards
    1 at the step that solves the task, otherwise 0.

    ## Success Criteria
    The keys' centre of mass is more than 1 cm above the bag's rim, where the camera sees them, and the fingers hold them, for
    0.4 s. `info["is_success"]` says so at every step.

    ## Starting State
    The gripper is open above the bag, within 1 cm of the same point. The keys fell into the bag, 2 to 3 cm to the right of
    its middle, and up to 4 mm from there; its bottom is 2.5 to 10 cm above the table.
    `reset(options={"contents_position": (x, y), "bottom": height})` sets them.

    ## Episode Termination
    Terminated, and `info["end"]` says why: "success"; "pressed", when the hand came down on the keys with more than 30 N;
    "torn", when it pushed the bag with more than 12 N; "groped", when the fingers closed on nothing for the second time.
    Truncated, as "time", after `horizon` steps (75).

    ## Arguments
    - `contents="keys"`: or `"bottle"`, `"chips"`, `"pens"`, `"candies"`, `"cloth"` (nearly mute), `"sponge"` (nearly mute).
    - and those of `gym_playbyear.environment.TaskEnv`.
    """
    return _task("KeyBag-Easy-v1", EASY, contents, limits={"blind": 0.4})


def key_bag_hard(*, contents: str = "keys") -> Task:
    """
    As `KeyBag-Easy-v1` (`key_bag_easy`), except that the keys fell 2.8 to 3.8 cm to one side of the bag's middle or to the
    other: the arm has to hear which finger touches them. So there are two microphones,
    `microphones=("left_finger", "right_finger")`.
    """
    return _task("KeyBag-Hard-v1", HARD, contents, microphones=FINGERS)


def _task(name: str, places: Places, contents: str, **more: Any) -> Task:
    return Task(
        name=name,
        description="Find the keys in the bag by touch and sound, grasp them and lift them out.",
        arm=Panda(max_opening=0.074, grip_force=20.0, workspace=_WORKSPACE),
        arena=TABLE,
        props=(bag(), contents_prop(contents)),
        initialize_episode=_initialize_episode,
        reset_options=("bottom", "contents_position"),
        success=Success(_is_out, CONTENTS, _HOLD_SECONDS),
        terminations=(Pressed(CONTENTS, _MAX_PRESS, FRICTION), Torn(_MAX_TEAR), Groped(_CLOSINGS)),
        early_action=ClosedUnheard(CONTENTS),
        expert=BagExpert if contents in ("keys", "candies") else TallThingsExpert,
        gate=BagGate,
        blind={strategy: partial(BlindBag, strategy=strategy) for strategy in BLIND_GROPES},
        deaf={
            name: partial(GropingScript, grope=grope, bottom=places.bottom, sensors=_SENSORS, middles=places.middles)
            for name, grope in GROPES.items()
        },
        sees=walls_seen,
        horizon=75,
        control_hz=5,
        sample_rate=48000,
        cameras=(CAMERA,),
        start=(*BAG_MIDDLE, RIM + 0.07),
        start_spread=0.01,
        sensors=_SENSORS,
        force_proxy_of=CONTENTS,
        numbers=places,
        **more,
    )


def _initialize_episode(env: Any, options: dict[str, Any]) -> dict[str, Any]:
    """Sets the bag's bottom and drops the things into the bag."""
    places, rng = env.definition.numbers, env.np_random
    bottom, place = rng.uniform(*places.bottom), places.draw_place(rng)
    bottom, place = options.get("bottom", bottom), np.array(options.get("contents_position", place), dtype=float)
    set_bottom(env, bottom)
    drop(env, place, rng.uniform(-np.pi, np.pi), TABLE_TOP + bottom + BOTTOM_THICKNESS, rng)
    return {"bag_middle": BAG_MIDDLE}


def _is_out(env: Any) -> bool:
    return bool(middle_of(env)[2] > _OUT and env.contact_forces[f"gripper-{CONTENTS}"] > _HOLDS)
