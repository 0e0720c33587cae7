"""Tell Apart: screws or packing peanuts (paper, section "Can our Method Differentiate Between Object Sounds?")."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from gym_playbyear.arena import FRONT_CAMERA, TABLE, TABLE_TOP, on_table
from gym_playbyear.arm import ArmConfig
from gym_playbyear.haste import MovedUnheard
from gym_playbyear.options import check_option
from gym_playbyear.pouch import CONTENTS, HALF_SIZE, PIECES, POUCH, pieces, pouch, put_pouch
from gym_playbyear.proprioception import SensorNoise
from gym_playbyear.rules import Rule, Solved
from gym_playbyear.task import Task
from gym_playbyear.tell_apart_scripts import BLIND_STRATEGIES, BlindPouch, PouchExpert

SCREWS, PEANUTS = CONTENTS
_DOWN = 0.012  # m: a pouch that lies, on whichever side, is no higher than this above one that stands
_STILL = 0.015  # m: how far a pouch that is held still, or lies still, may move meanwhile
_OPEN = 0.9  # share of the opening


@dataclass(frozen=True)
class Numbers:
    """The task's numbers.

    pouch_x, pouch_y: ranges of its place [m]; pouch_yaw: largest yaw, either way [rad]; lifted: so high is lifted [m];
    dropped: from so much below the hand it was let go, not set down [m]; away: a hand that leaves it is so far from it [m];
    hold_s, leave_s: for how long [s]; arm, sensors: their numbers.
    """

    pouch_x: tuple[float, float] = (-0.03, 0.03)
    pouch_y: tuple[float, float] = (-0.08, 0.08)
    pouch_yaw: float = 0.15
    lifted: float = 0.03
    dropped: float = 0.02
    away: float = 0.12
    hold_s: float = 0.5
    leave_s: float = 2.0
    arm: ArmConfig = field(default_factory=lambda: ArmConfig(max_opening=0.056))
    sensors: SensorNoise = field(default_factory=SensorNoise)


NUMBERS = Numbers()


def tell_apart(*, contents: str | None = None) -> Task:
    """
    ## Description
    A closed pouch stands on the table. There are screws in it, or packing peanuts; it weighs the same, looks the same and
    moves the same, and only its rattle tells which. The arm has to grasp it, lift it, drop it and listen. With screws in it, it
    lifts the pouch again and holds it in the air; with peanuts it leaves the pouch where it is. After Du et al., "Play it by
    Ear" (RSS 2022), section IV-D.

    ## Action Space
    `Box(-1, 1, (4,), float32)`: displacement of the end effector along x, y, z in units of 0.05 m per step, and the gripper
    (> 0 closes). The hand's orientation is fixed. 5 steps per second, as on the authors' robot. After a change of the gripper
    command the next one is ignored for 2 s, as there.

    ## Observation Space
    A dictionary:
    - `pixels.front`: `(image_size, image_size, 3)` uint8, the camera in front of the table;
    - `agent_pos`: `(7,)` float32, end effector x, y, z [m, from the robot's base], two finger positions [m], two finger
      velocities [m/s], with the noise and resolution of a real arm's encoders;
    - `audio.<microphone>`: `(sample_rate / 5,)` int16, what the microphone heard during the last step (`sound="waveform"`).
    With `sound="none"` every observation is the same for screws and for peanuts, byte for byte; `sound="contact_force"` has
    only zeros here, since no force differs.

    ## Rewards
    1 at the step that solves the task, otherwise 0.

    ## Success Criteria
    First the pouch is lifted more than 3 cm and dropped: let go at least 2 cm above where it comes to lie. Then, screws: it
    is more than 3 cm up again for half a second, and moves less than 1.5 cm meanwhile. Peanuts: for 2 s it lies still, and the
    open hand is more than 12 cm away from it. `info["is_success"]` says so at every step.

    ## Starting State
    The gripper is open at the right of the table, within 2 cm of the same point. The pouch stands near the middle; its place
    and yaw are random, and so is what is in it, both equally likely.
    `reset(options={"contents": "screws", "pouch_position": (x, y), "pouch_yaw": yaw})` sets them.

    ## Episode Termination
    Terminated, and `info["end"]` says why: "success", or "wrong": peanuts were lifted again after the drop, or screws were left
    for as long as peanuts have to be. Truncated, as "time", after `horizon` steps (100). `info["contents"]` at the last step
    says what was in the pouch.

    ## Arguments
    - `contents=None`: what is in the pouch, `"screws"` or `"peanuts"`; None draws it for each episode.
    - `image_size=84`: pixels of the square picture.
    - `sample_rate=16000`: samples per second; a multiple of 5.
    - `sound="waveform"`: or `"contact_force"`, or `"none"`.
    - `noise_level=1.0`: scales background noise and motor hum.
    - `microphones=("gripper",)`: names of the microphones that are on.
    - `horizon=None`: steps of an episode; None is the task's.
    - `hidden_object=True`: False makes what is in the pouch invisible, which nobody can see.
    - `render_mode=None`: or `"rgb_array"`, `"human"`; `render_size=480`: pixels of the picture that `render()` returns.

    ## Version History
    - v1: first version.
    """
    if contents is not None:
        check_option("contents", contents, CONTENTS)
    course = Course()
    return Task(
        name="TellApart-v1",
        description="Lift the pouch, drop it and listen: lift it again if screws are in it, leave it if peanuts are.",
        arm=NUMBERS.arm,
        arena=TABLE,
        props=(pouch(), *pieces()),
        place=partial(_place, contents=contents),
        success=ToldApart(course),
        ends=(ToldWrong(course),),
        haste=MovedUnheard(POUCH, is_lifted, has_landed),
        expert=PouchExpert,
        blind={name: partial(BlindPouch, strategy=name) for name in BLIND_STRATEGIES},
        sees=_pouch_seen,
        twins=({"contents": SCREWS}, {"contents": PEANUTS}),
        control_hz=5,
        horizon=100,
        cameras=(FRONT_CAMERA,),
        start=(-0.05, -0.22, 0.96),
        sensors=NUMBERS.sensors,
        numbers=NUMBERS,
        limits={"blind": 0.55},
    )


def _place(env: Any, options: dict[str, Any], *, contents: str | None) -> dict[str, Any]:
    numbers: Numbers = env.variant
    x, y = (env.np_random.uniform(*limits) for limits in (numbers.pouch_x, numbers.pouch_y))
    yaw = env.np_random.uniform(-numbers.pouch_yaw, numbers.pouch_yaw)
    # Drawn last, and always: all else is the same whatever is in the pouch, and whoever decides it.
    drawn = CONTENTS[env.np_random.integers(len(CONTENTS))]
    chosen = options.get("contents", contents or drawn)
    check_option("contents", chosen, CONTENTS)
    x, y = on_table("pouch_position", options.get("pouch_position", (x, y)))
    put_pouch(env, x, y, options.get("pouch_yaw", yaw))
    env.secrets["contents"] = chosen
    env.materials |= dict.fromkeys(PIECES, chosen)
    return {"pouch_place": (x, y)}


def _pouch_seen(env: Any) -> dict[str, Any]:
    """Where the pouch is and how it lies: (3,) [m, world], and a quaternion (4,)."""
    return {"pouch_now": env.pouch_position, "pouch_turn": env.data.body(POUCH).xquat.copy()}


def is_lifted(env: Any) -> bool:
    """Whether the pouch is up in the air."""
    return _height(env) > env.variant.lifted


def is_left(env: Any) -> bool:
    """Whether the pouch lies on the table and the open hand is away from it."""
    is_open = env.finger_positions.sum() > _OPEN * env.variant.arm.max_opening
    distance = np.linalg.norm(env.eef_position - env.pouch_position)
    return bool(has_landed(env) and is_open and distance > env.variant.away)


def has_landed(env: Any) -> bool:
    """Whether the pouch lies on the table, or stands there."""
    return _height(env) < _DOWN


def _height(env: Any) -> float:
    """Of the pouch, above where it stands [m]."""
    return float(env.pouch_position[2] - TABLE_TOP - HALF_SIZE[2])


class Course:
    """What was done with the pouch in an episode, for both rules.

    Attributes:
        was_dropped: It was lifted and dropped: what follows is the answer.
        answer: What the hand took it for, once it has lifted or left it for long enough.
    """

    def begin(self, env: Any) -> None:
        numbers: Numbers = env.variant
        self._answers = {
            SCREWS: Solved(is_lifted, POUCH, numbers.hold_s, _STILL),
            PEANUTS: Solved(is_left, POUCH, numbers.leave_s, _STILL),
        }
        for rule in self._answers.values():
            rule.begin(env)
        self._was_lifted = self.was_dropped = False
        self.answer: str | None = None

    def look(self, env: Any) -> None:
        """Once after every control step."""
        if self.was_dropped:
            self.answer = next((contents for contents, rule in self._answers.items() if rule.applies(env)), None)
        elif is_lifted(env):
            self._was_lifted = True
        elif self._was_lifted and has_landed(env):
            self.was_dropped = bool(env.eef_position[2] - env.pouch_position[2] > env.variant.dropped)
            self._was_lifted = False  # what was set down has to be lifted once more


class ToldApart(Solved):
    """The pouch was lifted and dropped, and then treated as its contents ask for.

    Args:
        course: Of the episode; this rule looks, the other one only asks.
    """

    def __init__(self, course: Course):
        super().__init__(_is_as_its_contents_ask)
        self.course = course

    def begin(self, env: Any) -> None:
        super().begin(env)
        self.course.begin(env)

    def applies(self, env: Any) -> bool:
        self.course.look(env)
        return self.course.answer == env.contents


class ToldWrong(Rule):
    """Peanuts were lifted again after the drop, or screws left."""

    name = "wrong"

    def __init__(self, course: Course):
        self.course = course

    def applies(self, env: Any) -> bool:
        lifts_peanuts = self.course.was_dropped and env.contents == PEANUTS and is_lifted(env)
        return lifts_peanuts or self.course.answer not in (None, env.contents)


def _is_as_its_contents_ask(env: Any) -> bool:
    return is_lifted(env) if env.contents == SCREWS else is_left(env)
