"""A task of your own: behind the wall stands a tin. Sweep along until you hear that you touch it, and stop there.

    pip install ./examples/own_task
    playbyear-record --env.type=playbyear --env.task=StopAtTheTin-v1 --dataset.repo_id=me/tin --dataset.num_episodes=50
    lerobot-eval --env.type=playbyear --env.task=StopAtTheTin-v1 --policy.path=...

`pyproject.toml` names task, material and a microphone, which other tasks can use too, as entry points; nothing else has to know
of them.
"""

import numpy as np

from gym_playbyear.panda import ACTION_SCALE, FINGER_FRICTION, Panda
from gym_playbyear.sound.materials import TINPLATE, cup, ringing
from gym_playbyear.sound.microphones import Microphone
from gym_playbyear.task import Prop, Task
from gym_playbyear.tasks.arena import FRONT_CAMERA, TABLE, TABLE_TOP, WALL_COLOUR, box
from gym_playbyear.terminations import Pressed, Shoved, Success

RADIUS, HALF_HEIGHT = 0.025, 0.025  # m
TIN_CAN = ringing(TINPLATE, cup(TINPLATE, RADIUS, 0.0003, (2, 3, 4, 5)), support=30.0)
BASE = Microphone(
    {"table": 0.7, "link1": 1.0}, hum=3.0, place=(-0.5, 0.0, 0.8)
)  # at the arm's foot: --env.microphones='[gripper, base]'
RANGE = (-0.1, 0.25)  # m: where along the wall it may stand
SWEEP_HEIGHT, NEAR = 0.03, 0.01  # m
TIN = Prop(
    "tin",
    f"""<body name="tin"><freejoint name="tin"/>
    <geom type="cylinder" size="{RADIUS} {HALF_HEIGHT}" density="900" friction="0.4" rgba="0.8 0.8 0.85 1"/></body>""",
    material="tin_can",
    loose=True,
    hidden=True,
)


def stop_at_the_tin() -> Task:
    return Task(
        name="StopAtTheTin-v1",
        description="Find the tin behind the wall by sound, and stop there.",
        arm=Panda(),
        arena=TABLE,
        props=(box("wall", (0.02, 0.4, 0.3), (0.2, 0.0, 0.775), WALL_COLOUR, material="wall"), TIN),
        cameras=(FRONT_CAMERA,),
        initialize_episode=place,
        success=Success(is_near, "tin", seconds=1.0, tolerance=0.003),
        terminations=(Shoved("tin", distance=0.03), Pressed("tin", 5.0, FINGER_FRICTION)),
        expert=Expert,
        blind={"middle": StopInTheMiddle},
        horizon=80,  # longer, a hand that creeps along without stopping passes for one that stopped
        start=(0.0, -0.25, 0.9),
    )


def place(env, options) -> dict:
    """Stands the tin somewhere in its range; what the camera shows of the episode is that range."""
    env.set_pose("tin", (0.0, env.np_random.uniform(*RANGE), TABLE_TOP + HALF_HEIGHT))
    return {"hidden_range": RANGE}


def gap(env, y: float) -> float:
    """Between the finger and a tin whose middle is at y [m]."""
    return y - env.eef_position[1] - env.definition.arm.max_opening / 2 - 0.01 - RADIUS


def is_near(env) -> bool:
    return env.eef_position[2] < TABLE_TOP + 2 * HALF_HEIGHT and abs(gap(env, env.position("tin")[1])) < NEAR


class Expert:
    """Comes down beside the range, sweeps, and stops when it feels the tin."""

    def __init__(self, env):
        self.env, self.phase = env, "lower"

    def act(self) -> np.ndarray:
        x, _, z = self.env.eef_position
        back = np.array([-x, 0.0, TABLE_TOP + SWEEP_HEIGHT - z])
        if self.phase == "lower" and abs(back[2]) < 0.005:
            self.phase = "sweep"
        if self.is_there():
            self.phase = "stop"
        move = np.clip(0.5 * back, -0.02, 0.02) + np.array([0, 0.008 if self.phase == "sweep" else 0, 0])
        if self.phase != "stop":
            move += self.env.expert_rng.uniform(-0.002, 0.002, 3)
        return np.append(move / ACTION_SCALE, -1.0).astype(np.float32)

    def is_there(self) -> bool:
        return self.env.contact_forces["gripper-tin"] > 0.1


class StopInTheMiddle(Expert):
    """Blind: sweeps like the expert, and stops where a tin in the middle of the range would be."""

    def is_there(self) -> bool:
        return gap(self.env, np.mean(RANGE)) < 0
