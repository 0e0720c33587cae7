"""A robot with its microphones and its person: opened once in a program, however many environments use it."""

import atexit
import contextlib
import json
from dataclasses import dataclass, field
from typing import Any

import draccus

from lerobot_playbyear.microphones.ears import Ears
from lerobot_playbyear.robots.arm import Arm
from lerobot_playbyear.robots.config import RobotEnvConfig
from lerobot_playbyear.robots.parts import RobotError, reconnect_cameras
from lerobot_playbyear.robots.watchdog import Watchdog
from lerobot_playbyear.teleoperation.console import Console, make_console

_HOLD_AFTER_TICKS = 2  # without an action


@dataclass(eq=False)
class Rig:
    """What belongs together and can be opened only once.

    Attributes:
        arm, ears, watchdog: The robot, its microphones, and what holds it when the loop stands still.
        home: Where the arm was when the program began, by joint.
        attempt: How many attempts there were.
    """

    config: RobotEnvConfig
    arm: Arm
    ears: Ears
    watchdog: Watchdog
    home: dict[str, float] | None = None
    attempt: int = 0
    n_users: int = 0
    _console: Console | None = field(default=None)
    _is_closed: bool = False

    @property
    def console(self) -> Console:
        """Where the person is; opened when it is first wanted."""
        if self._console is None:
            self._console = make_console(self.config.console, f"Play it by ear: {self.config.task}")
        return self._console

    @console.setter
    def console(self, console: Console) -> None:
        self._console = console

    def connect_anew(self) -> None:
        """Lets go of the robot and connects to it again; its joints may fall meanwhile.

        Raises:
            RobotError, MicrophoneError: Something cannot be used.
        """
        self.arm.disconnect()
        self.connect()

    def connect(self) -> None:
        """Connects to whatever is not connected, or no longer works.

        Raises:
            RobotError, MicrophoneError: Something cannot be used.
        """
        self.arm.connect()
        try:
            self.arm.observe()
        except RobotError:
            reconnect_cameras(self.arm.robot)
            self.arm.observe()
        self.ears.connect()
        if self.home is None:
            self.home = self.arm.position()

    def close(self) -> None:
        """Lets go of everything; the arm holds before. Safe to call twice."""
        if self._is_closed:
            return
        self._is_closed = True
        atexit.unregister(self.close)
        self.watchdog.rest()
        self.watchdog.close()
        if self.arm.robot.is_connected:
            with contextlib.suppress(RobotError):  # it is gone
                self.arm.hold()
        self.ears.disconnect()
        self.arm.disconnect()
        if self._console is not None:
            self._console.close()
            self._console = None


_rigs: dict[str, Rig] = {}


def open_rig(config: RobotEnvConfig) -> Rig:
    """The rig of a configuration: a new one, or the one that another environment of this program uses.

    Raises:
        RobotError: No robot is given, or it cannot be made.
        ValueError: The rate of ticks does not divide a sample rate.
    """
    if config.robot is None:
        raise RobotError(
            "--env.type=playbyear_robot needs a robot: give --env.robot.type, such as so101_follower, and its options."
        )
    key = _key(config)
    if key not in _rigs:
        arm = Arm(config.robot, config.max_relative_target, config.max_step, config.calibrate)
        ears = Ears(config.microphones, config.fps, stalled_s=config.stall_s, silent_s=config.silent_s)
        _rigs[key] = Rig(config, arm, ears, Watchdog(arm, _HOLD_AFTER_TICKS / config.fps))
        atexit.register(_rigs[key].close)  # lerobot-eval closes nothing when something goes wrong
    elif draccus.encode(_rigs[key].config) != draccus.encode(config):
        raise RobotError(
            "Another environment of this program uses the same robot with other options: give both the same."
        )
    _rigs[key].n_users += 1
    return _rigs[key]


def leave_rig(rig: Rig) -> None:
    """An environment uses it no more; the last one closes it."""
    rig.n_users -= 1
    if rig.n_users == 0:
        _rigs.pop(_key(rig.config), None)
        rig.close()


def _key(config: RobotEnvConfig) -> str:
    encoded: Any = draccus.encode({"robot": config.robot, "microphones": config.microphones})
    return json.dumps([encoded["robot"], encoded["microphones"]], sort_keys=True, default=str)
