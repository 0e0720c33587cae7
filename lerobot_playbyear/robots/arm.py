"""A LeRobot robot, as the environment needs it: vectors instead of names, limits, and a hold that is always possible."""

import copy
import inspect
import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np
from lerobot.robots import Robot, RobotConfig, make_robot_from_config

from lerobot_playbyear.episodes.terminal import alone
from lerobot_playbyear.robots.parts import RobotError, fill_in_limit, names_of
from lerobot_playbyear.teleoperation.leader import close_parts, let_go

_VELOCITY = (".vel", "_vel")
_MOVE_FPS, _PIECE_S = 30, 0.2
_NEAR = 2.0  # degrees, or percent of a joint's range
_GRIPPER = "gripper"
_RECENT_S = 1.0  # for as long an arm that does not answer is taken to be where it was seen


class Arm:
    """A robot that gets nothing but finite, limited actions.

    Args:
        config: Of the robot.
        max_relative_target: Filled in where the robot, or an arm of one that has two, has this option and was not given it.
        max_step: How much what a joint is told may change from one action to the next; None: no limit.
        calibrate: Whether LeRobot asks for a calibration when there is none.

    Attributes:
        state_names, action_names: Of the numbers in state and action, in their order.
        cameras: The shape (height, width, 3) of each camera's pictures.
        sent: What it was last told (len(action_names),), as far as the robot says so; None: nothing since it was connected or
            moved to a place.
        n_breaks: How often it was held, moved to a place or connected: what it is told next need not follow from the last.

    Raises:
        RobotError: It cannot be made, or gives something that has no place in an observation.
    """

    def __init__(
        self,
        config: RobotConfig,
        max_relative_target: float | None = None,
        max_step: float | None = None,
        calibrate: bool = True,
    ) -> None:
        config = copy.deepcopy(config)
        is_limited = max_relative_target is None or fill_in_limit(config, max_relative_target)
        try:
            self.robot: Robot = make_robot_from_config(config)
            observations, actions = self.robot.observation_features, self.robot.action_features
        except Exception as error:  # whatever a maker's software may say
            raise RobotError(f"--env.robot.type={config.type} cannot be made: {error}") from error
        self._calibrate, self.max_step = calibrate, max_step
        self.state_names, self.cameras, self.action_names = names_of(config.type, observations, actions)
        # What is told and seen under one name is a place to be at, unless it is a velocity: it holds by being told where it is.
        self._is_place = np.array([n in self.state_names and not n.endswith(_VELOCITY) for n in self.action_names])
        if not is_limited and self.has_a_position:
            logging.warning(
                f"--env.max_relative_target={max_relative_target} does nothing: --env.robot.type={config.type} has no such "
                f"option. Only --env.max_step={max_step} limits what a joint is told, by how much it changes in a tick."
            )
        self._lock = threading.RLock()
        self._last: np.ndarray | None = None
        self.sent: np.ndarray | None = None
        self.n_breaks = 0
        self._told: np.ndarray | None = None  # the last action
        self._seen: np.ndarray | None = None  # its state when it last answered
        self._seen_s = 0.0

    @property
    def has_positions(self) -> bool:
        """Whether its actions are joint targets that are in its state, too: then it holds by being told where it is."""
        return bool(self._is_place.all())

    @property
    def has_a_position(self) -> bool:
        """Whether any of its actions is such a target, in the robot's own units."""
        return bool(self._is_place.any())

    def connect(self) -> None:
        """Connects to robot and cameras; nothing if it is connected.

        Raises:
            RobotError: It cannot.
        """
        if self.robot.is_connected:
            return
        try:
            takes = inspect.signature(self.robot.connect).parameters
            with alone():  # it may ask for its calibration
                self.robot.connect(**({"calibrate": self._calibrate} if "calibrate" in takes else {}))
        except Exception as error:
            close_parts(self.robot)  # LeRobot leaves open what it had opened, and then refuses to connect again
            with_cameras = f" with the cameras {', '.join(self.cameras)}" if self.cameras else ""
            raise RobotError(
                f"The robot {self.robot.name}{with_cameras} cannot be connected: {error} Look at its cable, its power and its "
                "port (lerobot-find-port, lerobot-find-cameras)."
            ) from error
        self._break()
        self._told = None

    def disconnect(self) -> None:
        """Lets go of it; errors are logged."""
        with self._lock:
            let_go(self.robot)

    def begin_episode(self, seed: int | None) -> None:
        """Of a simulated robot that has `reset_episode(seed)`: sets its scene up, as a person does with a real one.

        Raises:
            RobotError: It does not answer.
        """
        reset = getattr(self.robot, "reset_episode", None)
        if callable(reset):
            with self._lock:
                try:
                    reset(seed)
                except Exception as error:
                    raise RobotError(f"The robot {self.robot.name} cannot set its scene up: {error}") from error

    def observe(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Its state (len(state_names),) float32, and each camera's picture (height, width, 3) uint8.

        Raises:
            RobotError: It, or a camera, does not answer, or gives something else than it said.
        """
        try:
            with self._lock:
                observation = self.robot.get_observation()
            state = np.array([float(observation[name]) for name in self.state_names], np.float32)
            pictures = {name: np.asarray(observation[name]) for name in self.cameras}
        except Exception as error:
            raise RobotError(f"The robot {self.robot.name}, or a camera, does not answer: {error}") from error
        for name, picture in pictures.items():
            if picture.shape != self.cameras[name] or picture.dtype != np.uint8:
                raise RobotError(
                    f"The camera {name} gives pictures {picture.dtype} {picture.shape}; wanted uint8 {self.cameras[name]}. "
                    "Give its real width and height."
                )
        if not np.isfinite(state).all():
            bad = [name for name, value in zip(self.state_names, state, strict=True) if not np.isfinite(value)]
            raise RobotError(f"The robot {self.robot.name} gives no finite value for {', '.join(bad)}.")
        self._seen, self._seen_s = state, time.perf_counter()
        return state, pictures

    def send(self, action: np.ndarray) -> None:
        """Sends an action (len(action_names),), changed by no more than the limit per step since the last one.

        Raises:
            ValueError: It is not finite; nothing was sent.
            RobotError: The robot does not answer.
        """
        action = np.asarray(action, np.float64)
        if not np.isfinite(action).all():
            raise ValueError("The action holds a value that is not finite.")
        with self._lock:
            if self.max_step is not None:
                if self._last is None:
                    self._last = self.resting_action()
                near = action.clip(self._last - self.max_step, self._last + self.max_step)
                action = np.where(self._is_place, near, action)
            self._send(action)
            self._last = self._told = action

    def hold(self) -> None:
        """Stops where it is: targets become where the joints are, displacements and velocities become none.

        A gripper goes on to do what it was told.

        Raises:
            RobotError: The robot does not answer.
        """
        with self._lock:
            self._break()
            resting = self.resting_action()
            self._send(resting)
            self._last = resting

    def resting_action(self) -> np.ndarray:
        """The action (len(action_names),) that moves nothing now; of an arm that does not answer: to where it was just seen.

        Raises:
            RobotError: It has not answered for long.
        """
        if not self.has_a_position:
            return np.zeros(len(self.action_names))
        try:
            state, _ = self.observe()
        except RobotError:
            # LeRobot's robots read joints and cameras together: one camera that is gone hides the joints.
            if self._seen is None or time.perf_counter() - self._seen_s > _RECENT_S:
                raise
            state = self._seen
        by_name = dict(zip(self.state_names, state, strict=True))
        if self._told is not None:  # a gripper goes on to squeeze what it holds
            told = dict(zip(self.action_names, self._told, strict=True))
            by_name |= {name: value for name, value in told.items() if _GRIPPER in name}
        places = [by_name.get(name, 0.0) for name in self.action_names]
        return np.where(self._is_place, places, 0.0).astype(np.float64)

    def position(self) -> dict[str, float]:
        """Where each joint is that can be told where to go; none for robots that are moved by displacements."""
        if not self.has_a_position:
            return {}
        state, _ = self.observe()
        by_name = dict(zip(self.state_names, state, strict=True))
        return {name: float(by_name[name]) for name, is_place in self._actions() if is_place}

    def is_away_from(self, target: Mapping[str, float]) -> bool:
        """Whether any of the joints named is elsewhere, by more than a small part of what a joint moves."""
        if not target:
            return False
        place = self.position()
        return any(not abs(place.get(name, np.inf) - value) <= _NEAR for name, value in target.items())

    def move_to(self, target: Mapping[str, float], duration_s: float, stop: Callable[[], bool] = lambda: False) -> bool:
        """Moves there in a straight line; joints that are not named stay.

        Args:
            target: Where to, by joint.
            duration_s: How long it takes [s]; longer where a joint would move faster than `max_step` allows.
            stop: Asked several times a second: then the arm holds.

        Returns:
            Whether it got there.

        Raises:
            RobotError: A name is none of its joints, a value is not finite, or it does not answer.
        """
        from lerobot_playbyear.compat import follower_smooth_move_to

        places = [name for name, is_place in self._actions() if is_place]
        if not set(target) <= set(places) or not np.isfinite(list(target.values())).all():
            raise RobotError(
                f"The robot {self.robot.name} cannot be told to go to {dict(target)}: its joints are {places}, and their "
                "values are finite numbers."
            )
        start = self.by_name(self.resting_action()) | self.position()
        furthest = max((abs(value - start[name]) for name, value in target.items()), default=0.0)
        fastest_s = furthest / (self.max_step * _MOVE_FPS) if self.max_step else 0.0
        n = max(round(max(duration_s, fastest_s) / _PIECE_S), 1)
        try:
            for piece in range(n):
                ends = [
                    {k: start[k] + (v - start[k]) * share / n for k, v in target.items()}
                    for share in (piece, piece + 1)
                ]
                if stop():
                    self.hold()
                    return False
                with self._lock:
                    follower_smooth_move_to(
                        self.robot, start | ends[0], ends[1], max(duration_s, fastest_s) / n, _MOVE_FPS
                    )
        except RobotError:
            raise
        except Exception as error:
            raise RobotError(f"The robot {self.robot.name} does not answer: {error}") from error
        finally:
            self._break()
            self._told = None  # a gripper is where it was moved to
        return True

    def by_name(self, action: np.ndarray) -> dict[str, float]:
        """An action (len(action_names),) as LeRobot's robots take it."""
        return {name: float(value) for name, value in zip(self.action_names, action, strict=True)}

    def _send(self, action: np.ndarray) -> None:
        try:
            sent = self.robot.send_action(self.by_name(action)) or {}
        except Exception as error:
            raise RobotError(f"The robot {self.robot.name} does not take an action: {error}") from error
        self.sent = np.array([sent.get(name, value) for name, value in zip(self.action_names, action, strict=True)])

    def _actions(self) -> Iterator[tuple[str, bool]]:
        return zip(self.action_names, self._is_place, strict=True)

    def _break(self) -> None:
        self._last = self.sent = None
        self.n_breaks += 1
