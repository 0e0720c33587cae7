"""What all tasks share: the arm on its table, one control step, observations, sound, rendering."""

import time
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from mujoco import rollout

from gym_playbyear.arena import CUBE_HALF_SIZE, TABLE_TOP, contact_pairs, pair_forces
from gym_playbyear.arm import N_JOINTS, PHYSICS_TIMESTEP, CartesianController
from gym_playbyear.blind import BLIND_STRATEGIES, BlindGrasp
from gym_playbyear.experts import CORRECTING_EXPERT, GraspExpert
from gym_playbyear.gates import InterventionGate
from gym_playbyear.materials import CUBE_MATERIALS
from gym_playbyear.privileged import PrivilegedState
from gym_playbyear.proprioception import Proprioception
from gym_playbyear.rendering import SceneRenderer, Window
from gym_playbyear.scene import model_xml
from gym_playbyear.sound import ContactPair, ContactSound

CONTROL_HZ = 20
SOUND_MODES = ("waveform", "contact_force", "none")
_SETTLE_STEPS = 10
_CARRIED_HEIGHT = TABLE_TOP + CUBE_HALF_SIZE + 0.015  # m: the cube's centre is this high only when it was picked up
_LIFTED_SILENCE_HEIGHT = 0.84  # m: above it the paper's force proxy is silent (the authors' code)


