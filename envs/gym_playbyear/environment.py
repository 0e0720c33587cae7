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

from gym_playbyear.contacts import ContactReader, TaskContacts, add_net_force, add_sensors
from gym_playbyear.panda import Proprioception
from gym_playbyear.registry import OptionError, check_option, check_spelling, make_definition
from gym_playbyear.rendering import PeopleView, SceneRenderer
from gym_playbyear.room import Room
from gym_playbyear.scene import compose
from gym_playbyear.sound import ALL_MICROPHONES, Bending, Synthesizer
from gym_playbyear.task import Task, unknown_name

SOUND_MODES = ("waveform", "contact_force", "none")
_SETTLE_STEPS = 10
_PROXY_SILENT_ABOVE = 0.84  # m, world frame: as in the authors' code, whose cubes lie on the table
_PROXY_LIFTED = 0.015  # m: above where a thing lay that lay higher than they do, such as keys in a bag


class _Forces(dict[str, float]):
    """By pair; a pair that is not measured is told with those that are."""

    def __missing__(self, pair: str) -> float:
        raise KeyError(f"{pair!r} is not a pair of bodies whose contact is measured: there is {', '.join(self)}.")


class TaskEnv(gym.Env):
    """A task as a Gymnasium environment.

    Its action space is [-1, 1] in each number; an action beyond is clipped.

    A copy (`copy.deepcopy`, `pickle`), of the environment alone or together with an expert or a gate, goes on as the original
    would and independently of it; what it renders with it opens itself, when it first draws.

    Experts, gates, tests and whoever judges may read the true state, which a policy may not: `position`, `eef_position`,
    `finger_positions`, `gripper_blocked_steps`, `contact_forces`, `hand_forces`, `is_as_wanted`, and the attributes below.

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
        render_size: Pixels of the square picture that `render()` returns.
        task_options: The task's own options.

    Attributes:
        definition: The task.
        shown: What the camera shows of the episode, in numbers by name; the task's `initialize_episode` returned it.
        secrets: What nothing but sound tells of it, by name; `info` says it when the episode is over.
        materials: What props are made of in this episode, where that is not their usual material.

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
        self.microphones = definition.microphones if microphones is None else tuple(microphones)
        self._sample_rate = int(sample_rate or definition.sample_rate)
        self._max_episode_steps = int(definition.horizon if horizon is None else horizon)
        self._check(sound, render_mode, noise_level, {"image_size": (image_size, 8), "render_size": (render_size, 1)})
        self.task, self.task_description = definition.name, definition.description
        self.control_hz = definition.control_hz
        self.metadata = {**self.metadata, "render_fps": definition.control_hz}
        self.render_mode, self._render_size = render_mode, render_size
        self._image_size, self._hidden_object = image_size, hidden_object
        self.shown: dict[str, Any] = {}
        self.secrets: dict[str, Any] = {}
        self.materials: dict[str, str] = {}
        # They remember things of an episode.
        self._success, self._failures, self._early_action = copy.deepcopy(
            (definition.success, definition.terminations, definition.early_action)
        )

        self._contacts = TaskContacts(definition)
        self._synthesizer: Synthesizer | None = None
        self._room: Room | None = None
        if sound == "waveform":
            rates = (self._sample_rate, definition.control_hz, definition.physics_dt)
            self._synthesizer = Synthesizer(self._contacts.pairs, self.microphones, *rates, noise_level)
            self._places = {name: np.array(ALL_MICROPHONES[name].place) for name in self.microphones}
            self._room = Room(self.microphones, self._sample_rate, **room) if room else None
        spec = compose(definition, max(render_size, image_size), hidden_object)
        add_sensors(spec, self._contacts.pairs, sound == "waveform")
        has_proxy = sound == "contact_force" and definition.force_proxy_of is not None
        proxy = add_net_force(spec, str(definition.force_proxy_of)) if has_proxy else None
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._reader = ContactReader(self.model, self._contacts.pairs, sound == "waveform")
        self._proxy = None if proxy is None else int(self.model.sensor(proxy).adr[0])
        self._has_proxy, self._proxy_silent_above = sound == "contact_force", _PROXY_SILENT_ABOVE
        self._usual_places = self.model.body_pos.copy(), self.model.body_quat.copy()
        self._controller = definition.arm.controller(definition.control_hz, definition.physics_dt)
        self._fingers = slice(definition.arm.n_joints, definition.arm.n_joints + 2)
        self._tool = self.model.site(definition.arm.tool).id
        self._bends = {
            prop.name: (
                np.array([self.model.joint(joint).dofadr[0] for joint, _ in prop.bends]),
                np.array([factor for _, factor in prop.bends]),
            )
            for prop in (definition.arena, *definition.props)
            if prop.bends
        }
        self._state = np.empty(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        self._rollout_state = np.empty((1, self._controller.n_substeps, len(self._state)))
        self._rollout_sensors = np.empty((1, self._controller.n_substeps, self.model.nsensordata))
        self._forces = self._reader.forces(np.zeros((1, self.model.nsensordata)))
        self._peak_forces = np.zeros(len(self.pairs))
        self._cameras: dict[str, SceneRenderer] = {}  # those that have drawn
        self._people: PeopleView | None = None  # made when somebody looks
        self._is_closed, self.n_steps = False, 0
        self._expert_rng: np.random.Generator | None = None  # None before the first episode
        self._sensors = Proprioception(definition.sensors, definition.control_hz)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = self._describe_observation()

    def _check(
        self, sound: str, render_mode: str | None, noise_level: float, sizes: dict[str, tuple[int, int]]
    ) -> None:
        """Raises OptionError for what cannot be used; `sizes`: by their names, each with its least value."""
        check_option("sound", sound, SOUND_MODES)
        check_option("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        for name, (size, least) in {**sizes, "horizon": (self._max_episode_steps, 1)}.items():
            if size < least:
                raise OptionError(name, size, f"give {least} or more")
        hz = self.definition.control_hz
        if self._sample_rate < 8000 or self._sample_rate % hz:
            wanted = f"give a multiple of {hz} from 8000 on, such as 16000 or 48000: each step holds as many samples"
            raise OptionError("sample_rate", self._sample_rate, wanted)
        names, known = self.microphones, ALL_MICROPHONES
        if sound == "waveform" and (not names or len(set(names)) < len(names) or any(n not in known for n in names)):
            raise OptionError("microphones", names, f"name at least one of {', '.join(known)}, each only once")
        if not 0 <= noise_level < np.inf:
            raise OptionError("noise_level", noise_level, "give 0 (silent) or more")

    def _describe_observation(self) -> spaces.Dict:
        size = (self._image_size, self._image_size, 3)
        cameras = [camera.name for camera in self.definition.cameras]
        observation: dict[str, spaces.Space] = {
            "pixels": spaces.Dict({camera: spaces.Box(0, 255, size, np.uint8) for camera in cameras}),
            "agent_pos": spaces.Box(-np.inf, np.inf, (7,), np.float32),
        }
        if self._synthesizer is not None:
            for microphone in self.microphones:
                shape = (self._sample_rate // self.control_hz,)
                observation[f"audio.{microphone}"] = spaces.Box(-32768, 32767, shape, np.int16)
        if self._has_proxy:
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
        make = self.definition.gate
        if make is None:
            raise AttributeError(f"{self.task} has no intervention gate.")
        return lambda: make(self, self.scripted_expert())

    def blind_baselines(self) -> dict[str, Any]:
        """Scripts that know what the camera shows and have no sense of contact, by name; used like `scripted_expert`."""
        return {name: make(self) for name, make in self.definition.blind.items()}

    def camera_numbers(self) -> dict[str, Any]:
        """What the camera shows of the episode and of the moment, in numbers: scripts that do not hear may know it."""
        return {**self.shown, **(self.definition.sees(self) if self.definition.sees else {})}

    # Gymnasium's interface

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        self.reset_physics(seed=seed, options=options)
        return self._observe(), {"is_success": False}

    def reset_physics(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """`reset` without the observation, for scripts that go on with `step_physics`: nothing is rendered, no OpenGL is
        needed."""
        super().reset(seed=seed)
        self._is_closed = False
        start, spread = np.array(self.definition.start), self.definition.start_spread
        mujoco.mj_resetData(self.model, self.data)
        joints = self._controller.reset(start + self.np_random.uniform(-spread, spread, 3))
        self.data.qpos[: len(joints)] = joints
        self.data.ctrl[:] = self._controller.hold()
        self.secrets, self.materials = {}, {}
        self.model.body_pos[:], self.model.body_quat[:] = self._usual_places
        check_spelling("reset(options)", options or {}, self.definition.reset_options)
        self.shown = self.definition.initialize_episode(self, options or {})
        if not isinstance(self.shown, dict):
            raise ValueError(
                f"{self.definition.name}: initialize_episode returned {self.shown!r}: return what the camera shows, in numbers "
                "by name, {} if it is nothing."
            )
        self._expert_rng = np.random.default_rng(self.np_random.integers(2**63))
        if self._synthesizer is not None:
            seed = int(self.np_random.integers(2**63))
            self._synthesizer.reset(np.random.default_rng(seed), self.materials)
            if self._room is not None:
                self._room.reset(np.random.default_rng((seed, 1)))
        # What wanders in the arm's sensors draws nothing from `np_random`.
        seeds: Any = self.np_random.bit_generator.seed_seq
        sensors_rng = np.random.default_rng(seeds.spawn(1)[0])
        self._sensors = Proprioception(self.definition.sensors, self.control_hz, sensors_rng)
        self.n_steps = 0
        mujoco.mj_forward(self.model, self.data)
        hold = np.repeat(self.data.ctrl[None].copy(), self._controller.n_substeps, axis=0)
        for _ in range(_SETTLE_STEPS):
            self._roll(hold)
        for termination in (self._success, *self._failures):
            termination.begin(self)
        self._early_action.begin(self)
        if self._proxy is not None:
            height = float(self.position(str(self.definition.force_proxy_of))[2])
            self._proxy_silent_above = max(_PROXY_SILENT_ABOVE, height + _PROXY_LIFTED)

    def step(self, action):
        outcome = self.step_physics(action)
        return self._observe(), *outcome

    def step_physics(self, action) -> tuple[float, bool, bool, dict[str, Any]]:
        """`step` without the observation, for scripts that look at the state alone: no picture, no sound, no sensor noise.

        `info["is_success"]` says whether the task is solved, and at the last step `info["end"]` how the attempt ended:
        "success", the name of a termination, or "time". By then the task's secrets are there, and "acted_early" and
        "n_closings" (`terminations.EarlyAction`).
        """
        self._check_is_running("step")
        action = np.asarray(action, dtype=float)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"action must be 4 finite numbers, got {action!r}. Beyond [-1, 1] they are clipped.")
        self._roll(self._controller.command(np.clip(action, -1, 1), self.eef_position))
        self.n_steps += 1
        self._early_action.look(self)
        end = next((rule.name for rule in (self._success, *self._failures) if rule.applies(self)), None)
        truncated = end is None and self.n_steps >= self._max_episode_steps
        info: dict[str, Any] = {"is_success": end == self._success.name}
        if end is not None or truncated:
            info |= {"end": end or "time", **self.secrets, **self._early_action.info()}
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

    def _roll(self, controls: np.ndarray) -> None:
        """Runs the physics of one control step in one call, and reads the contact forces."""
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
        self._forces = self._reader.forces(self._rollout_sensors[0])
        self._peak_forces = self._contacts.magnitudes(self._forces).max(axis=0)

    def _observe(self) -> dict[str, Any]:
        """The observation after a control step; a person who watches sees it, too."""
        observation: dict[str, Any] = {
            "pixels": {camera.name: self._picture(camera.name, self._image_size) for camera in self.definition.cameras},
            "agent_pos": self._sensors.measure(self.true_proprioception(), self.np_random),
        }
        for microphone, block in self.listen().items():
            observation[f"audio.{microphone}"] = block
        if self._has_proxy:
            observation["contact_force"] = self._force_proxy()
        if self.render_mode == "human":
            self.render()
        return observation

    def _picture(self, camera: str, size: int) -> np.ndarray:
        """(size, size, 3) uint8."""
        if camera not in self._cameras:
            self._cameras[camera] = SceneRenderer(self.model, size)
        return self._cameras[camera].render(self.data, camera)

    def listen(self) -> dict[str, np.ndarray]:
        """What each microphone heard of the last control step, int16 (sample_rate / control_hz,); without sound, nothing.

        Once after `reset_physics` and each `step_physics`: `reset` and `step` have it in their observation.
        """
        if self._synthesizer is None:
            return {}
        speeds = np.abs(self._rollout_state[0, :, 1 + self.model.nq :])  # (n_substeps, nv)
        heard = self._synthesizer.step(
            self._reader.read(self._rollout_sensors[0], self._forces),
            speeds[:, : self._fingers.start].mean(axis=1),
            speeds[:, self._fingers].mean(axis=1),
            {microphone: self._place_of(microphone) for microphone in self.microphones},
            {
                name: Bending(speeds[:, dofs] @ factors, self.position(name))
                for name, (dofs, factors) in self._bends.items()
            },
        )
        return heard if self._room is None else self._room.hear(heard)

    def _place_of(self, microphone: str) -> np.ndarray:
        body = self.definition.arm.links.get(microphone)
        return self._places[microphone] if body is None else self.data.body(body).xpos

    def _force_proxy(self) -> np.ndarray:
        """The paper's stand-in for sound (6,) float32 [N, Nm]: mean net contact force and torque on `force_proxy_of`, silent
        once that is lifted."""
        name = self.definition.force_proxy_of
        if self._proxy is None or self.position(str(name))[2] > self._proxy_silent_above:
            return np.zeros(6, np.float32)
        return self._rollout_sensors[0][:, self._proxy : self._proxy + 6].mean(axis=0).astype(np.float32)

    # The true state, for scripts

    @property
    def is_as_wanted(self) -> bool:
        """Whether all is as the task wants it, though perhaps not for long enough yet."""
        return self.definition.success.condition(self)

    @property
    def expert_rng(self) -> np.random.Generator:
        """What the episode's experts draw from.

        Raises:
            ResetNeeded: There is no episode yet.
        """
        if self._expert_rng is None:
            raise ResetNeeded("An expert was made before the first episode: call reset() first.")
        return self._expert_rng

    @property
    def eef_position(self) -> np.ndarray:
        """(3,) the point between the fingertips [m, world frame], without sensor noise."""
        return self.data.site_xpos[self._tool].copy()

    @property
    def finger_positions(self) -> np.ndarray:
        """(2,) [m], without sensor noise."""
        return self.data.qpos[self._fingers].copy()

    def true_proprioception(self) -> np.ndarray:
        """(7,) what `agent_pos` measures, without sensor noise."""
        hand = self.eef_position - self.definition.arm.base
        return np.concatenate([hand, self.data.qpos[self._fingers], self.data.qvel[self._fingers]])

    @property
    def gripper_blocked_steps(self) -> int:
        """For how many more steps a change of the gripper's command is ignored: at first the 2 s after the last change."""
        return self._controller.gripper_blocked_steps

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Which contacts are measured."""
        return self._contacts.names

    @property
    def contact_forces(self) -> dict[str, float]:
        """Largest net force of each pair of bodies in the last control step [N], e.g. `gripper-table`."""
        return _Forces((f"{a}-{b}", float(force)) for (a, b), force in zip(self.pairs, self._peak_forces, strict=True))

    def hand_forces(self, name: str) -> np.ndarray:
        """Forces between the parts of the hand (`Panda.touching`) and a loose prop in the last control step's T physics steps
        (T, parts, 3) [N, world axes]. ValueError for any other."""
        return self._contacts.hand_forces(self._forces, name)

    def position(self, name: str) -> np.ndarray:
        """(3,) where a prop's body is [m, world frame]."""
        return self.data.body(name).xpos.copy()

    def set_pose(self, name: str, position, yaw: float | None = None) -> None:
        """Sets a prop down, for a task's `initialize_episode`.

        Args:
            name: Of the prop.
            position: (3,) of its body [m, world frame].
            yaw: Turn about the vertical [rad]; None: as it is in its own description.

        Raises:
            ValueError: The task has no such prop.
        """
        props = {prop.name: prop for prop in self.definition.props}
        if name not in props:
            raise unknown_name(f"{self.definition.name}: set_pose, prop", name, props)
        turn = None if yaw is None else (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
        if props[name].loose:
            address = self.model.joint(name).qposadr[0]
            self.data.qpos[address : address + 3] = position
            if turn is not None:
                self.data.qpos[address + 3 : address + 7] = turn
        else:
            body = self.model.body(name)
            body.pos[:] = position
            if turn is not None:
                body.quat[:] = turn
