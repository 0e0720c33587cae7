"""A person beside a policy, or alone: the expert of `--expert.type=teleop`."""

import time
from dataclasses import dataclass
from typing import ClassVar

import gymnasium as gym
import numpy as np
from lerobot.teleoperators import Teleoperator

from lerobot_playbyear.episodes.environment import task_description
from lerobot_playbyear.episodes.episode import Observation, Verdict
from lerobot_playbyear.episodes.expert import Expert
from lerobot_playbyear.teleoperation.actions import CLOSE, GRIPPER, OPEN, ActionMapping, Gripper
from lerobot_playbyear.teleoperation.controls import OVERRIDE, Controls, PersonLeftError, Wish
from lerobot_playbyear.teleoperation.levels import level_db, microphone_blocks
from lerobot_playbyear.teleoperation.pace import Pace
from lerobot_playbyear.teleoperation.speaker import Speaker
from lerobot_playbyear.teleoperation.status import HISTORY_S, Control, Status
from lerobot_playbyear.teleoperation.window import Window

_BEGIN = "Press P to begin"
_NOTES = {
    Verdict.SUCCESS: "Ended as a success",
    Verdict.FAILURE: "Ended as failed",
    Verdict.DISCARD: "Thrown away",
}


@dataclass(eq=False)
class TeleopExpert(Expert):
    """Shows a person each step in its turn, and lets them take over while they hold a key.

    Args:
        window: Shows the scene and hears keys.
        teleop: A connected LeRobot teleoperator.
        mapping: Makes actions of what it gives.
        gripper: What the gripper is told.
        pace: Of the control loop.
        speaker: Plays the first microphone.
        keys: What to press, for the window.
        begins_paused: Whether each attempt waits until the person is ready.
        demonstrates: Whether nobody but the person acts.
        toggles: Whether a press of the key takes over, or hands back, instead of holding it.
        override: The key.
    """

    window: Window
    teleop: Teleoperator
    mapping: ActionMapping
    gripper: Gripper
    pace: Pace
    speaker: Speaker
    keys: list[tuple[str, str]]
    begins_paused: bool = True
    demonstrates: bool = False
    toggles: bool = False
    override: str = OVERRIDE

    decides: ClassVar[bool] = True
    can_label: ClassVar[bool] = False

    def __post_init__(self) -> None:
        self._controls = Controls(self.teleop, self.window.keys, self.toggles, self.override)
        self.clock_fps = self.pace.fps
        self._wish = Wish({})
        self._is_called = self._stays = False
        self._verdict: Verdict | None = None
        self._last_command: float | None = None
        waiting = "The next attempt is being prepared" if self.demonstrates else "The policy is learning or evaluated"
        self._status = Status(fps=self.pace.fps, keys=self.keys, waiting=waiting)
        self.window.show(self._status)

    def reset(self, env: gym.Env) -> None:
        self._env = env
        status = self._status
        status.attempt, status.step = status.attempt + 1, -1
        status.n_steps, status.task = int(env.get_wrapper_attr("_max_episode_steps")), task_description(env)
        status.levels_db = {}
        status.note = _NOTES[self._verdict] if self._verdict else ""
        self._verdict, self._last_command, self._is_paused = None, None, self.begins_paused
        status.control = Control.PERSON if self.demonstrates else Control.POLICY
        self._controls.reset()
        if self._controls.read().leaves:  # all else that was pressed meanwhile was not meant for this attempt
            raise PersonLeftError
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
        acts = self.demonstrates or self._wish.overrides or self._stays
        self._acts = acts
        self._last_command = self._gripper_command() if acts else float(policy_action[-1])
        status.control = Control.PERSON if acts else Control.CALLED if self._is_called else Control.POLICY
        return acts

    def act(self) -> np.ndarray:
        return self.mapping.vector(self._wish.action, self._gripper_command())

    def take_over(self, until_told: bool = True) -> None:
        self._stays = until_told

    def hand_back(self) -> None:
        self._stays = False

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
        self._wish = self._controls.read()
        if self._wish.leaves:
            raise PersonLeftError
        self._is_paused ^= self._wish.toggles_pause
        self._verdict = self._wish.verdict

    def _pause(self) -> None:
        """Nothing moves until the person goes on, or ends the attempt."""
        status = self._status
        note, status.note = status.note, _BEGIN if status.step == 0 else "Press P to go on"
        while self._is_paused and self._verdict is None:
            status.control = Control.PAUSED
            self._show()
            time.sleep(1 / self.pace.fps)
            self._read()
        status.note = note
        self.pace.start()

    def _gripper_command(self) -> float:
        """1 closes, -1 opens: what the key or the teleoperator says, or else what it was."""
        coded = self._wish.action.get(GRIPPER) if self.mapping.moves_hand else None
        close = self.gripper.is_closed
        if self._wish.toggles_gripper:
            close = not close
        elif coded is not None and coded in (CLOSE, OPEN):
            close = coded == CLOSE
        return 1.0 if self.gripper.wish(close) else -1.0

    def _show(self, picture: np.ndarray | None = None) -> None:
        status = self._status
        status.achieved_fps = round(self.pace.achieved_fps, 1)
        if self.mapping.has_gripper:
            status.gripper = "closed" if self.gripper.is_closed else "open"
            status.cooldown_s = round(self.gripper.blocked_steps / self.pace.fps, 2)
        status.sound = self.speaker.problem
        self.window.show(status, picture)
