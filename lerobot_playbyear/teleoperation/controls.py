"""What a person wants, as an action: the window's keys and a LeRobot teleoperator, taken together."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig, TeleopEvents

from lerobot_playbyear.episodes.experts import ExpertError
from lerobot_playbyear.episodes.play import Verdict
from lerobot_playbyear.teleoperation.window import WindowKeys

DELTAS = ("delta_x", "delta_y", "delta_z")
GRIPPER = "gripper"
CLOSE, STAY, OPEN = 0, 1, 2
"""How LeRobot's teleoperators code the gripper."""

_CLOSES: dict[Any, bool] = {CLOSE: True, OPEN: False}

_X, _Y, _Z = DELTAS
MOVES = {"right": (_X, 1), "left": (_X, -1), "up": (_Y, 1), "down": (_Y, -1), "e": (_Z, 1), "d": (_Z, -1)}
"""Which displacement a key makes, and its sign."""

OVERRIDE, PAUSE, LEAVE, SUCCESS, FAILURE = "tab", "space", "escape", "s", "f"
"""As in lerobot-rollout."""

GRIPPER_KEY, END, RERECORD = "g", "enter", "r"
TAKEN = frozenset({PAUSE, LEAVE, SUCCESS, FAILURE, GRIPPER_KEY, END, RERECORD})
"""Keys that mean something, whoever moves the arm with what."""

KEYS = {
    "Tab": "take over, hand back",
    "Arrows": "right, left, away, near",
    "E, D": "up, down",
    "G": "close or open the gripper",
    "Space": "pause, go on",
    "S": "success: end and keep",
    "F": "failure: end",
    "Enter": "end, as the task judges",
    "R": "repeat, keep nothing",
    "Esc": "leave",
}
"""What the panel beside the scene says, and docs/how_to/record.md."""

_VERDICTS = {SUCCESS: Verdict.SUCCESS, FAILURE: Verdict.FAILURE, END: Verdict.ENDED, RERECORD: Verdict.DISCARD}
_EVENTS = (
    (TeleopEvents.RERECORD_EPISODE, Verdict.DISCARD),
    (TeleopEvents.SUCCESS, Verdict.SUCCESS),
    (TeleopEvents.FAILURE, Verdict.FAILURE),
    (TeleopEvents.TERMINATE_EPISODE, Verdict.FAILURE),
)
"""The first that is set says how the attempt ends: LeRobot sets 'terminate' beside the others."""


class PersonLeftError(KeyboardInterrupt):
    """The person wants to leave: the command ends as with Ctrl-C, and what was saved is safe."""


class Controls:
    """What a person wants, by both, read once per step.

    Args:
        teleop: A connected teleoperator; `get_teleop_events` is used if it has it.
        keys: The window's.
        toggles: Whether a press of the key takes over, or hands back; otherwise it is held.
        override: The key.

    Attributes:
        action: What the teleoperator gives.
        overrides: They want to act instead of the policy.
        toggles_gripper, toggles_pause: They pressed for it.
        verdict: How they end the attempt, if so.
    """

    def __init__(self, teleop: Teleoperator, keys: WindowKeys, toggles: bool, override: str) -> None:
        self._teleop, self._keys = teleop, keys
        self._toggles, self._override, self._is_on = toggles, override, False
        self._events: dict[TeleopEvents, bool] = {}
        self.action: Mapping[str, Any] = {}
        self.overrides = self.toggles_gripper = self.toggles_pause = False
        self.verdict: Verdict | None = None

    def reset(self) -> None:
        """A new attempt: nobody has taken over."""
        self._is_on = False

    def read(self) -> None:
        """Takes in what a person wants now; what was pressed counts once, and then never again.

        Raises:
            PersonLeftError: They want to end the session, or unplugged the teleoperator.
            ExpertError: The teleoperator does not answer.
        """
        self._keys.look()
        if not self._teleop.is_connected or LEAVE in self._keys.pressed:
            raise PersonLeftError
        try:
            self.action = self._teleop.get_action()
        except OSError as error:  # of LeRobot's bus
            raise ExpertError(f"The teleoperator no longer answers: {error}. What was saved is safe.") from error
        events = dict(self._teleop.get_teleop_events()) if hasattr(self._teleop, "get_teleop_events") else {}
        began = {event for event, is_on in events.items() if is_on and not self._events.get(event, False)}
        self._events = events
        pressed = self._keys.pressed
        self._is_on ^= pressed.count(self._override) % 2 == 1
        by_key = self._is_on if self._toggles else self._override in self._keys.held
        self.overrides = by_key or events.get(TeleopEvents.IS_INTERVENTION, False)
        self.toggles_gripper = pressed.count(GRIPPER_KEY) % 2 == 1
        self.toggles_pause = pressed.count(PAUSE) % 2 == 1
        ends = [verdict for key, verdict in _VERDICTS.items() if key in pressed]
        ends += [verdict for event, verdict in _EVENTS if event in began]
        self.verdict = ends[0] if ends else None


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


