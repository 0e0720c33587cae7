"""A camera that looks at a lamp which is switched with every tap."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.cameras import Camera, CameraConfig

from lerobot_robot_playbyear_sim.link import Link


@CameraConfig.register_subclass("playbyear_sim_lamp")
@dataclass(kw_only=True)
class PlaybyearSimLampConfig(CameraConfig):
    """Args:
    socket: Of the simulation.
    """

    socket: str
    fps: int | None = 60
    width: int | None = 160
    height: int | None = 120


class PlaybyearSimLamp(Camera):
    config_class = PlaybyearSimLampConfig
    name = "playbyear_sim_lamp"

    def __init__(self, config: PlaybyearSimLampConfig) -> None:
        super().__init__(config)
        self._path = config.socket
        self._link: Link | None = None

    @property
    def is_connected(self) -> bool:
        return self._link is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        return []

    def connect(self, warmup: bool = True) -> None:
        self._link, self._next = Link(self._path), time.perf_counter()

    def read(self) -> np.ndarray:
        return self.async_read()

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        """The next picture, when it is taken."""
        assert self.fps is not None
        time.sleep(max(self._next - time.perf_counter(), 0))
        picture = self._picture(self._next)
        self._next = max(self._next + 1 / self.fps, time.perf_counter())
        return picture

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        return self._picture(time.perf_counter())

    def _picture(self, at_s: float) -> np.ndarray:
        assert self._link is not None
        taps = np.array(self._link.ask("taps")["heard_at_s"])
        picture = np.full((120, 160, 3), 40, np.uint8)
        picture[40:80, 60:100] += np.uint8(150 * (int((taps <= at_s).sum()) % 2))
        return picture

    def disconnect(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()
