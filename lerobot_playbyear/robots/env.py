"""A real robot as a Gymnasium environment, in real time."""

import gc
import logging
import time
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.episodes.episode import Verdict
from lerobot_playbyear.episodes.sound_pictures import SoundPictures
from lerobot_playbyear.robots.arm import Arm
from lerobot_playbyear.robots.config import RobotEnvConfig
from lerobot_playbyear.robots.end_effector import EndEffector
from lerobot_playbyear.robots.parts import RobotError
from lerobot_playbyear.robots.person import Person, StopPressedError, count
from lerobot_playbyear.robots.pictures import FrozenCameras, side_by_side
from lerobot_playbyear.robots.preparing import ask_to_try_again, connect_or_ask, prepare
from lerobot_playbyear.robots.rig import leave_rig, open_rig
from lerobot_playbyear.robots.ticks import Ticks
from lerobot_playbyear.teleoperation.console import Console
from lerobot_playbyear.teleoperation.controls import PersonLeftError


class RobotEnv(gym.Env):
    """Any LeRobot robot with any number of microphones.

    `reset` brings the arm to rest and waits for the person. `step` sends an action, waits for the tick, and returns pictures,
    joints, and what each microphone heard since the tick before, up to when the pictures were exposed. Whatever goes wrong,
    the arm holds, the person is asked what becomes of the attempt, and it ends.

    Observations: `pixels` {camera: (height, width, 3) uint8}, `agent_pos` (numbers of the state,) float32 in the order of
    `state_names`, `audio.<microphone>` (samples per tick,) int16. Actions: (numbers,) in the order of `action_names`, in the
    robot's own units; with `end_effector` they are displacements of the hand and the gripper, in [-1, 1].

    Args:
        config: The options.
        render_mode: `rgb_array`: `render` gives all cameras side by side.

    Raises:
        RobotError: No robot is given, or it cannot be made.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (Gymnasium declares it so)
    is_real_time = True

    def __init__(self, config: RobotEnvConfig, render_mode: str = "rgb_array") -> None:
        self.config, self.render_mode = config, render_mode
        self.metadata = {**self.metadata, "render_fps": config.fps}
        self.task = self.task_description = config.task or ""
        self._max_episode_steps = max(round(config.episode_s * config.fps), 1)
        self._rig = open_rig(config)
        self._is_closed = False
        arm = self._rig.arm
        self.state_names, self.action_names = arm.state_names, arm.action_names
        self._hand = self._make_hand()
        if self._hand is not None:
            self.action_names = self._hand.action_names
        observation: dict[str, spaces.Space] = {}
        if arm.cameras:
            pictures: dict[str, spaces.Space] = {n: spaces.Box(0, 255, s, np.uint8) for n, s in arm.cameras.items()}
            observation["pixels"] = spaces.Dict(pictures)
        if self.state_names:
            observation["agent_pos"] = spaces.Box(-np.inf, np.inf, (len(self.state_names),), np.float32)
        for name, microphone in config.microphones.items():
            shape = (microphone.sample_rate // config.fps,)
            observation[f"audio.{name}"] = spaces.Box(-32768, 32767, shape, np.int16)
        self._sound_pictures = SoundPictures(config.sound_pictures())
        self.observation_space = self._sound_pictures.space(spaces.Dict(observation))
        self._limit = np.inf if arm.has_a_position and self._hand is None else 1.0
        self.action_space = spaces.Box(-self._limit, self._limit, (len(self.action_names),), np.float32)
        self.person = Person(self._rig, self._max_episode_steps)
        self._ticks = Ticks(config.fps)
        self._frozen = FrozenCameras(config.frozen_s)
        self._pictures: dict[str, np.ndarray] = {n: np.zeros(s, np.uint8) for n, s in arm.cameras.items()}
        self._last: dict[str, Any] | None = None
        self._began_at = 0.0
        self._stopped: Verdict | None = None

    # Gymnasium's interface

    def connect(self) -> None:
        """Opens everything, so that whatever is missing shows now.

        Raises:
            RobotError, MicrophoneError: Something cannot be used.
        """
        self._rig.connect()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        rig, config = self._rig, self.config
        rig.watchdog.rest()
        rig.attempt += 1
        gc.collect()  # takes a quarter of a second with all that LeRobot imports, which an attempt has not
        gc.freeze()
        while True:
            connect_or_ask(rig, self.person)
            try:
                prepare(rig, self.person, seed, self._look)
                self._stopped = None
                self._frozen.restart()
                now = self._begin()
                rig.ears.restart(now - config.camera_latency_s)
                rig.watchdog.feed()
                self._sound_pictures.clear()
                self._last = self._observe(now)
                return self._last, {"is_success": False}
            except PlaybyearError as error:
                rig.watchdog.rest()
                ask_to_try_again(self.person, error)

    def step(self, action):
        if self._last is None:
            raise gym.error.ResetNeeded("step() was called before the first attempt: call reset() first.")
        if self._stopped is not None:  # by an expert, in this step
            return self._outcome(self._stopped, is_stopped=True, was_sent=False)
        rig, problem, was_sent = self._rig, "", False
        if self._ticks.n == 0 and time.perf_counter() - self._tick_at > 1 / self.config.fps:
            rig.ears.skip_to(self._begin() - self.config.camera_latency_s)  # a policy's first action takes long
        try:
            if self._ticks.n and time.perf_counter() - self._tick_at > self.config.stall_s:
                problem = f"The loop stood still for {time.perf_counter() - self._tick_at:.1f} s."
            elif not np.isfinite(np.asarray(action, np.float64)).all():
                problem = "The policy's action holds a value that is not finite (NaN)."
            else:
                self._send(np.clip(action, -self._limit, self._limit))
                rig.watchdog.feed()
                was_sent = True
        except RobotError as error:
            problem = str(error)
        if not problem:
            due = self._ticks.wait()
            try:
                self._last = self._observe(due)
            except RobotError as error:
                problem = str(error)
            stood_s = self._ticks.standstill_s(rig.ears.patience_s)
            if not problem and stood_s > self.config.stall_s:
                problem = f"The program stood still for {stood_s:.1f} s."
        problem = problem or self._frozen.problem(self._pictures) or rig.ears.problem
        if problem:
            return self._end(problem, was_sent)
        try:
            verdict = self.person.look(self._last, self.render, self._ticks, rig.ears.drop_outs)
            if self.person.wants_pause and verdict is None:
                self.hold()
                self.person.pause()
                self.go_on()
        except RobotError as error:
            return self._end(str(error))
        except StopPressedError:
            return self._end("You pressed Escape.")
        return self._outcome(verdict)

    def render(self) -> np.ndarray:
        """All cameras side by side, (side, side, 3) uint8: a square, as the window shows, of at most 720 pixels."""
        return side_by_side(self._pictures)

    def close(self) -> None:
        """The arm holds, and everything is let go."""
        if not self._is_closed:
            self._is_closed = True
            gc.unfreeze()
            leave_rig(self._rig)

    # For an expert beside a policy

    @property
    def arm(self) -> Arm:
        """The robot."""
        return self._rig.arm

    @property
    def console(self) -> Console:
        """Where the person is."""
        return self._rig.console

    @property
    def n_drop_outs(self) -> int:
        """Places of this attempt at which sound is missing."""
        return count(self._rig.ears.drop_outs)

    def hold(self) -> None:
        """The arm stops, and time does not count until `go_on`."""
        self._rig.watchdog.rest()
        self._rig.arm.hold()

    def go_on(self) -> None:
        """After `hold`: what was heard and seen meanwhile belongs to no frame, and the last observation becomes that of now.

        Raises:
            RobotError: The robot, or a camera, does not answer.
        """
        now = self._begin() if self._ticks.n == 0 else self._ticks.go_on()
        self._rig.ears.skip_to(now - 1 / self.config.fps - self.config.camera_latency_s)
        if self._last is not None:
            self._sound_pictures.forget_newest()
            seen = self._observe(now)
            self._last.clear()  # whoever has the observation of this step has the new one
            self._last.update(seen)
        self._tick_at = now
        self._rig.watchdog.feed()

    def stop(self, verdict: Verdict) -> None:
        """The arm holds, and the attempt ends as the verdict says: its next step is its last, and moves nothing."""
        if self._stopped is None:
            self._rig.watchdog.rest()
            self._hold_now()
        self._stopped = verdict

    def stop_and_ask(self, reason: str) -> Verdict | None:
        """The arm holds, and the person says what becomes of the attempt, which ends as by `stop`; None: they leave."""
        self._rig.watchdog.rest()
        self._hold_now()
        self._stopped = self.person.judge(reason, self._rig.ears.drop_outs)
        return self._stopped

    def episode_facts(self) -> dict[str, Any]:
        """Of the attempt so far: when it began [s since 1970], ticks per second, late ticks, drop-outs by microphone."""
        return {
            "begun_at_s": round(self._began_at, 6),
            **self._ticks.facts(),
            "drop_outs": {
                name: [[drop.frame, drop.n_samples, drop.reason] for drop in drops]
                for name, drops in self._rig.ears.drop_outs.items()
            },
        }

    def _make_hand(self) -> EndEffector | None:
        if self.config.end_effector is None:
            return None
        try:
            return EndEffector(self._rig.arm, self.config.end_effector)
        except PlaybyearError:
            leave_rig(self._rig)
            raise

    def _send(self, action: np.ndarray) -> None:
        if self._hand is None:
            self._rig.arm.send(action)
        elif self._last is not None:
            self._hand.send(action, self._last["agent_pos"])

    def _begin(self) -> float:
        """The first tick is now: when that is [s of time.perf_counter]."""
        self._began_at = time.time()
        self._held_before = self._rig.watchdog.n_holds
        return self._ticks.start()

    def _hold_now(self) -> None:
        try:
            self._rig.arm.hold()
        except RobotError as error:
            logging.error(f"The robot cannot be told to hold: {error}")

    def _look(self) -> np.ndarray:
        """What the cameras see between attempts."""
        _, self._pictures = self._rig.arm.observe()
        return self.render()

    def _observe(self, due: float) -> dict[str, Any]:
        state, self._pictures = self._rig.arm.observe()
        self._tick_at = time.perf_counter()
        heard = self._rig.ears.read(due - self.config.camera_latency_s)
        observation: dict[str, Any] = {}
        if self._pictures:
            observation["pixels"] = self._pictures
        if self.state_names:
            observation["agent_pos"] = state
        return self._sound_pictures.add(observation | {f"audio.{name}": block for name, block in heard.items()})

    def _end(self, problem: str, was_sent: bool = True):
        """The attempt ends because something went wrong, before or after its last action was sent."""
        problem = problem.rstrip(". ") + "."
        logging.error(f"{problem} The robot holds.")
        verdict = self.stop_and_ask(problem)
        if verdict is None:
            raise PersonLeftError
        return self._outcome(verdict, is_stopped=True, was_sent=was_sent)

    def _outcome(self, verdict: Verdict | None, is_stopped: bool = False, was_sent: bool = True):
        info: dict[str, Any] = {"is_success": verdict is Verdict.SUCCESS}
        is_over = self._ticks.n >= self._max_episode_steps
        if verdict is not None:
            info["verdict"] = verdict.value
        if not was_sent:
            info["was_stopped"] = True
        if not is_stopped and (is_over or verdict is not None):
            self._rig.watchdog.rest()
            self._hold_now()
        if is_stopped or is_over or verdict is not None:
            info |= self._ticks.account(self._rig.watchdog.n_holds - self._held_before)
        ends = verdict is not None and not is_stopped
        return self._last, float(info["is_success"]), ends, is_stopped or is_over, info
