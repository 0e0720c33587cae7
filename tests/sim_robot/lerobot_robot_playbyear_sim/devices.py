"""The robot and its leader, as LeRobot sees them."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig

from lerobot_robot_playbyear_sim.arm import SimulatedArm, SimulatedLeader
from lerobot_robot_playbyear_sim.link import Link

# In the order of the environment's `action` and `agent_pos`; LeRobot hands on what ends in .pos or .vel.
ACTIONS = ("dx.vel", "dy.vel", "dz.vel", "grip.pos")
STATES = (
    *("x.pos", "y.pos", "z.pos", "finger_left.pos", "finger_right.pos"),
    *("finger_left_speed.vel", "finger_right_speed.vel"),
)


@RobotConfig.register_subclass("playbyear_sim")
@dataclass(kw_only=True)
class PlaybyearSimConfig(RobotConfig):
    """The arm of the task that `simulation.py` runs behind a socket.

    Args:
        socket: Of the simulation.
        image_size: Of its own camera `front` [pixels].
        cameras: Further ones, microphones among them.
    """

    socket: str
    image_size: int = 84
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class PlaybyearSim(SimulatedArm):
    config_class = PlaybyearSimConfig
    name = "playbyear_sim"
    states, actions = STATES, ACTIONS

    def __init__(self, config: PlaybyearSimConfig) -> None:
        super().__init__(config)
        self.front_size = (config.image_size, config.image_size)
        self._link: Link | None = None

    @property
    def is_connected(self) -> bool:
        return self._link is not None and all(camera.is_connected for camera in self.cameras.values())

    def connect(self, calibrate: bool = True) -> None:
        self._link = Link(self.config.socket)
        for camera in self.cameras.values():
            camera.connect()

    def get_observation(self) -> dict[str, Any]:
        answer = self._ask("observe")
        return {**dict(zip(STATES, answer["state"], strict=True)), "front": answer["picture"], **self.pictures()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        if not action.keys() >= set(ACTIONS):  # a place to go to: this arm knows speeds alone, and holds
            return {}
        values = [float(action[name]) for name in ACTIONS]
        assert np.isfinite(values).all(), "the robot was told to go to a place that is not finite"
        self._ask("act", action=values)
        return action

    def disconnect(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()
        for camera in self.cameras.values():
            if camera.is_connected:
                camera.disconnect()

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
        demonstrates: Whether the script is that of demonstrations; otherwise that of corrections.
    """

    socket: str
    demonstrates: bool = False


class PlaybyearSimLeader(SimulatedLeader):
    config_class = PlaybyearSimLeaderConfig
    name = "playbyear_sim_leader"
    actions = ACTIONS
    _link: Link | None = None

    @property
    def is_connected(self) -> bool:
        return self._link is not None

    def connect(self, calibrate: bool = True) -> None:
        self._link = Link(self.config.socket)

    def get_action(self) -> dict[str, Any]:
        assert self._link is not None
        answer = self._link.ask("script", demonstrates=self.config.demonstrates)
        return dict(zip(ACTIONS, answer["action"], strict=True))

    def disconnect(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()