class PlayByEarEnv(PrivilegedState, gym.Env):
    """Base of the tasks. A task gives its fixed bodies, places what moves, and says when it is solved.

    A copy (`copy.deepcopy`, `pickle`), of the environment alone or together with an expert or a gate, goes on as the original
    would and independently of it; what it renders with it opens itself, when it first draws.

    Subclasses define `VARIANTS`, `task`, `task_description`, `_expert`, `_blind`, `_scene_xml`, `_scene_bodies`, `_place` and
    `_is_success`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium declares it so)
        "render_modes": ["rgb_array", "human"],
        "render_fps": CONTROL_HZ,
    }
    VARIANTS: ClassVar[dict[str, Any]]
    task: str
    task_description: str
    _expert: type[GraspExpert]
    _blind: type[BlindGrasp]
    _scene_bodies: tuple[str, ...]
    _start_position: tuple[float, float, float] = (-0.12, 0.0, 0.98)  # m, before each episode's own offset
    _start_spread = 0.02  # m

    def __init__(
        self,
        *,
        image_size: int = 84,
        sample_rate: int = 16000,
        sound: str = "waveform",
        noise_level: float = 1.0,
        cube_material: str = "cube",
        microphones: tuple[str, ...] = ("gripper",),
        horizon: int | None = None,
        variant: str = "default",
        render_mode: str | None = None,
        render_size: int = 480,
    ):
        _check_option("sound", sound, SOUND_MODES)
        _check_option("variant", variant, tuple(self.VARIANTS))
        _check_option("cube_material", cube_material, CUBE_MATERIALS)
        _check_option("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        if image_size < 8:
            raise ValueError(f"image_size={image_size} is too small: give at least 8 pixels.")
        self.variant = self.VARIANTS[variant]
        self._max_episode_steps = int(horizon or self.variant.horizon)
        self.render_mode, self._render_size = render_mode, render_size
        self._image_size, self._sound_mode = image_size, sound

        self.pairs = contact_pairs(self._scene_bodies)
        self.model = mujoco.MjModel.from_xml_string(
            model_xml(self.variant, self._scene_xml(), self.pairs, max(render_size, image_size))
        )
        self.data = mujoco.MjData(self.model)
        self._controller = CartesianController(self.variant.arm, CONTROL_HZ)
        self._sound: ContactSound | None = None
        if sound == "waveform":
            made_of = {"cube": cube_material}
            pairs = [
                ContactPair(name=f"{a}-{b}", materials=(made_of.get(a, a), made_of.get(b, b)), bodies=(a, b))
                for a, b in self.pairs
            ]
            self._sound = ContactSound(
                pairs, tuple(microphones), sample_rate, CONTROL_HZ, PHYSICS_TIMESTEP, noise_level
            )
        self._tcp = self.model.site("tcp").id
        self._cube = self.model.body("cube").id
        self._state = np.empty(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        self._rollout_state = np.empty((1, self._controller.n_substeps, len(self._state)))
        self._rollout_sensors = np.empty((1, self._controller.n_substeps, self.model.nsensordata))
        self._cameras: dict[str, SceneRenderer] = {}  # those that have drawn
        self._window: Window | None = None
        self._is_closed = False
        self._expert_rng: np.random.Generator | None = None  # None before the first episode
        self._peak_forces = np.zeros(len(self.pairs))
        self._n_steps = 0
        self._sensors = Proprioception(self.variant.sensors, CONTROL_HZ)

        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        observation: dict[str, spaces.Space] = {
            "pixels": spaces.Dict({"front": spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)}),
            "agent_pos": spaces.Box(-np.inf, np.inf, (7,), np.float32),
        }
        if self._sound is not None:
            for microphone in microphones:
                shape = (sample_rate // CONTROL_HZ,)
                observation[f"audio.{microphone}"] = spaces.Box(-32768, 32767, shape, np.int16)
        if sound == "contact_force":
            observation["contact_force"] = spaces.Box(-np.inf, np.inf, (6,), np.float32)
        self.observation_space = spaces.Dict(observation)

    # What a task defines

    def _scene_xml(self) -> str:
        raise NotImplementedError

    def _place(self, options: dict[str, Any]) -> None:
        raise NotImplementedError

    def _is_success(self) -> bool:
        raise NotImplementedError

    # Scripts that know more than a policy

    def scripted_expert(self) -> GraspExpert:
        """An expert for the current episode, with privileged knowledge: `act()` gives an action (4,). Make it after `reset`."""
        return self._expert(self)

    def intervention_gate(self) -> InterventionGate:
        """The expert beside a policy in this episode: `wants_control(policy_action)` and `act()`. Make it after `reset`."""
        return InterventionGate(self, self._expert(self, CORRECTING_EXPERT))

    def blind_baselines(self) -> dict[str, BlindGrasp]:
        """Scripts that know what the camera shows and have no sense of contact, by name; used like `scripted_expert`."""
        return {strategy: self._blind(self, strategy) for strategy in BLIND_STRATEGIES}

    # Gymnasium's interface

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        self.begin_episode(seed=seed, options=options)
        return self._observe(), {"is_success": False}

    def begin_episode(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """`reset` without the observation, for scripts that go on with `advance`: nothing is rendered, no OpenGL is needed."""
        super().reset(seed=seed)
        self._is_closed = False
        options = dict(options or {})
        mujoco.mj_resetData(self.model, self.data)
        spread = self.np_random.uniform(-self._start_spread, self._start_spread, 3)
        self.data.qpos[: N_JOINTS + 2] = self._controller.reset(np.array(self._start_position) + spread)
        self.data.ctrl[:N_JOINTS] = self._controller.joints
        self.data.ctrl[N_JOINTS] = self._controller.finger_target
        self._place(options)
        self._expert_rng = np.random.default_rng(self.np_random.integers(2**63))
        if self._sound is not None:
            self._sound.reset(np.random.default_rng(self.np_random.integers(2**63)))
        self._sensors.reset()
        self._n_steps = 0
        mujoco.mj_forward(self.model, self.data)
        hold = np.repeat(self.data.ctrl[None].copy(), self._controller.n_substeps, axis=0)
        for _ in range(_SETTLE_STEPS):
            self._advance(hold)
        self._first_cube_position, self._was_carried = self.cube_position, False

    def step(self, action):
        outcome = self.advance(action)
        return self._observe(), *outcome

    def advance(self, action) -> tuple[float, bool, bool, dict[str, Any]]:
        """`step` without the observation, for scripts that look at the state alone: no picture, no sound, no sensor noise."""
        self._check_is_running("step")
        action = np.asarray(action, dtype=float)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"action must be 4 finite numbers in [-1, 1], got {action!r}.")
        controls = self._controller.command(np.clip(action, -1, 1), self.eef_position)
        self._advance(controls)
        self._n_steps += 1
        success = self._is_success()
        failed = not success and self._was_shoved()
        truncated = not (success or failed) and self._n_steps >= self._max_episode_steps
        return float(success), success or failed, truncated, {"is_success": success}

    def render(self):
        self._check_is_running("render")
        if self.render_mode == "human":
            if self._window is None:
                self._window = Window(self.model, self.data)
            self._window.update()
            time.sleep(1 / CONTROL_HZ)
            return None
        if self.render_mode != "rgb_array":
            return None
        return self._picture("people", self._render_size)

    def close(self):
        """Closes window and OpenGL. Only `reset` opens them again, as in Gymnasium's own environments; until then `step` and
        `render` raise ClosedEnvironmentError."""
        self._is_closed = True
        for resource in (*self._cameras.values(), self._window):
            if resource is not None:
                resource.close()
        self._cameras, self._window = {}, None

    def __getstate__(self) -> dict[str, Any]:
        # What is open belongs to this process and to this object: a copy opens its own.
        return {**self.__dict__, "_cameras": {}, "_window": None}

    def _check_is_running(self, call: str) -> None:
        if self._is_closed:
            raise ClosedEnvironmentError(f"{call}() was called on a closed environment: call reset() to open it again.")
        if self._expert_rng is None:
            raise ResetNeeded(f"{call}() was called before the first episode: call reset() first.")

    # One control step

    def _advance(self, controls: np.ndarray) -> None:
        """Runs the physics of one control step in one call; the contact sensors are in `_rollout_sensors`."""
        mujoco.mj_getState(self.model, self.data, self._state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        rollout.rollout(
            self.model,
            self.data,
            self._state[None],
            controls[None],
            initial_warmstart=self.data.qacc_warmstart[None].copy(),
            state=self._rollout_state,
            sensordata=self._rollout_sensors,
            skip_checks=False,
        )
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self._peak_forces = pair_forces(self._rollout_sensors[0], len(self.pairs)).max(axis=0)

    def _was_shoved(self) -> bool:
        self._was_carried |= bool(self.cube_position[2] > _CARRIED_HEIGHT)
        distance = np.linalg.norm((self.cube_position - self._first_cube_position)[:2])
        return not self._was_carried and bool(distance > self.variant.max_shove)

    def _observe(self) -> dict[str, Any]:
        """The observation after a control step; a person who watches sees it, too."""
        sensors = self._rollout_sensors[0]
        observation: dict[str, Any] = {
            "pixels": {"front": self._picture("front", self._image_size)},
            "agent_pos": self._sensors.measure(self._true_proprioception(), self.np_random),
        }
        if self._sound is not None:
            first_qvel = 1 + self.model.nq
            speed = np.abs(self._rollout_state[0, :, first_qvel : first_qvel + N_JOINTS]).mean(axis=1)
            for microphone, block in self._sound.step(pair_forces(sensors, len(self.pairs)), speed).items():
                observation[f"audio.{microphone}"] = block
        if self._sound_mode == "contact_force":
            silent = self.cube_position[2] > _LIFTED_SILENCE_HEIGHT
            force = np.zeros(6) if silent else sensors[:, -6:].mean(axis=0)
            observation["contact_force"] = force.astype(np.float32)
        if self.render_mode == "human":
            self.render()
        return observation

    def _true_proprioception(self) -> np.ndarray:
        fingers = slice(N_JOINTS, N_JOINTS + 2)
        return np.concatenate(
            [self.eef_position - self.variant.arm.base, self.data.qpos[fingers], self.data.qvel[fingers]]
        )

    def _picture(self, camera: str, size: int) -> np.ndarray:
        """(size, size, 3) uint8."""
        if camera not in self._cameras:
            self._cameras[camera] = SceneRenderer(self.model, size)
        return self._cameras[camera].render(self.data, camera)

    def _place_cube(self, options: dict[str, Any]) -> float:
        """Where it is drawn to be, or `options` want it. Returns its y [m]."""
        x, y = (self.np_random.uniform(*limits) for limits in (self.variant.cube_x, self.variant.cube_y))
        yaw = self.np_random.uniform(-self.variant.cube_yaw, self.variant.cube_yaw)
        x, y = options.get("cube_position", (x, y))
        yaw = options.get("cube_yaw", yaw)
        address = self.model.joint("cube").qposadr[0]
        self.data.qpos[address : address + 3] = (x, y, TABLE_TOP + CUBE_HALF_SIZE)
        self.data.qpos[address + 3 : address + 7] = (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
        return float(y)


def _check_option(name: str, value, allowed: tuple) -> None:
    if value not in allowed:
        raise ValueError(f"{name}={value!r} is not known: choose one of {', '.join(map(repr, allowed))}.")
