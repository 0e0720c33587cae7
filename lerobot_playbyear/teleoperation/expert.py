"""A person beside a policy, or alone: the expert of `--expert.type=teleop`."""

import math
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

import gymnasium as gym
import numpy as np
from lerobot.teleoperators import Teleoperator

from lerobot_playbyear.episodes.environment import task_description
from lerobot_playbyear.episodes.experts import Expert
from lerobot_playbyear.episodes.play import Observation, Verdict
from lerobot_playbyear.teleoperation.controls import KEYS, ActionMapping, Controls, Gripper, PersonLeftError
from lerobot_playbyear.teleoperation.panel import HISTORY_S, Control, Status
from lerobot_playbyear.teleoperation.speaker import Speaker, level_db, microphone_blocks
from lerobot_playbyear.teleoperation.window import Window

if TYPE_CHECKING:
    from lerobot_playbyear.teleoperation.config import TeleopExpertConfig

_DIRECTIONS = {"gamepad": "-y,x,z"}
"""For the view of our tasks (right on the screen is x, away is y), per type of teleoperator; others have `x,y,z`."""

_MOVING_KEYS = {
    "keyboard_window": [(name, KEYS[name]) for name in ("Arrows", "E, D")],
    "gamepad": [("Sticks", "left: plane, right: height"), ("RB", "hold to take over")],
}

_RATE_OVER_S = 1.0
_BEGIN = "Press Space to begin"
_NOTES = {
    Verdict.SUCCESS: "Ended as a success",
    Verdict.FAILURE: "Ended as failed",
    Verdict.ENDED: "Ended",
    Verdict.DISCARD: "Once more",
}


