"""What a person wants in this step: the window's keys and a LeRobot teleoperator's events, taken together."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lerobot.teleoperators import Teleoperator, TeleopEvents
from lerobot.teleoperators.keyboard import KeyboardEndEffectorTeleop, KeyboardTeleop

from lerobot_playbyear.compat import held_keys
from lerobot_playbyear.episodes.episode import Verdict
from lerobot_playbyear.teleoperation.actions import DELTAS, GRIPPER, STAY
from lerobot_playbyear.teleoperation.keyboard import WindowKeys

OVERRIDE, GRIPPER_KEY, PAUSE, SUCCESS, RERECORD, FAILURE, LEAVE = "space", "g", "p", "s", "r", "q", "escape"
TAKEN = frozenset({GRIPPER_KEY, PAUSE, SUCCESS, RERECORD, FAILURE, LEAVE})
"""Keys that mean something."""

_VERDICTS = {SUCCESS: Verdict.SUCCESS, RERECORD: Verdict.DISCARD, FAILURE: Verdict.FAILURE}
_EVENTS = (
    (TeleopEvents.RERECORD_EPISODE, Verdict.DISCARD),
    (TeleopEvents.SUCCESS, Verdict.SUCCESS),
    (TeleopEvents.FAILURE, Verdict.FAILURE),
    (TeleopEvents.TERMINATE_EPISODE, Verdict.FAILURE),
)
"""The first that is set says how the attempt ends: LeRobot sets 'terminate' beside the others."""

_NO_MOVE = {**dict.fromkeys(DELTAS, 0.0), GRIPPER: STAY}


class PersonLeftError(KeyboardInterrupt):
    """The person wants to leave: the command ends as with Ctrl-C, and what was saved is safe."""


@dataclass(frozen=True)
class Wish:
    """What a person wants.

    Attributes:
        action: What the teleoperator gives.
        overrides: They want to act instead of the policy.
        toggles_gripper, toggles_pause: They pressed for it.
        verdict: How they end the attempt, if so.
        leaves: They want to end the session.
    """

    action: Mapping[str, Any]
    overrides: bool = False
    toggles_gripper: bool = False
    toggles_pause: bool = False
    verdict: Verdict | None = None
    leaves: bool = False


class Controls:
    """Reads both once per step.

    Args:
        teleop: A connected teleoperator; `get_teleop_events` is used if it has it.
        keys: The window's.
        toggles: Whether a press of the key takes over, or hands back, instead of holding it.
        override: The key.
    """

    def __init__(self, teleop: Teleoperator, keys: WindowKeys, toggles: bool = False, override: str = OVERRIDE) -> None:
        self._teleop, self._keys = teleop, keys
        self._toggles, self._override, self._is_on = toggles, override, False
        self._events: dict[TeleopEvents, bool] = {}

    def reset(self) -> None:
        """A new attempt: nobody has taken over."""
        self._is_on = False

    def read(self) -> Wish:
        """What a person wants now; what was pressed counts once, and then never again."""
        if not self._teleop.is_connected:
            return Wish(action={}, leaves=True)
        self._keys.look()
        action: Mapping[str, Any] = self._teleop.get_action()
        events = _events_of(self._teleop)
        if isinstance(self._teleop, KeyboardTeleop) and not self._keys.has_focus:
            events, action = {}, _NO_MOVE  # it hears what is typed into other windows, too
        began = {event for event, is_on in events.items() if is_on and not self._events.get(event, False)}
        self._events = events
        pressed = self._keys.pressed
        verdict = next((verdict for key, verdict in _VERDICTS.items() if key in pressed), None)
        self._is_on ^= pressed.count(self._override) % 2 == 1
        by_key = self._is_on if self._toggles else self._override in self._keys.held
        return Wish(
            action=action,
            overrides=by_key or events.get(TeleopEvents.IS_INTERVENTION, False),
            toggles_gripper=pressed.count(GRIPPER_KEY) % 2 == 1,
            toggles_pause=pressed.count(PAUSE) % 2 == 1,
            verdict=verdict or next((verdict for event, verdict in _EVENTS if event in began), None),
            leaves=LEAVE in pressed,
        )


def _events_of(teleop: Teleoperator) -> dict[TeleopEvents, bool]:
    if not hasattr(teleop, "get_teleop_events"):
        return {}
    if not isinstance(teleop, KeyboardEndEffectorTeleop):
        return dict(teleop.get_teleop_events())
    # LeRobot's keyboard forgets held keys when it is asked for events, until the screen repeats them half a second later.
    # Released ones stay forgotten: it would let them cancel the opposite direction.
    keys = held_keys(teleop)
    held = {key: True for key, is_pressed in keys.items() if is_pressed}
    events = dict(teleop.get_teleop_events())
    keys.update(held)
    return events
