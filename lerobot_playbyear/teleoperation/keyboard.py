"""The window's keys, and the LeRobot teleoperator that moves a hand with them."""

import threading
from dataclasses import dataclass
from typing import Any

from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

from lerobot_playbyear.teleoperation.actions import DELTAS

_X, _Y, _Z = DELTAS
MOVES = {"right": (_X, 1), "left": (_X, -1), "up": (_Y, 1), "down": (_Y, -1), "e": (_Z, 1), "d": (_Z, -1)}
"""Which displacement a key makes, and its sign."""


class WindowKeys:
    """Which keys a person holds, and which were pressed since the last look.

    The window's thread writes, and `look` makes a picture of it that holds until the next look: a key that was tapped
    between two looks counts as held once.

    Attributes:
        held: Keys that were held at the last look, or tapped before it.
        pressed: Keys that were pressed before the last look, in their order.
        has_focus: Whether the window hears keys.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: set[str] = set()
        self._pressed_since: list[str] = []
        self.held: frozenset[str] = frozenset()
        self.pressed: tuple[str, ...] = ()
        self.has_focus = False

    def look(self) -> None:
        """Take in what happened since the last time."""
        with self._lock:
            self.pressed = tuple(self._pressed_since)
            self.held = frozenset(self._held | set(self._pressed_since))
            self._pressed_since.clear()

    def note(self, name: str, is_pressed: bool) -> None:
        """A key went down or up."""
        with self._lock:
            if is_pressed:
                self._held.add(name)
                self._pressed_since.append(name)
            else:
                self._held.discard(name)


@TeleoperatorConfig.register_subclass("keyboard_window")
@dataclass
class KeyboardWindowTeleopConfig(TeleoperatorConfig):
    """The keyboard, as the window sees it while it has the focus: nothing needs to be installed, and Wayland is fine."""


class KeyboardWindowTeleop(Teleoperator):
    """Arrow keys move right, left, away and near; E and D move up and down; several at once add up.

    Args:
        config: Its configuration.
        keys: The window's keys; without them it cannot be connected.
    """

    config_class = KeyboardWindowTeleopConfig
    name = "keyboard_window"
    action_features: dict[str, Any] = dict.fromkeys(DELTAS, float)
    feedback_features: dict[str, Any] = {}  # noqa: RUF012 (LeRobot declares it so)
    is_connected = False
    is_calibrated = True

    def __init__(self, config: KeyboardWindowTeleopConfig, keys: WindowKeys | None = None) -> None:
        super().__init__(config)
        self._keys = keys

    def connect(self, calibrate: bool = True) -> None:
        if self._keys is None:
            raise ConnectionError("keyboard_window has no window: it works with --expert.type=teleop.")
        self.is_connected = True

    def calibrate(self) -> None:
        """Keys need none."""

    def configure(self) -> None:
        """Keys need none."""

    def get_action(self) -> RobotAction:
        """-1, 0 or 1 for each displacement: what the held keys add up to."""
        assert self._keys is not None
        moved = dict.fromkeys(DELTAS, 0.0)
        for name in self._keys.held & MOVES.keys():
            axis, sign = MOVES[name]
            moved[axis] += sign
        return moved

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Keys take none."""

    def disconnect(self) -> None:
        self.is_connected = False
