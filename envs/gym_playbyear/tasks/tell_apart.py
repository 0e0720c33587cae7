"""Tell Apart: screws or packing peanuts (paper, section "Can our Method Differentiate Between Object Sounds?")."""

from functools import partial
from typing import Any

import numpy as np

from gym_playbyear.experts.blind import BLIND_ANSWERS, BlindPouch
from gym_playbyear.experts.tell_apart import PouchExpert
from gym_playbyear.panda import Panda
from gym_playbyear.registry import check_option
from gym_playbyear.task import Prop, Task
from gym_playbyear.tasks.arena import FRONT_CAMERA, TABLE, TABLE_TOP, on_table
from gym_playbyear.terminations import MovedUnheard, Success, Termination
from gym_playbyear.visuals import soft_pouch

POUCH = "pouch"
HALF_SIZE = (0.024, 0.018, 0.025)  # m
CONTENTS = ("screws", "peanuts")
N_PIECES = 3
PIECES = tuple(f"piece{number}" for number in range(N_PIECES))
_WALL = 0.004  # m, thickness: more than a piece covers in a physics step
_POUCH_MASS, _PIECE_MASS = 0.04, 0.015  # kg
_PIECE_RADIUS, _PIECE_HALF_LENGTH = 0.0045, 0.007  # m
_COLOUR, _SEAM = "0.15 0.35 0.65 1", "0.9 0.9 0.85 1"
_BOUNCE = 'priority="1" solref="0.02 0.25"'  # a piece comes back from the wall with two fifths of its speed


def pouch() -> Prop:
    """The closed pouch: stiff walls, a light seam on top."""
    walls = ""
    for axis in range(3):
        for sign in (1, -1):
            position, size = np.zeros(3), np.array(HALF_SIZE)
            position[axis], size[axis] = sign * (HALF_SIZE[axis] - _WALL / 2), _WALL / 2
            walls += f"""<geom type="box" size="{_numbers(size)}" pos="{_numbers(position)}" mass="{_POUCH_MASS / 6}"
                friction="1 0.01 0.0005" condim="4" rgba="{_COLOUR}"/>"""
    seam = f"{HALF_SIZE[0]} 0.003 0.002"
    return Prop(
        POUCH,
        f"""<body name="{POUCH}"><freejoint name="{POUCH}"/>{walls}
        <geom type="box" size="{seam}" pos="0 0 {HALF_SIZE[2]}" mass="0" contype="0" conaffinity="0" rgba="{_SEAM}"/>
        </body>""",
        material=POUCH,
        loose=True,
        visuals=soft_pouch,
    )


def pieces() -> tuple[Prop, ...]:
    """The pieces in it. They are the same whatever they are made of: only their sound differs."""
    half = _PIECE_HALF_LENGTH
    return tuple(
        Prop(
            name,
            f"""<body name="{name}"><freejoint name="{name}"/>
            <geom type="capsule" fromto="{-half} 0 0 {half} 0 0" size="{_PIECE_RADIUS}" mass="{_PIECE_MASS}"
                condim="6" friction="0.3 0.005 0.001" {_BOUNCE} rgba="0.5 0.5 0.5 1"/></body>""",
            material=CONTENTS[0],
            loose=True,
            loudness=60.0,
            hidden=True,
            inside=POUCH,
        )
        for name in PIECES
    )


def put_pouch(env: Any, x: float, y: float, yaw: float) -> None:
    """Stands the pouch on the table, with its pieces in it: two beside each other, one on top."""
    middle = np.array([x, y, TABLE_TOP + HALF_SIZE[2]])
    env.set_pose(POUCH, middle, yaw)
    across = np.array([-np.sin(yaw), np.cos(yaw), 0])
    for number, name in enumerate(PIECES):
        side, layer = (-1, 1)[number % 2], number // 2
        env.set_pose(name, middle + 0.006 * side * across + [0, 0, -0.015 + 0.012 * layer], yaw)


def _numbers(vector) -> str:
    return " ".join(f"{number:.6g}" for number in vector)


SCREWS, PEANUTS = CONTENTS
_DOWN = 0.012  # m: a pouch that lies, on whichever side, is no higher than this above one that stands
_STILL = 0.015  # m: how far a pouch that is held still, or lies still, may move meanwhile
_OPEN = 0.9  # share of the opening


