"""`--env.type=playbyear_robot`: its options."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import lerobot.cameras
import lerobot.robots
from draccus.utils import DecodingError
from gymnasium.vector import AutoresetMode
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.processor import PolicyProcessorPipeline
from lerobot.robots import RobotConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from lerobot_playbyear.audio.sound_picture import SoundPicture
from lerobot_playbyear.compat import import_devices
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.sound_pictures import pictures_for
from lerobot_playbyear.microphones.config import MicrophoneConfig, register_microphone_plugins
from lerobot_playbyear.policy.environment_sound import Pcm16ToFloatProcessorStep
from lerobot_playbyear.robots import ENV_ID
from lerobot_playbyear.robots.end_effector_config import EndEffectorConfig


def register_devices() -> None:
    """Makes the robots and cameras that LeRobot brings known by their types, and other people's microphones."""
    for package in (lerobot.robots, lerobot.cameras):
        import_devices(package)
    register_microphone_plugins()


register_devices()


@EnvConfig.register_subclass("playbyear_robot")
@dataclass
class RobotEnvConfig(EnvConfig):
    """A LeRobot robot with microphones, in real time.

    Args:
        task: What is to be done, in words; datasets and policies get it.
        fps: Ticks per second [Hz]: pictures, actions and blocks of sound.
        robot: The robot, as for lerobot-record.
        end_effector: Actions are displacements of the hand instead of the robot's joints. None: they are the robot's own.
        microphones: By their names.
        spectrogram: For policies that look at pictures of sound: the folder of the dataset that they learned from, made by
            `playbyear-attach-spectrogram`, or its `meta/info.json`.
        episode_s: How long an attempt may take [s].
        camera_latency_s: How long after it was exposed a picture arrives [s]; `playbyear-calibrate-latency` measures it.
        rest: Where the arm goes before every attempt, by joint, such as `{shoulder_pan.pos: 0}`. None: where it was when the
            program began.
        rest_s: How long it takes to go there [s].
        wait_for_person: Whether every attempt begins when a person says so.
        console: Where a person sees what goes on, and presses keys: `window`, `terminal`, `none`, or `auto`: what there is.
        max_relative_target: For robots, and each arm of those with two, that have this option and were not given it: how far
            from where it is a joint may be told to go, in its units. None: as far as it likes.
        max_step: How much what a joint is told may change from one tick to the next, in its units. None: no limit.
        stall_s: An attempt ends when the loop stood still for as long [s].
        frozen_s: A camera whose picture is the same to the last bit for as long is taken for dead [s]; 0: never.
        silent_s: A microphone that gives nothing but zeros for as long is taken for unplugged [s]; 0: never.
        calibrate: Whether LeRobot asks for a calibration when the robot has none.

    Raises:
        DecodingError: A value does not work. LeRobot's commands print it as one line and stop.
    """

    task: str | None = "Do the task."
    fps: int = 30
    robot: RobotConfig | None = None
    end_effector: EndEffectorConfig | None = None
    microphones: dict[str, MicrophoneConfig] = field(default_factory=dict)
    spectrogram: str | None = None
    episode_s: float = 30.0
    camera_latency_s: float = 0.0
    rest: dict[str, float] | None = None
    rest_s: float = 2.0
    wait_for_person: bool = True
    console: str = "auto"
    max_relative_target: float | None = 20.0
    max_step: float | None = 10.0
    stall_s: float = 0.5
    frozen_s: float = 2.0
    silent_s: float = 2.0
    calibrate: bool = True

    def __post_init__(self) -> None:
        if self.console not in ("auto", "window", "terminal", "none"):
            raise self._error("console", "give auto, window, terminal or none")
        for name in ("fps", "episode_s", "rest_s", "stall_s"):
            if not 0 < getattr(self, name) < 1e6:
                raise self._error(name, "give a number above 0")
        for name in ("camera_latency_s", "frozen_s", "silent_s"):
            if not 0 <= getattr(self, name) < 1e6:
                raise self._error(name, "give 0 or more seconds")
        for name in ("max_relative_target", "max_step"):
            limit = getattr(self, name)
            if limit is not None and not limit > 0:
                raise self._error(name, "give a number above 0, or null for none")
        for name, microphone in self.microphones.items():
            if microphone.latency_s - self.camera_latency_s >= 1 / self.fps:
                raise DecodingError(
                    ("env", "microphones", name, "latency_s"),
                    f"{microphone.latency_s} does not work: sound that comes so much later than pictures "
                    f"(--env.camera_latency_s={self.camera_latency_s}) makes every tick wait for longer than its "
                    f"{1 / self.fps:.3f} s. Give a smaller --env.fps, or take a card that is faster.",
                )
            if microphone.sample_rate % self.fps:
                nearest = max(round(microphone.sample_rate / self.fps), 1) * self.fps
                raise DecodingError(
                    ("env", "microphones", name, "sample_rate"),
                    f"{microphone.sample_rate} does not work: each of the {self.fps} ticks per second must hold the same "
                    f"number of samples; give a multiple of {self.fps}, such as {nearest}, or another --env.fps.",
                )
        self.sound_pictures()

    def sound_pictures(self) -> list[SoundPicture]:
        """The pictures of sound that policies look at, besides those of the robot's cameras.

        Raises:
            DecodingError: They cannot be made from these microphones.
        """
        if self.spectrogram is None:
            return []
        rates = {name: microphone.sample_rate for name, microphone in self.microphones.items()}
        cameras = list(getattr(self.robot, "cameras", None) or {})
        try:
            return pictures_for(self.spectrogram, rates, self.fps, cameras)
        except InputError as error:
            raise self._error("spectrogram", str(error).rstrip(".")) from error

    @property
    def is_real_time(self) -> bool:
        """An attempt takes a person's time."""
        return True

    @property
    def robot_type(self) -> str:
        """Of the robot, for datasets."""
        return self.robot.type if self.robot is not None else str(self.type)

    @property
    def package_name(self) -> str:
        return "lerobot_playbyear.robots"

    @property
    def gym_id(self) -> str:
        return ENV_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"config": self}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """The robot, as LeRobot's commands want environments: one, however many are asked for.

        Returns:
            {"playbyear_robot": {0: the vector environment of one robot}}.

        Raises:
            RobotError: No robot is given, or it cannot be used.
        """

        def make() -> gym.Env:
            return gym.make(ENV_ID, disable_env_checker=True, config=self)

        vec = gym.vector.SyncVectorEnv([freeze_after_episode_end(make)], autoreset_mode=AutoresetMode.SAME_STEP)
        self.describe(vec.single_observation_space, vec.single_action_space)
        return {self.type: {0: vec}}

    def describe(self, observations: Any, actions: Any) -> None:
        """Fills in `features` and `features_map`, which policies that are made without a dataset read."""
        entries: dict[str, tuple[FeatureType, tuple[int, ...], str]] = {
            ACTION: (FeatureType.ACTION, actions.shape, ACTION)
        }
        for key, space in observations.spaces.items():
            if key == "pixels":
                for camera, box in space.spaces.items():
                    entries[f"pixels/{camera}"] = (FeatureType.VISUAL, box.shape, f"{OBS_IMAGES}.{camera}")
            else:
                name = OBS_STATE if key == "agent_pos" else f"observation.{key}"
                entries[key] = (FeatureType.STATE, space.shape, name)
        self.features = {key: PolicyFeature(type=kind, shape=shape) for key, (kind, shape, _) in entries.items()}
        self.features_map = {key: name for key, (_, _, name) in entries.items()}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """What LeRobot runs on each observation before, and on each action after, the policy's own processors."""
        return PolicyProcessorPipeline(steps=[Pcm16ToFloatProcessorStep()]), PolicyProcessorPipeline(steps=[])

    def _error(self, name: str, what_to_do: str) -> DecodingError:
        return DecodingError(("env", name), f"{getattr(self, name)!r} does not work: {what_to_do}.")
