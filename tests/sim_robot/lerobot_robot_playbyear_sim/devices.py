"""The robot and its leader, as LeRobot sees them."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig, TeleopEvents

from lerobot_robot_playbyear_sim.link import Link

ACTIONS = ("dx", "dy", "dz", "grip")
STATES = ("x", "y", "z", "finger_left", "finger_right", "finger_left_speed", "finger_right_speed")


@RobotConfig.register_subclass("playbyear_sim")
@dataclass(kw_only=True)
class PlaybyearSimConfig(RobotConfig):
    """The arm of the task that `simulation.py` runs behind a socket."""

    socket: str
    image_size: int = 84


class PlaybyearSim(Robot):
    config_class = PlaybyearSimConfig
    name = "playbyear_sim"

    def __init__(self, config: PlaybyearSimConfig) -> None:
        super().__init__(config)
        self.config = config
        self._link: Link | None = None

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        return {**dict.fromkeys(STATES, float), "front": (self.config.image_size, self.config.image_size, 3)}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(ACTIONS, float)

    is_calibrated = True

    @property
    def is_connected(self) -> bool:
        return self._link is not None

    def connect(self, calibrate: bool = True) -> None:
        self._link = Link(self.config.socket)

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def reset_episode(self, seed: int | None) -> None:
        """As a person would, who sets the scene up."""
        self._ask("reset", seed=seed)

    def get_observation(self) -> dict[str, Any]:
        answer = self._ask("observe")
        return {**dict(zip(STATES, answer["state"], strict=True)), "front": answer["picture"]}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        values = [float(action[name]) for name in ACTIONS]
        assert np.isfinite(values).all(), "the robot was told to go to a place that is not finite"
        self._ask("act", action=values)
        return action

    def disconnect(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _ask(self, what: str, **more: Any) -> dict[str, Any]:
        if self._link is None:
            raise ConnectionError("not connected")
        try:
            return self._link.ask(what, **more)
        except (OSError, EOFError):
            self.disconnect()
            raise


@TeleoperatorConfig.register_subclass("playbyear_sim_leader")
@dataclass(kw_only=True)
class PlaybyearSimLeaderConfig(TeleoperatorConfig):
    """A person who never sleeps: the task's script moves the leader.

    Args:
        socket: Of the simulation.
        judges: Whether it also says when the task is solved, and takes over when the script would.
        demonstrates: Whether the script is that of demonstrations; otherwise that of corrections.
    """

    socket: str
    judges: bool = True
    demonstrates: bool = False


class PlaybyearSimLeader(Teleoperator):
    config_class = PlaybyearSimLeaderConfig
    name = "playbyear_sim_leader"
    feedback_features: dict[str, Any] = {}  # noqa: RUF012
    is_calibrated = True

    def __init__(self, config: PlaybyearSimLeaderConfig) -> None:
        super().__init__(config)
        self.config = config
        self._link: Link | None = None

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(ACTIONS, float)

    @property
    def is_connected(self) -> bool:
        return self._link is not None

    def connect(self, calibrate: bool = True) -> None:
        self._link = Link(self.config.socket)

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_action(self) -> dict[str, Any]:
        assert self._link is not None
        return dict(
            zip(ACTIONS, self._link.ask("script", demonstrates=self.config.demonstrates)["action"], strict=True)
        )

    def get_teleop_events(self) -> dict[TeleopEvents, bool]:
        assert self._link is not None
        if not self.config.judges:
            return {}
        status = self._link.ask("status")
        return {
            TeleopEvents.IS_INTERVENTION: status["wants_control"],
            TeleopEvents.SUCCESS: status["success"],
            TeleopEvents.FAILURE: status["failed"],
        }

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...

    def disconnect(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()
