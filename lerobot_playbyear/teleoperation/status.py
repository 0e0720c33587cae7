"""What the window tells a person, as it travels to the window's process."""

from dataclasses import dataclass, field
from enum import StrEnum

HISTORY_S = 4.0
"""How far back the microphones' levels are shown [s]."""


class Control(StrEnum):
    """Who acts; where a person is called, it is the policy that asks them to take over."""

    POLICY = "policy"
    CALLED = "called"
    PERSON = "person"
    PAUSED = "paused"
    WAITING = "waiting"


@dataclass
class Status:
    """One frame's worth of facts.

    Attributes:
        control: Who acts.
        task: What is to be done, in words.
        attempt: Its number, counted from 1.
        step, n_steps: Steps done, and the most that there are.
        fps: Steps per second that are wanted.
        achieved_fps: Those of the last second; 0 while unknown.
        gripper: `open`, `closed`, or nothing for an arm without one.
        cooldown_s: Until the gripper may change again [s].
        levels_db: Of each microphone over each of the last steps, the newest last [dB of full scale].
        sound: Why nothing is heard; empty if it is.
        keys: What to press, and what it does.
        note: What happened last.
        waiting: What goes on when no frame comes.
    """

    control: Control = Control.WAITING
    task: str = ""
    attempt: int = 0
    step: int = 0
    n_steps: int = 0
    fps: float = 0.0
    achieved_fps: float = 0.0
    gripper: str = ""
    cooldown_s: float = 0.0
    levels_db: dict[str, list[float]] = field(default_factory=dict)
    sound: str = ""
    keys: list[tuple[str, str]] = field(default_factory=list)
    note: str = ""
    waiting: str = ""

    @property
    def is_slow(self) -> bool:
        """Whether simulation and policy do not keep up."""
        return 0 < self.achieved_fps < 0.93 * self.fps