class Pace:
    """Keeps a person's time: waits for each step's turn, as many control steps per second as the robot makes.

    A step that comes late moves all later ones: a person cannot use steps that are rushed through to catch up.

    Args:
        fps: Steps per second.
        clock, sleep: As in `time`.
    """

    def __init__(
        self, fps: float, clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self.fps = fps
        self._clock, self._sleep = clock, sleep
        self._due = -math.inf
        self._times: deque[float] = deque()

    def start(self) -> None:
        """The next step is due at once; what was measured is forgotten."""
        self._due = -math.inf
        self._times.clear()

    def wait(self) -> None:
        """Returns when the next step is due."""
        now = self._clock()
        if now < self._due:
            self._sleep(self._due - now)
        self._due = max(self._due, now) + 1 / self.fps
        self._times.append(self._clock())
        while self._times[-1] - self._times[0] > _RATE_OVER_S and len(self._times) > 2:
            self._times.popleft()

    @property
    def achieved_fps(self) -> float:
        """Steps per second of late; 0 for the first half second, in which that is not known."""
        if len(self._times) < 2 or self._times[-1] - self._times[0] < _RATE_OVER_S / 2:
            return 0.0
        return (len(self._times) - 1) / (self._times[-1] - self._times[0])


class TeleopExpert(Expert):
    """Shows a person each step in its turn, and lets them take over by a key.

    Args:
        options: How they move the arm and take over.
        env: The environment.
        window: Shows the scene and hears keys.
        teleop: A connected LeRobot teleoperator.
        demonstrates: Whether nobody but the person acts.

    Raises:
        ExpertError: The teleoperator and the environment do not fit.
    """

    decides: ClassVar[bool] = True

    def __init__(
        self, options: "TeleopExpertConfig", env: gym.Env, window: Window, teleop: Teleoperator, demonstrates: bool
    ) -> None:
        env_fps, kind = float(env.metadata["render_fps"]), options.teleop.type
        self.clock_fps = options.steps_per_second or env_fps
        self.window, self.teleop, self.demonstrates = window, teleop, demonstrates
        directions = options.directions or _DIRECTIONS.get(kind, "x,y,z")
        self.mapping = ActionMapping(teleop.action_features, env.action_space, directions, options.speed)
        self.gripper = Gripper(round(options.gripper_cooldown_s * env_fps))
        self.pace = Pace(self.clock_fps)
        assert isinstance(env.observation_space, gym.spaces.Dict)
        blocks = microphone_blocks(env.observation_space.sample())
        n_samples, reason = len(next(iter(blocks.values()), ())), ""  # of the first microphone in a step
        if not options.play_sound:
            reason = "--expert.play_sound=false"
        elif self.clock_fps != env_fps:
            reason = "slow motion"
        self.speaker = Speaker(round(n_samples * env_fps), n_samples, reason if n_samples else "no microphone")
        key, toggles = options.takeover_key.lower(), options.takeover == "toggle"
        self._controls = Controls(teleop, window.keys, toggles, key)
        self._begins_paused = options.begin_paused
        self._verdict: Verdict | None = None
        self._last_command: float | None = None
        takeover = [] if demonstrates else [(key.title(), KEYS["Tab"] if toggles else "hold to take over")]
        gripper = [("G", KEYS["G"])] if self.mapping.has_gripper else []
        ends = [(name, KEYS[name]) for name in ("Space", "S", "F", "Enter", "R", "Esc")]
        self._status = Status(
            fps=self.clock_fps,
            keys=[*takeover, *_MOVING_KEYS.get(kind, []), *gripper, *ends],
            waiting="The next attempt is being prepared" if demonstrates else "The policy is learning or evaluated",
        )
        self.window.show(self._status)

    def reset(self, env: gym.Env) -> None:
        self._env = env
        status = self._status
        status.attempt, status.step = status.attempt + 1, -1
        status.n_steps, status.task = int(env.get_wrapper_attr("_max_episode_steps")), task_description(env)
        status.levels_db = {}
        status.note = _NOTES[self._verdict] if self._verdict else ""
        self._verdict, self._last_command, self._is_paused = None, None, self._begins_paused
        status.control = Control.PERSON if self.demonstrates else Control.POLICY
        self._controls.read()  # but to leave, what was pressed meanwhile was not meant for this attempt
        self._controls.reset()
        self._acts = self._is_called = self._stays = False
        self.gripper.reset()
        self.pace.start()
        self.speaker.clear()

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        status = self._status
        status.step += 1
        if self._last_command is not None:
            self.gripper.follow(self._last_command > 0)
        blocks = microphone_blocks(observation)
        for name, block in blocks.items():
            levels = status.levels_db.setdefault(name, [])
            levels.append(round(level_db(block), 1))
            del levels[: -max(round(HISTORY_S * self.pace.fps), 1)]
        if blocks:
            self.speaker.play(next(iter(blocks.values())))
        self._show(np.ascontiguousarray(self._env.render(), np.uint8))
        self.pace.wait()
        self._read()
        if self._is_paused and self._verdict is None:
            self._pause()
        acts = self.demonstrates or self._controls.overrides or self._stays
        self._acts = acts
        self._last_command = self._gripper_command() if acts else float(policy_action[-1])
        status.control = Control.PERSON if acts else Control.CALLED if self._is_called else Control.POLICY
        return acts

    def act(self) -> np.ndarray:
        return self.mapping.vector(self._controls.action, self._gripper_command())

    def take_over(self) -> None:
        self._stays = True

    def call(self, is_called: bool) -> None:
        if is_called and not self._is_called and not self._acts:
            self.speaker.ring()
        self._is_called = is_called
        if not self._acts:
            self._status.control = Control.CALLED if is_called else Control.POLICY

    def verdict(self) -> Verdict | None:
        return self._verdict

    def close(self) -> None:
        self.speaker.close()
        try:
            if self.teleop.is_connected:
                self.teleop.disconnect()
        finally:
            self.window.close()

    def _read(self) -> None:
        """What the person wants now."""
        if not self.window.is_open:
            raise PersonLeftError
        self._controls.read()
        self._is_paused ^= self._controls.toggles_pause
        self._verdict = self._controls.verdict

    def _pause(self) -> None:
        """Nothing moves until the person goes on, takes over, or ends the attempt."""
        status = self._status
        note, status.note = status.note, _BEGIN if status.step == 0 else "Press Space to go on"
        while self._is_paused and self._verdict is None:
            overrode = self._controls.overrides
            status.control = Control.PAUSED
            self._show()
            time.sleep(1 / self.pace.fps)
            self._read()
            self._is_paused &= overrode or not self._controls.overrides
        status.note = note
        self.pace.start()

    def _gripper_command(self) -> float:
        """1 closes, -1 opens: what the key or the teleoperator says, or else what it was."""
        close = self.mapping.closes(self._controls.action)
        if self._controls.toggles_gripper or close is None:
            close = self.gripper.is_closed ^ self._controls.toggles_gripper
        return 1.0 if self.gripper.wish(close) else -1.0

    def _show(self, picture: np.ndarray | None = None) -> None:
        status = self._status
        status.achieved_fps = round(self.pace.achieved_fps, 1)
        if self.mapping.has_gripper:
            status.gripper = "closed" if self.gripper.is_closed else "open"
            status.cooldown_s = round(self.gripper.blocked_steps / self.pace.fps, 2)
        status.sound = self.speaker.problem
        self.window.show(status, picture)
