"""Plays a task: one control step, observations, sound, pictures, and how an attempt ends."""

import copy
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from mujoco import rollout

from gym_playbyear.ears import Moment
from gym_playbyear.ears_v2 import MaterialEars
from gym_playbyear.force_proxy import ForceProxy
from gym_playbyear.looks import PeopleView
from gym_playbyear.options import OptionError, ResetOptions, check_option, make_definition
from gym_playbyear.privileged import PrivilegedState
from gym_playbyear.proprioception import Proprioception
from gym_playbyear.rendering import SceneRenderer
from gym_playbyear.room import in_room
from gym_playbyear.scene import Contacts, bending_joints, compose
from gym_playbyear.sound_v2_crackle import Bending
from gym_playbyear.task import Task

SOUND_MODES = ("waveform", "contact_force", "none")
_SETTLE_STEPS = 10
_ROOM_MICROPHONE = np.array((0.6, 0.0, 1.2))  # m, world frame: for microphones that no part of the arm carries


class TaskEnv(PrivilegedState, gym.Env):
    """A task as a Gymnasium environment.

    A copy (`copy.deepcopy`, `pickle`), of the environment alone or together with an expert or a gate, goes on as the original
    would and independently of it; what it renders with it opens itself, when it first draws.

    Args:
        task: A task's name, a task, or a function that makes one of `task_options`.
        image_size: Pixels of a camera's square picture.
        sample_rate: Samples per second; a multiple of the task's control rate. None: the task's.
        sound: "waveform", "contact_force" (the paper's stand-in for sound), or "none".
        noise_level: Scales background noise and motor hum.
        microphones: Their names. None: the task's.
        horizon: Steps of an episode. None: the task's.
        hidden_object: False: the hand passes through what is hidden; all else is the same world.
        room: Options of `gym_playbyear.room.Room`: noise, noise_level, response. None: as it is.
        render_mode: None, "rgb_array" or "human".
        render_size: Pixels of the picture that `render()` returns.
        task_options: The task's own options.

    Raises:
        ValueError: An option has a value that cannot be used; the message names both.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 20}  # noqa: RUF012 (as Gymnasium has it)

    def __init__(
        self,
        task: str | Task | Callable[..., Task],
        *,
        image_size: int = 84,
        sample_rate: int | None = None,
        sound: str = "waveform",
        noise_level: float = 1.0,
        microphones: tuple[str, ...] | None = None,
        horizon: int | None = None,
        hidden_object: bool = True,
        room: dict[str, Any] | None = None,
        render_mode: str | None = None,
        render_size: int = 480,
        **task_options: Any,
    ):
        self.definition = definition = make_definition(task, task_options)
        check_option("sound", sound, SOUND_MODES)
        check_option("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        if image_size < 8:
            raise ValueError(f"image_size={image_size} is too small: give at least 8 pixels.")
        self.task, self.task_description, self.variant = definition.name, definition.description, definition.numbers
        self.metadata = {**self.metadata, "render_fps": definition.control_hz}
        if horizon is not None and horizon < 1:
            raise OptionError("horizon", horizon, "give at least 1 step, or None for the task's own")
        self._max_episode_steps = int(definition.horizon if horizon is None else horizon)
        self.render_mode, self._render_size = render_mode, render_size
        self._image_size, self._sound_mode, self._hidden_object = image_size, sound, hidden_object
        self.microphones = tuple(microphones or definition.microphones)
        self._sample_rate = int(sample_rate or definition.sample_rate)
        self.shown, self.secrets, self.materials = {}, {}, {}
        # Rules remember things of an episode.
        self._success, self._ends, self._haste = copy.deepcopy((definition.success, definition.ends, definition.haste))

        arm = definition.arm
        self.contacts, self._force_proxy = Contacts(definition), ForceProxy()
        self._sound: Any = None
        if sound == "waveform":
            rates = (self._sample_rate, definition.control_hz, definition.physics_dt)
            ears = MaterialEars(self.contacts.heard(), self.microphones, *rates, noise_level)
            self._sound = in_room(ears, self.microphones, self._sample_rate, room or {})
        spec = compose(definition, max(render_size, image_size), hidden_object)
        self.contacts.add_sensors(spec, definition.felt)
        if self._sound is not None:
            self._sound.add_sensors(spec)
        self.model = spec.compile()
        self._remember_places()
        self.data = mujoco.MjData(self.model)
        self._controller = arm.controller(definition.control_hz, definition.physics_dt)
        self._fingers = slice(arm.n_joints, arm.n_joints + 2)
        self._tool = self.model.site(arm.tool).id
        self._bends = bending_joints(self.model, definition)
        self._state = np.empty(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        self._rollout_state = np.empty((1, self._controller.n_substeps, len(self._state)))
        self._rollout_sensors = np.empty((1, self._controller.n_substeps, self.model.nsensordata))
        self._cameras: dict[str, SceneRenderer] = {}  # those that have drawn
        self._people: PeopleView | None = None  # made when somebody looks
        self._is_closed, self._n_steps = False, 0
        self._expert_rng: np.random.Generator | None = None  # None before the first episode
        self._peak_forces = np.zeros(len(self.pairs))
        self._sensors = Proprioception(definition.sensors, definition.control_hz)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = self._describe_observation()

    def _describe_observation(self) -> spaces.Dict:
        size = (self._image_size, self._image_size, 3)
        pictures: dict[str, spaces.Space] = {
            camera.name: spaces.Box(0, 255, size, np.uint8) for camera in self.definition.cameras
        }
        observation: dict[str, spaces.Space] = {
            "pixels": spaces.Dict(pictures),
            "agent_pos": spaces.Box(-np.inf, np.inf, (7,), np.float32),
        }
        if self._sound is not None:
            for microphone in self.microphones:
                shape = (self._sample_rate // self.control_hz,)
                observation[f"audio.{microphone}"] = spaces.Box(-32768, 32767, shape, np.int16)
        if self._sound_mode == "contact_force":
            observation["contact_force"] = spaces.Box(-np.inf, np.inf, (6,), np.float32)
        return spaces.Dict(observation)

    # Scripts that know more than a policy

    def scripted_expert(self) -> Any:
        """An expert for the current episode, with privileged knowledge: `act()` gives an action (4,). Make it after `reset`."""
        return self.definition.expert(self)

    @property
    def intervention_gate(self) -> Callable[[], Any]:
        """Gives the expert beside a policy in this episode: `wants_control(policy_action)` and `act()`. Call it after `reset`.

        Raises:
            AttributeError: The task has none; `hasattr` tells.
        """
        if self.definition.gate is None:
            raise AttributeError
        return self._make_gate

    def _make_gate(self) -> Any:
        assert self.definition.gate is not None
        return self.definition.gate(self, self.definition.expert(self))

    def blind_baselines(self) -> dict[str, Any]:
        """Scripts that know what the camera shows and have no sense of contact, by name; used like `scripted_expert`."""
        return {name: make(self) for name, make in self.definition.blind.items()}

    # Gymnasium's interface

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        self.begin_episode(seed=seed, options=options)
        return self._observe(), {"is_success": False}

    def begin_episode(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """`reset` without the observation, for scripts that go on with `advance`: nothing is rendered, no OpenGL is needed."""
        super().reset(seed=seed)
        self._is_closed = False
        start, spread = np.array(self.definition.start), self.definition.start_spread
        mujoco.mj_resetData(self.model, self.data)
        joints = self._controller.reset(start + self.np_random.uniform(-spread, spread, 3))
        self.data.qpos[: len(joints)] = joints
        self.data.ctrl[:] = self._controller.hold()
        self.secrets, self.materials = {}, {}
        self._put_back()
        asked = ResetOptions(options or {})
        self.shown = self.definition.place(self, asked)
        asked.check_spelling()
        self._expert_rng = np.random.default_rng(self.np_random.integers(2**63))
        if self._sound is not None:
            self._sound.choose(self.materials)
            self._sound.reset(np.random.default_rng(self.np_random.integers(2**63)))
        self._sensors = self._fresh_sensors()
        self._n_steps = 0
        mujoco.mj_forward(self.model, self.data)
        hold = np.repeat(self.data.ctrl[None].copy(), self._controller.n_substeps, axis=0)
        for _ in range(_SETTLE_STEPS):
            self._advance(hold)
        for rule in (self._success, *self._ends, self._haste, self._force_proxy):
            rule.begin(self)

    def step(self, action):
        outcome = self.advance(action)
        return self._observe(), *outcome

    def advance(self, action) -> tuple[float, bool, bool, dict[str, Any]]:
        """`step` without the observation, for scripts that look at the state alone: no picture, no sound, no sensor noise.

        `info["is_success"]` says whether the task is solved, and at the last step `info["end"]` how the attempt ended:
        "success", the name of a rule, or "time". By then the task's secrets are there, and "acted_early" and "n_closings"
        (`haste.py`).
        """
        self._check_is_running("step")
        action = np.asarray(action, dtype=float)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"action must be 4 finite numbers in [-1, 1], got {action!r}.")
        self._advance(self._controller.command(np.clip(action, -1, 1), self.eef_position))
        self._n_steps += 1
        self._haste.look(self)
        end = next((rule.name for rule in (self._success, *self._ends) if rule.applies(self)), None)
        truncated = end is None and self._n_steps >= self._max_episode_steps
        info: dict[str, Any] = {"is_success": end == self._success.name}
        if end is not None or truncated:
            info |= {"end": end or "time", **self.secrets, **self._haste.info()}
        return float(info["is_success"]), end is not None, truncated, info

    def render(self):
        self._check_is_running("render")
        if self.render_mode is None:
            return None
        self._people = self._people or PeopleView(self.definition, self._render_size, self._hidden_object)
        if self.render_mode == "rgb_array":
            return self._people.picture(self.model, self.data)
        self._people.show(self.model, self.data)
        return time.sleep(1 / self.control_hz)

    def close(self):
        """Closes window and OpenGL. Only `reset` opens them again, as in Gymnasium's own environments; until then `step` and
        `render` raise ClosedEnvironmentError."""
        self._is_closed = True
        for renderer in self._cameras.values():
            renderer.close()
        if self._people is not None:
            self._people.close()
        self._cameras, self._people = {}, None

    def __getstate__(self) -> dict[str, Any]:
        # What is open belongs to this process and to this object: a copy opens its own.
        return {**self.__dict__, "_cameras": {}, "_people": None}

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
        self._peak_forces = self.contacts.magnitudes(self._rollout_sensors[0]).max(axis=0)

    def _observe(self) -> dict[str, Any]:
        """The observation after a control step; a person who watches sees it, too."""
        observation: dict[str, Any] = {
            "pixels": {camera.name: self._picture(camera.name, self._image_size) for camera in self.definition.cameras},
            "agent_pos": self._sensors.measure(self._true_proprioception(), self.np_random),
        }
        if self._sound is not None:
            for microphone, block in self._sound.step(self.model, self.moment()).items():
                observation[f"audio.{microphone}"] = block
        if self._sound_mode == "contact_force":
            observation["contact_force"] = self._force_proxy.observe(self, self._rollout_sensors[0])
        if self.render_mode == "human":
            self.render()
        return observation

    def moment(self) -> Moment:
        """The last control step as far as it can be heard."""
        sensors, speeds = self._rollout_sensors[0], np.abs(self._rollout_state[0, :, 1 + self.model.nq :])
        links = self.definition.arm.links
        return Moment(
            self.contacts.magnitudes(sensors),
            sensors,
            speeds[:, : self._fingers.start].mean(axis=1),
            speeds[:, self._fingers].mean(axis=1),
            self._rollout_state[0],
            {microphone: self._place_of(links.get(microphone)) for microphone in self.microphones},
            {n: Bending(speeds[:, dofs] @ factors, self.position(n)) for n, (dofs, factors) in self._bends.items()},
        )

    def _place_of(self, body: str | None) -> np.ndarray:
        return _ROOM_MICROPHONE if body is None else self.data.body(body).xpos

    def _true_proprioception(self) -> np.ndarray:
        return np.concatenate(
            [self.eef_position - self.definition.arm.base, self.data.qpos[self._fingers], self.data.qvel[self._fingers]]
        )

    def _picture(self, camera: str, size: int) -> np.ndarray:
        """(size, size, 3) uint8."""
        if camera not in self._cameras:
            self._cameras[camera] = SceneRenderer(self.model, size)
        return self._cameras[camera].render(self.data, camera)