class ActionMapping:
    """Makes action vectors of a teleoperator's.

    A teleoperator that moves the hand (`delta_x`, `delta_y`, `delta_z`) fits an environment whose actions are three
    displacements, or these and a gripper (> 0 closes). Any other fits an environment with as many numbers as it gives.

    Args:
        features: The teleoperator's `action_features`.
        space: The environment's actions.
        directions: What moves the hand along x, y and z: three of `x`, `y`, `z`, with `-` for the opposite direction.
        speed: What a full displacement of the teleoperator is for the environment, whose largest is 1.

    Raises:
        ExpertError: They do not fit, or `directions` is none.
    """

    def __init__(self, features: Mapping[str, Any], space: gym.Space, directions: str, speed: float) -> None:
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise ExpertError(f"A person can act where actions are a Box of one dimension; here they are {space}.")
        self._names = action_names(features)
        self._low, self._high, self._speed = space.low, space.high, speed
        n = space.shape[0]
        self.moves_hand = set(DELTAS) <= set(self._names)
        self.has_gripper = self.moves_hand and n == len(DELTAS) + 1
        if n != len(self._names) and not (self.moves_hand and n in (3, 4)):
            raise ExpertError(
                f"The teleoperator gives {', '.join(self._names) or 'nothing'}, and the environment's action is {n} numbers. "
                "Give a teleoperator of the end effector (--expert.teleop.type=keyboard_window, gamepad) for "
                "actions dx, dy, dz and gripper, or one with as many numbers as the action has."
            )
        self._axes, self._signs = _parse(directions)

    def vector(self, action: Mapping[str, Any], gripper: float = 0.0) -> np.ndarray:
        """The action vector (action dim,), inside the environment's limits.

        Args:
            action: What the teleoperator's `get_action` returned.
            gripper: The command to the gripper, if there is one.
        """
        if self.moves_hand:
            deltas = np.array([float(action[name]) for name in DELTAS])
            values = list(self._speed * self._signs * deltas[self._axes])
            values += [gripper] if self.has_gripper else []
        else:
            values = [float(action[name]) for name in self._names]
        return np.asarray(values, np.float32).clip(self._low, self._high)

    def closes(self, action: Mapping[str, Any]) -> bool | None:
        """Whether a teleoperator's action closes the gripper, or opens it; None where it says neither."""
        return _CLOSES.get(action.get(GRIPPER)) if self.moves_hand else None


class Gripper:
    """What the gripper is told, whoever tells it: after a change the next one is blocked for a while.

    The environment does the same, so that recorded commands are those that were carried out.

    Args:
        cooldown_steps: For how many steps.
    """

    def __init__(self, cooldown_steps: int) -> None:
        self._cooldown_steps = cooldown_steps
        self.reset()

    def reset(self) -> None:
        """It is open and may change at once."""
        self.is_closed = False
        self._steps_since_change = self._cooldown_steps

    @property
    def blocked_steps(self) -> int:
        """Steps until it may change again."""
        return max(self._cooldown_steps - self._steps_since_change, 0)

    def wish(self, close: bool) -> bool:
        """What it can be told in the next step, if a person wants it to close, or to open."""
        return self.is_closed if self.blocked_steps else close

    def follow(self, close: bool) -> None:
        """A step was made in which the gripper was told to close, or to open."""
        self._steps_since_change += 1
        if close != self.is_closed and self._steps_since_change > self._cooldown_steps:
            self.is_closed, self._steps_since_change = close, 0


def action_names(features: Mapping[str, Any]) -> list[str]:
    """The numbers that a teleoperator gives, in their order. LeRobot has two ways to declare them."""
    names = features.get("names", features)
    return sorted(names, key=names.__getitem__) if "names" in features and isinstance(names, dict) else list(names)


def _parse(directions: str) -> tuple[np.ndarray, np.ndarray]:
    parts = [part.strip() for part in directions.split(",")]
    axes = [part.lstrip("+-") for part in parts]
    if sorted(axes) != ["x", "y", "z"] or any(len(part) > 2 for part in parts):
        raise ExpertError(
            f"--expert.directions={directions!r}: give x, y and z in some order, - for the opposite direction, such "
            "as -y,x,z."
        )
    return np.array(["xyz".index(axis) for axis in axes]), np.array([-1.0 if p[0] == "-" else 1.0 for p in parts])
