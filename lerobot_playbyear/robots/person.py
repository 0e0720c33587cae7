"""The person beside a robot: says when an attempt begins, how it ended, and what to do when something went wrong."""

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_playbyear.datasets.microphone import DropOut
from lerobot_playbyear.episodes.episode import Verdict
from lerobot_playbyear.robots.ticks import Ticks
from lerobot_playbyear.teleoperation.console import NoConsole
from lerobot_playbyear.teleoperation.controls import FAILURE, LEAVE, PAUSE, RERECORD, SUCCESS, PersonLeftError
from lerobot_playbyear.teleoperation.levels import level_db, microphone_blocks
from lerobot_playbyear.teleoperation.status import HISTORY_S, Control, Status

if TYPE_CHECKING:
    from lerobot_playbyear.robots.rig import Rig

_LOOK_S = 0.05
_KEYS = [
    ("P", "begin, pause"),
    ("S", "success: end"),
    ("Q", "end as failed"),
    ("R", "throw away"),
    ("Esc", "stop the arm"),
]
_VERDICTS = {SUCCESS: Verdict.SUCCESS, FAILURE: Verdict.FAILURE, RERECORD: Verdict.DISCARD}


class Person:
    """Reads the keys of the rig's console, unless an expert does.

    Args:
        rig: With the console.
        n_steps: The most steps of an attempt.

    Attributes:
        has_expert: Whether an expert reads the keys while the robot moves, and shows the scene.
        wants_pause: Whether they pressed P at the last look.
    """

    def __init__(self, rig: "Rig", n_steps: int) -> None:
        self._rig, self._n_steps = rig, n_steps
        self.has_expert = False
        self.wants_pause = False

    @property
    def is_there(self) -> bool:
        """Whether anybody can be asked."""
        return not isinstance(self._rig.console, NoConsole)

    def begin(self) -> None:
        """An attempt is about to begin; what was pressed before was not meant for it.

        Raises:
            PersonLeftError: They had pressed Escape.
        """
        config = self._rig.config
        self._status = Status(
            control=Control.PAUSED,
            task=config.task or "",
            attempt=self._rig.attempt,
            n_steps=self._n_steps,
            fps=config.fps,
            keys=_KEYS,
            waiting="Please wait",
            sound="the robot's microphones would hear it",
        )
        self._verdict: Verdict | None = None
        self._look_for_leaving()

    def wants_to_stop(self) -> bool:
        """Whether they pressed Escape since the last look, which stays to be seen."""
        return self._rig.console.keys.was_pressed(LEAVE) or not self._rig.console.is_open

    def _look_for_leaving(self) -> None:
        """What was pressed before was not meant for now, but to leave."""
        self._rig.console.keys.look()
        if LEAVE in self._rig.console.keys.pressed and self.is_there:
            raise PersonLeftError

    def wait_for(self, note: str, picture: Callable[[], np.ndarray]) -> None:
        """Waits until the person presses P, if anybody is there.

        Args:
            note: What they are told.
            picture: What the cameras see.

        Raises:
            PersonLeftError: They leave.
        """
        if self.is_there:
            self._look_for_leaving()
            self._status.note = note
            self._wait_for({PAUSE, "enter"}, picture)

    def begins(self) -> None:
        """From here on the arm moves."""
        self._status.note, self._status.control = "", Control.POLICY

    def look(
        self,
        observation: Mapping[str, Any],
        picture: Callable[[], np.ndarray],
        ticks: Ticks,
        drop_outs: Mapping[str, list[DropOut]],
    ) -> Verdict | None:
        """After a step: shows how it goes, and reads the keys. Returns how the person ends the attempt, if they do.

        Raises:
            StopPressedError: They pressed Escape.
            PersonLeftError: They closed the window.
        """
        self.wants_pause = False
        if self.has_expert or not self.is_there:
            return None
        console, status = self._rig.console, self._status
        status.step, status.achieved_fps = ticks.n, round(ticks.rate, 1)
        status.drop_outs = count(drop_outs)
        for name, block in microphone_blocks(dict(observation)).items():
            levels = status.levels_db.setdefault(name, [])
            levels.append(round(level_db(block), 1))
            del levels[: -max(round(HISTORY_S * status.fps), 1)]
        console.show(status, picture())
        if not console.is_open:
            raise PersonLeftError
        console.keys.look()
        if LEAVE in console.keys.pressed:
            raise StopPressedError
        self.wants_pause = PAUSE in console.keys.pressed
        return next((_VERDICTS[key] for key in console.keys.pressed if key in _VERDICTS), None)

    def pause(self) -> None:
        """The arm holds until the person goes on.

        Raises:
            StopPressedError: They pressed Escape.
        """
        self._status.control, self._status.note = Control.PAUSED, "Press P to go on"
        try:
            self._wait_for({PAUSE, "enter"}, None)
        except PersonLeftError as error:
            raise StopPressedError from error
        self._status.control, self._status.note = Control.POLICY, ""

    def judge(self, reason: str, drop_outs: Mapping[str, list[DropOut]]) -> Verdict | None:
        """Something went wrong, and the arm holds: what becomes of the attempt. Without anybody there: thrown away.

        Returns:
            What the person says; None: they leave.
        """
        if not self.is_there:
            return Verdict.DISCARD
        self._status.drop_outs = count(drop_outs)
        self._status.control = Control.PAUSED
        self._status.note = f"{reason} R throws the attempt away, Q counts it as failed, S as a success; Esc leaves."
        try:
            key = self._wait_for(set(_VERDICTS), None)
        except PersonLeftError:
            return None
        return _VERDICTS[key]

    def wants_again(self, problem: str) -> bool:
        """Something cannot be used: whether the person wants it tried again."""
        self._status = Status(control=Control.PAUSED, task=self._rig.config.task or "", fps=self._rig.config.fps)
        self._status.note = f"{problem} P tries again, Esc leaves."
        try:
            self._wait_for({PAUSE, "enter"}, None)
        except PersonLeftError:
            return False
        return True

    def _wait_for(self, keys: set[str], picture: Callable[[], np.ndarray] | None) -> str:
        console = self._rig.console
        while True:
            console.show(self._status, picture() if picture is not None else None)
            if not console.is_open:
                raise PersonLeftError
            console.keys.look()
            pressed = [key for key in console.keys.pressed if key in keys or key == LEAVE]
            if LEAVE in pressed:
                raise PersonLeftError
            if pressed:
                return pressed[0]
            time.sleep(_LOOK_S)


class StopPressedError(Exception):
    """The person pressed Escape while the arm moved."""


def count(drop_outs: Mapping[str, list[DropOut]]) -> int:
    """How many drop-outs there were; the channels of a card lose the same."""
    return max((len(drops) for drops in drop_outs.values()), default=0)
