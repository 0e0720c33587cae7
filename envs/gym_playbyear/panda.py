"""A Franka Emika Panda from primitive shapes: its Cartesian position control, and what it measures of itself.

Kinematics and joint limits are the manufacturer's (Franka Control Interface documentation), link inertias those identified
by Gaz et al., "Dynamic Identification of the Franka Emika Panda Robot with Retrieval of Feasible Parameters" (RA-L 2019).
Shapes are boxes and capsules: at 84 pixels meshes add nothing and cost tens of milliseconds a frame.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

N_JOINTS = 7
PHYSICS_TIMESTEP = 0.002  # s
ACTION_SCALE = 0.05  # m of displacement per unit of action and step (the authors' code)

# Distance from the hand's frame to the point between the fingertips (Franka's own tool centre point).
_TCP_OFFSET = 0.1034  # m; the tips end at 0.112
TIP_BELOW_HAND = 0.0086  # m: how far the fingers' tips are below that point, which is controlled
FINGER_THICKNESS = 0.01  # m, along the opening
FINGER_WIDTH = 0.02  # m
FINGER_FRICTION = 0.3  # bare steel: the rough cube tips over a pushing finger instead of jamming against it

HOME_JOINTS = np.array([0.0, -0.25, 0.0, -2.55, 0.0, 2.30, np.pi / 4])  # rad, elbow up, hand pointing down
_SERVO_STIFFNESS = (20000, 20000, 20000, 20000, 8000, 8000, 8000)  # Nm/rad
_SERVO_DAMPING = (400, 400, 400, 400, 100, 100, 100)  # Nms/rad
# What a servo may add to gravity compensation before the arm gives way: the collision thresholds of the real arm, not its
# strength, so that a finger that comes down on the cube stays there and does not force its way past.
_TORQUE_LIMITS = (30, 40, 25, 25, 10, 10, 10)  # Nm
_FINGER_STIFFNESS = 40000  # N/m: a spindle drive does not give way
_FINGER_DAMPING = 400  # Ns/m
_FINGER_SPEED = 0.05  # m/s per finger, the real hand's maximum


@dataclass(frozen=True)
class Panda:
    """The arm with its hand; its joints, then its fingers, come first in the model. What is ours to tune about it:

    base: position of the robot's base in the world [m].
    max_opening: distance between the fingers' inner faces when open [m]; the real hand opens 0.08.
    grip_force: largest force of a finger [N].
    gripper_cooldown: seconds for which a change of the gripper command blocks the next one (the paper's appendix: 2 s).
    workspace: lower and upper corner of the box that the commanded tool centre point stays in, world frame [m].
    max_lead: how far the commanded point may run ahead of the measured one [m]; bounds the force on an obstacle.
    touching: the parts of the hand whose contacts with loose things are measured, one by one.
    """

    n_joints: ClassVar[int] = N_JOINTS
    root: ClassVar[str] = "link5"  # from here on outward a contact is the gripper's
    tool: ClassVar[str] = "tcp"
    links: ClassVar[Mapping[str, str]] = {
        "gripper": "hand",
        "left_finger": "left_finger",
        "right_finger": "right_finger",
    }

    base: tuple[float, float, float] = (-0.5, 0.0, 0.80)
    max_opening: float = 0.054
    grip_force: float = 40.0
    gripper_cooldown: float = 2.0
    workspace: tuple[tuple[float, float, float], tuple[float, float, float]] = (
        (-0.25, -0.39, 0.803),
        (0.155, 0.40, 1.15),
    )
    max_lead: float = 0.06
    touching: tuple[str, ...] = ("left_finger", "right_finger", "hand")

    def spec(self) -> mujoco.MjSpec:
        """The arm alone, with its servos."""
        return mujoco.MjSpec.from_string(f"""
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default>
    <default class="robot"><geom contype="1" conaffinity="0" rgba="0.92 0.92 0.92 1" mass="0"/></default>
  </default>
  <worldbody>{_bodies(self)}</worldbody>{_drives(self)}
</mujoco>""")

    def controller(self, control_hz: int, physics_dt: float) -> "CartesianController":
        """What moves it, for so many control steps per second and physics steps of so many seconds."""
        return CartesianController(self, control_hz, physics_dt)


_R = 2**-0.5
_LINKS = (  # of each: name, position, quaternion (w x y z), joint range; mass, its centre, full inertia; capsule's ends, radius
    (
        ("link1", (0, 0, 0.333), (1, 0, 0, 0), (-2.8973, 2.8973)),
        (4.970684, (0.003875, 0.002081, -0.04762), (0.70337, 0.70661, 0.0091170, -0.00013900, 0.0067720, 0.019169)),
        ((0, 0, -0.20), (0, 0, -0.02), 0.06),
    ),
    (
        ("link2", (0, 0, 0), (_R, -_R, 0, 0), (-1.7628, 1.7628)),
        (0.646926, (-0.003141, -0.02872, 0.003495), (0.0079620, 0.028110, 0.025995, -0.003925, 0.010254, 0.000704)),
        ((0, 0, -0.06), (0, 0, 0.06), 0.06),
    ),
    (
        ("link3", (0, -0.316, 0), (_R, _R, 0, 0), (-2.8973, 2.8973)),
        (3.228604, (0.027518, 0.039252, -0.066502), (0.037242, 0.036155, 0.010830, -0.004761, -0.011396, -0.012805)),
        ((0, 0, -0.25), (0, 0, -0.05), 0.055),
    ),
    (
        ("link4", (0.0825, 0, 0), (_R, _R, 0, 0), (-3.0718, -0.0698)),
        (3.587895, (-0.05317, 0.104419, 0.027454), (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),
        ((0, 0, -0.05), (0, 0, 0.05), 0.055),
    ),
    (
        ("link5", (-0.0825, 0.384, 0), (_R, -_R, 0, 0), (-2.8973, 2.8973)),
        (1.225946, (-0.011953, 0.041065, -0.038437), (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229)),
        ((0, 0.02, -0.28), (0, 0.03, -0.06), 0.05),
    ),
    (
        ("link6", (0, 0, 0), (_R, _R, 0, 0), (-0.0175, 3.7525)),
        (1.666555, (0.060149, -0.014117, -0.010517), (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341)),
        ((0, 0, -0.03), (0.06, 0, 0.0), 0.05),
    ),
    (
        ("link7", (0.088, 0, 0), (_R, _R, 0, 0), (-2.8973, 2.8973)),
        (0.735522, (0.010517, -0.004252, 0.061597), (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741)),
        ((0, 0, 0.0), (0, 0, 0.08), 0.045),
    ),
)


def _vector(values) -> str:
    return " ".join(f"{value:.8g}" for value in values)


def _hand_xml(max_opening: float) -> str:
    tip_half, finger_z = 0.0536 / 2, 0.0584
    fingers = ""
    for side, sign in (("left", 1), ("right", -1)):
        fingers += f"""
        <body name="{side}_finger" gravcomp="1" pos="0 0 {finger_z}">
          <joint name="{side}_finger" type="slide" axis="0 {sign} 0" range="0 {max_opening / 2}" armature="0.1" damping="5"/>
          <inertial pos="0 {sign * FINGER_THICKNESS / 2} {tip_half}" mass="0.015" diaginertia="2.4e-6 2.4e-6 7.5e-7"/>
          <geom name="{side}_finger" class="robot" type="box" size="{FINGER_WIDTH / 2} {FINGER_THICKNESS / 2} {tip_half}"
                pos="0 {sign * FINGER_THICKNESS / 2} {tip_half}" rgba="0.25 0.25 0.27 1" priority="1" condim="4"
                friction="{FINGER_FRICTION} 0.005 0.0001"/>
        </body>"""
    return f"""
      <body name="hand" gravcomp="1" pos="0 0 0.107" quat="0.9238795 0 0 -0.3826834">
        <inertial pos="-0.01 0 0.03" mass="0.73" diaginertia="0.001 0.0025 0.0017"/>
        <geom name="hand" class="robot" type="box" size="0.03 0.1 0.032" pos="0 0 0.034" rgba="0.92 0.92 0.92 1"/>
        <site name="tcp" pos="0 0 {_TCP_OFFSET}"/>{fingers}
      </body>"""


def _bodies(config: Panda) -> str:
    """MJCF of the arm's body tree: base, seven links, hand, two fingers. Its nine joints come first in the model."""
    body = ""
    for (name, pos, quat, limits), (mass, com, inertia), (start, end, radius) in _LINKS:
        body += f"""
      <body name="{name}" pos="{_vector(pos)}" quat="{_vector(quat)}" gravcomp="1">
        <inertial pos="{_vector(com)}" mass="{mass}" fullinertia="{_vector(inertia)}"/>
        <joint name="{name}" range="{_vector(limits)}" armature="0.1" damping="1"/>
        <geom name="{name}" class="robot" type="capsule" fromto="{_vector((*start, *end))}" size="{radius}"/>"""
    return f"""
    <body name="base" pos="{_vector(config.base)}">
      <geom name="base" class="robot" type="box" size="0.08 0.08 0.07" pos="-0.03 0 0.07"/>{body}{_hand_xml(config.max_opening)}
      {"</body>" * N_JOINTS}
    </body>"""


def _drives(config: Panda) -> str:
    """MJCF of the joint servos (seven positions) and of the fingers' drive (one position, both fingers coupled)."""
    servos = "".join(
        f'<position name="{link[0][0]}" joint="{link[0][0]}" kp="{kp}" kv="{kv}" forcerange="{-limit} {limit}"/>'
        for link, kp, kv, limit in zip(_LINKS, _SERVO_STIFFNESS, _SERVO_DAMPING, _TORQUE_LIMITS, strict=True)
    )
    return f"""
  <equality><joint joint1="left_finger" joint2="right_finger" solref="0.004 1"/></equality>
  <actuator>{servos}
    <position name="fingers" joint="left_finger" kp="{_FINGER_STIFFNESS}" kv="{_FINGER_DAMPING}"
              forcerange="{-config.grip_force} {config.grip_force}"/>
  </actuator>"""


class CartesianController:
    """Turns the 4-number action into servo targets: a damped-least-squares inverse kinematics with fixed orientation.

    It keeps the commanded pose, not the measured one, as its own state, so that a blocked or sagging arm does not drift. The
    kinematics run on a copy of the arm alone.
    """

    def __init__(self, config: Panda, control_hz: int, physics_dt: float = PHYSICS_TIMESTEP):
        self.config, self._physics_dt = config, physics_dt
        self.n_substeps = round(1 / (control_hz * physics_dt))
        self._cooldown_steps = round(config.gripper_cooldown * control_hz)
        self._model = config.spec().compile()
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site("tcp").id
        self._jacobian = np.zeros((6, self._model.nv))
        self._lower = self._model.jnt_range[:N_JOINTS, 0] + 0.02
        self._upper = self._model.jnt_range[:N_JOINTS, 1] - 0.02
        self._orientation = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # hand pointing down, fingers open along y
        self.reset(np.zeros(3))

    def reset(self, position: np.ndarray) -> np.ndarray:
        """Places the commanded point at `position` (3,) [m, world], fingers open. Returns the nine joint positions."""
        self.joints: np.ndarray = HOME_JOINTS.copy()
        self.target: np.ndarray = np.asarray(position, dtype=float).copy()
        self._solve(iterations=100)
        self.finger_target = self.config.max_opening / 2
        self._closed = False
        self._steps_since_change = self._cooldown_steps
        return np.concatenate([self.joints, [self.finger_target] * 2])

    def hold(self) -> np.ndarray:
        """(8,) the servo targets that keep it where it is told to be: seven joints [rad], finger position [m]."""
        return np.append(self.joints, self.finger_target)

    def command(self, action: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """One control step.

        Args:
            action: (4,) in [-1, 1]: displacement in units of `ACTION_SCALE`, gripper (> 0 closes).
            measured: (3,) the tool centre point as it is [m, world].

        Returns:
            (n_substeps, 8) servo targets at physics rate: seven joints [rad], finger position [m].
        """
        target = self.target + ACTION_SCALE * np.asarray(action[:3], dtype=float)
        lead = target - measured
        distance = float(np.linalg.norm(lead))
        if distance > self.config.max_lead:
            target = measured + lead * (self.config.max_lead / distance)
        self.target = np.clip(target, *self.config.workspace)
        before = self.joints.copy()
        self._solve(iterations=2)
        self._update_gripper(action[3] > 0)

        ramp = np.arange(1, self.n_substeps + 1)[:, None] / self.n_substeps
        controls = np.empty((self.n_substeps, N_JOINTS + 1))
        controls[:, :N_JOINTS] = before + ramp * (self.joints - before)
        goal = 0.0 if self._closed else self.config.max_opening / 2
        travel = _FINGER_SPEED * self._physics_dt * np.arange(1, self.n_substeps + 1)
        sign = np.sign(goal - self.finger_target)
        fingers = self.finger_target + sign * np.minimum(travel, abs(goal - self.finger_target))
        controls[:, N_JOINTS] = fingers
        self.finger_target = float(fingers[-1])
        return controls

    @property
    def gripper_blocked_steps(self) -> int:
        """For how many more steps a change of the gripper's command is ignored."""
        return max(self._cooldown_steps - self._steps_since_change, 0)

    def _update_gripper(self, close: bool) -> None:
        self._steps_since_change += 1
        if close != self._closed and self._steps_since_change > self._cooldown_steps:
            self._closed = close
            self._steps_since_change = 0

    def _solve(self, iterations: int) -> None:
        model, data = self._model, self._data
        for _ in range(iterations):
            data.qpos[:N_JOINTS] = self.joints
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, self._jacobian[:3], self._jacobian[3:], self._site)
            jacobian = self._jacobian[:, :N_JOINTS]
            rotation = data.site_xmat[self._site].reshape(3, 3)
            error = np.empty(6)
            error[:3] = self.target - data.site_xpos[self._site]
            error[3:] = 0.5 * _crossed(rotation.T, self._orientation.T).sum(axis=0)
            gram = jacobian @ jacobian.T
            gram[np.diag_indices(6)] += 1e-5
            # The seventh degree of freedom is drawn home, in the null space of the task.
            posture = 0.05 * (HOME_JOINTS - self.joints)
            step = posture + jacobian.T @ np.linalg.solve(gram, error - jacobian @ posture)
            self.joints = np.clip(self.joints + step, self._lower, self._upper)


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def _crossed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(N, 3) cross products, to the last bit as from `np.cross`, in half the time."""
    return first[:, _NEXT] * second[:, _LAST] - first[:, _LAST] * second[:, _NEXT]


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviation and quantum of what the arm measures of itself, as on a real one. Zero switches noise off.

    position: end effector [m]; finger: finger positions [m]; finger_velocity: [m/s]; quantum_*: rounding step. A hand whose
    encoder has 8 bits counts in steps of half a millimetre.
    differentiated: finger velocities are differences of the measured positions over a step, as from a hand that reports
    its width alone; otherwise they are the fingers' own at the moment, in which every touch rings.
    wander: of an error of the end effector's place that wanders, as an arm's calibration is off by something else at every
    place [m]: white noise averages away, this does not. wander_seconds: in which it is forgotten, to 1/e.
    """

    position: float = 0.0003
    finger: float = 0.00002
    finger_velocity: float = 0.002
    quantum_position: float = 0.0001
    quantum_finger: float = 0.0005
    quantum_velocity: float = 0.001
    differentiated: bool = True
    wander: float = 0.0
    wander_seconds: float = 2.0


class Proprioception:
    """The sensors of one arm.

    Args:
        noise: What is wrong with them.
        rate_hz: Measurements per second.
        wander_rng: The wandering error is drawn from it, so that a task without one draws what it always drew.
    """

    def __init__(self, noise: SensorNoise, rate_hz: float, wander_rng: np.random.Generator | None = None) -> None:
        self._noise, self._rate_hz = noise, rate_hz
        n_values = (3, 2, 2)
        self._scale = np.repeat([noise.position, noise.finger, noise.finger_velocity], n_values)
        self._quantum = np.repeat([noise.quantum_position, noise.quantum_finger, noise.quantum_velocity], n_values)
        self._fingers: np.ndarray | None = None
        self._wander: np.ndarray | None = None
        self._wander_rng = wander_rng or np.random.default_rng(0)
        self._kept = float(np.exp(-1 / (noise.wander_seconds * rate_hz)))  # of that error, by the next measurement

    def measure(self, true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """What the sensors say of the true values, (7,) float32.

        Args:
            true: (7,) end effector x, y, z [m], finger positions [m] and velocities [m/s].
            rng: The noise is drawn from it.
        """
        values = true + self._scale * rng.standard_normal(7)
        if self._noise.wander:
            values[:3] += self._wandered()
        coarse = self._quantum > 0
        values[coarse] = np.round(values[coarse] / self._quantum[coarse]) * self._quantum[coarse]
        if self._noise.differentiated:
            before = values[3:5] if self._fingers is None else self._fingers
            self._fingers = values[3:5].copy()
            values[5:] = (values[3:5] - before) * self._rate_hz
        return values.astype(np.float32)

    def _wandered(self) -> np.ndarray:
        """(3,) the error that wanders [m]: an autoregressive process whose standard deviation is always `wander`."""
        drawn = self._noise.wander * self._wander_rng.standard_normal(3)
        if self._wander is None:
            self._wander = drawn
        else:
            self._wander = self._kept * self._wander + np.sqrt(1 - self._kept**2) * drawn
        return self._wander