_POUCH_X, _POUCH_Y, _POUCH_YAW = (-0.03, 0.03), (-0.08, 0.08), 0.15  # m, m, rad: of its place, and either way
_LIFTED = 0.03  # m: so high is lifted
_DROPPED = 0.02  # m: from so much below the hand it was let go, not set down
AWAY = 0.12  # m: a hand that leaves it is so far from it
_HOLD_SECONDS, _LEAVE_SECONDS = 0.5, 2.0


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
    command the next one is ignored for 2 s, as there. What lies beyond [-1, 1] is clipped.

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
    - and those of `gym_playbyear.environment.TaskEnv`.
    """
    if contents is not None:
        check_option("contents", contents, CONTENTS)
    course = Course()
    return Task(
        name="TellApart-v1",
        description="Lift the pouch, drop it and listen: lift it again if screws are in it, leave it if peanuts are.",
        arm=Panda(max_opening=0.056),
        arena=TABLE,
        props=(pouch(), *pieces()),
        initialize_episode=partial(_initialize_episode, contents=contents),
        reset_options=("contents", "pouch_position", "pouch_yaw"),
        success=ToldApart(course),
        terminations=(ToldWrong(course),),
        early_action=MovedUnheard(POUCH, is_lifted, has_landed),
        expert=PouchExpert,
        blind={name: partial(BlindPouch, strategy=name) for name in BLIND_ANSWERS},
        sees=_pouch_seen,
        twins=({"contents": SCREWS}, {"contents": PEANUTS}),
        control_hz=5,
        horizon=100,
        cameras=(FRONT_CAMERA,),
        start=(-0.05, -0.22, 0.96),
        limits={"blind": 0.55},
    )


def _initialize_episode(env: Any, options: dict[str, Any], *, contents: str | None) -> dict[str, Any]:
    x, y = (env.np_random.uniform(*limits) for limits in (_POUCH_X, _POUCH_Y))
    yaw = env.np_random.uniform(-_POUCH_YAW, _POUCH_YAW)
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
    return {"pouch_now": env.position(POUCH), "pouch_turn": env.data.body(POUCH).xquat.copy()}


def is_lifted(env: Any) -> bool:
    """Whether the pouch is up in the air."""
    return _height(env) > _LIFTED


def is_left(env: Any) -> bool:
    """Whether the pouch lies on the table and the open hand is away from it."""
    is_open = env.finger_positions.sum() > _OPEN * env.definition.arm.max_opening
    distance = np.linalg.norm(env.eef_position - env.position(POUCH))
    return bool(has_landed(env) and is_open and distance > AWAY)


def has_landed(env: Any) -> bool:
    """Whether the pouch lies on the table, or stands there."""
    return _height(env) < _DOWN


def _height(env: Any) -> float:
    """Of the pouch, above where it stands [m]."""
    return float(env.position(POUCH)[2] - TABLE_TOP - HALF_SIZE[2])


class Course:
    """What was done with the pouch in an episode, for both rules.

    Attributes:
        was_dropped: It was lifted and dropped: what follows is the answer.
        answer: What the hand took it for, once it has lifted or left it for long enough.
    """

    def begin(self, env: Any) -> None:
        self._answers = {
            SCREWS: Success(is_lifted, POUCH, _HOLD_SECONDS, _STILL),
            PEANUTS: Success(is_left, POUCH, _LEAVE_SECONDS, _STILL),
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
            self.was_dropped = bool(env.eef_position[2] - env.position(POUCH)[2] > _DROPPED)
            self._was_lifted = False  # what was set down has to be lifted once more


class ToldApart(Success):
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
        return self.course.answer == env.secrets["contents"]


class ToldWrong(Termination):
    """Peanuts were lifted again after the drop, or screws left."""

    name = "wrong"

    def __init__(self, course: Course):
        self.course = course

    def applies(self, env: Any) -> bool:
        lifts_peanuts = self.course.was_dropped and env.secrets["contents"] == PEANUTS and is_lifted(env)
        return lifts_peanuts or self.course.answer not in (None, env.secrets["contents"])


def _is_as_its_contents_ask(env: Any) -> bool:
    return is_lifted(env) if env.secrets["contents"] == SCREWS else is_left(env)
