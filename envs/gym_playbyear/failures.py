"""In which way an attempt failed, from the simulator's state: the list of the paper's appendix, and what our tasks add.

Unlike `info["end"]` this says what had come before: an attempt that ran out of time may have lost the thing on its way.
"""

from typing import Any

import numpy as np

NO_SEARCH, NO_CONTACT = "no contact, no search", "no contact"
NO_GRASP, FALSE_GRASP, NO_LIFT = "contact but no grasp", "false grasp", "unsuccessful lift"
DROPPED, OUTSIDE = "dropped", "placed outside"
MODES = (NO_SEARCH, NO_CONTACT, NO_GRASP, FALSE_GRASP, NO_LIFT, DROPPED, OUTSIDE)
"""Of tasks whose hidden thing can be touched. Protective stops are told by their own names, such as "pressed"."""

_STOPS = ("pressed", "torn", "shoved")
_TOUCH, _GRIP = 0.2, 1.0  # N: from which on it counts as a contact, and as held between the fingers
_CLOSED = 0.9  # share of the opening below which the hand is closed
_EMPTY = 0.004  # m between fingers that hold nothing
_LIFTED = 0.01  # m
_APART = 0.15  # s without contact after which a lifted thing was let go, and not only held loosely
_SEARCHED = 0.03  # m that the hand moved aside near the height of the thing
_NEAR = 0.06  # m above it
_AT_THE_TRAY = 0.1  # m from its middle


class FailureMode:
    """Watches an attempt.

    Args:
        env: The unwrapped environment, a `TaskEnv`, that was just reset.
    """

    def __init__(self, env: Any):
        hidden = [prop.name for prop in env.definition.props if prop.hidden]
        self._thing = next((name for name in hidden if ("gripper", name) in env.pairs), None)
        if self._thing is None:
            return
        self._first_z = float(env.position(self._thing)[2])
        self._touched = self._held = self._lifted = self._closed_on_nothing = False
        self._n_apart, self._let_go_at = 0, None
        self._way, self._hand = 0.0, env.eef_position

    def look(self, env: Any) -> None:
        """Once after every control step."""
        if self._thing is None:
            return
        place, hand = env.position(self._thing), env.eef_position
        force, opening = env.contact_forces[f"gripper-{self._thing}"], float(env.finger_positions.sum())
        is_closed = opening < _CLOSED * env.definition.arm.max_opening
        self._touched |= bool(force > _TOUCH)
        self._held |= bool(is_closed and force > _GRIP and opening > _EMPTY)
        self._closed_on_nothing |= opening < _EMPTY
        self._lifted |= bool(force > _TOUCH and is_closed and place[2] > self._first_z + _LIFTED)
        self._n_apart = 0 if force > _TOUCH or not self._lifted else self._n_apart + 1
        if self._let_go_at is None and self._n_apart >= max(1, round(_APART * env.control_hz)):
            self._let_go_at = place
        if hand[2] < self._first_z + _NEAR:
            self._way += float(np.linalg.norm((hand - self._hand)[:2]))
        self._hand = hand

    def told(self, env: Any, end: str) -> str:
        """How the attempt failed.

        Args:
            env: The environment after the last step.
            end: What `info["end"]` says.
        """
        if self._thing is None:
            return end
        if self._let_go_at is not None:
            tray = getattr(env, "shown", {}).get("bin_position")
            return DROPPED if tray is None or _aside(tray, self._let_go_at) > _AT_THE_TRAY else OUTSIDE
        if self._lifted or self._held:
            return NO_LIFT
        if end in _STOPS:
            return end
        if self._closed_on_nothing:
            return FALSE_GRASP
        if self._touched:
            return NO_GRASP
        return NO_CONTACT if self._way > _SEARCHED else NO_SEARCH


def _aside(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm((np.asarray(one) - other)[:2]))
