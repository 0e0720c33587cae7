"""`--env.type=playbyear`: how LeRobot makes the environments and names what they observe."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import torch
from draccus.utils import DecodingError
from gymnasium.vector import AutoresetMode
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.processor import ObservationProcessorStep, PolicyProcessorPipeline, ProcessorStepRegistry
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_PREFIX, OBS_STATE, OBS_STR

from lerobot_env_playbyear.attempts import AsyncVectorEnv, AttemptsFile, SyncVectorEnv, holds_attempts

if TYPE_CHECKING:
    from gym_playbyear.task import Task

SPECTROGRAM = "lerobot_env_playbyear.spectrogram"
"""Group of entry points, by which another distribution brings pictures of sound: a module with `pictures_for` and
`with_sound_pictures`, as `lerobot_playbyear.episodes.spectrogram_env` has them. Nothing here imports it otherwise."""
_OPTIONS = {"horizon": "episode_length", "render_size": "visualization_width", "response": "microphone_response"}
"""What options of the environment are called here."""
_STATE_DIM, _ACTION_DIM, _FORCE_DIM = 7, 4, 6
OBS_AUDIO_PREFIX = OBS_PREFIX + "audio."
PCM_FULL_SCALE = 32768.0  # int16: samples are in [-32768, 32767]


@dataclass
@ProcessorStepRegistry.register(name="playbyear_pcm_to_float")
class PcmToFloatProcessorStep(ObservationProcessorStep):
    """Scales the PCM of an environment's microphones from int16's range to [-1, 1].

    The environment gives `audio.<mic>` as int16 at full scale; LeRobot's `preprocess_observation` makes floats of it
    without scaling them. This step divides every `observation.audio.<mic>`, (B, S) float32 or integer, by 32768, so
    that floats are in [-1, 1] again wherever a policy sees them. It runs once per step, in `lerobot-eval` and in
    `lerobot-train`'s evaluation, both of which ask the environment's configuration for it.

    For environments of other people the policy's distribution has the same step, `playbyear_pcm16_to_float`; neither of the
    two distributions needs the other.
    """

    def observation(self, observation: dict) -> dict:
        for key, value in observation.items():
            if key.startswith(OBS_AUDIO_PREFIX):
                observation[key] = torch.as_tensor(value).to(torch.float32) / PCM_FULL_SCALE  # (B, S)
        return observation

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


@EnvConfig.register_subclass("playbyear")
@dataclass
class PlaybyearEnvConfig(EnvConfig):
    """The simulated tasks, which contact sound solves and a camera does not.

    Args:
        task: `OccludedGrasp-v1`, or another task of `gym_playbyear` or of an installed package.
        fps: Control steps, pictures and blocks of sound per second. Only the task's own rate works. 0: that rate.
        episode_length: Largest number of control steps in an episode. None: the task's own.
        image_size: Height and width of a camera's picture [pixels].
        sample_rate: Samples per second of every microphone [Hz], divisible by `fps`. 0: the task's own.
        sound: `waveform` (int16 PCM per microphone), `contact_force` (the paper's proxy, 6 numbers), or `none`.
        microphones: Names of the microphones, with `sound=waveform`: `gripper`, `room`, `table`. None: the task's own.
        noise_level: Factor on the background noise and the arm's own hum. 1 is the task as published, 0 silence.
        room_noise: A WAV file that plays in the room, over and over; all microphones hear it. None: no further noise.
        room_noise_level: Loudness of that file, relative to the root mean square of the usual background.
        microphone_response: `flat`, or the frequency response of another microphone: `phone`, `dull`, `boomy`.
        spectrogram: For policies that see pictures of the sound: the folder of their dataset, made by
            `playbyear-attach-spectrogram`, or its `meta/info.json`. The same pictures come as `pixels/<microphone>`.
        task_options: The task's own options by name, such as `{cube_material: glass}` or `{contents: pens}`.
        hidden_object: False: the hand passes through the hidden object. Everything else is the same.
        visualization_width, visualization_height: Size of the picture from `render()` [pixels]. Both must be equal.
        attempts_file: File to which each episode appends a line of JSON: seed, steps, success, how it ended, and whether the
            hand acted before anything was heard (`attempts.py`).

    Raises:
        DecodingError: A value is not one that the tasks know. LeRobot's commands print it as one line and stop.
    """

    task: str | None = "OccludedGrasp-v1"
    fps: int = 0
    episode_length: int | None = None
    # Observations
    image_size: int = 84
    sample_rate: int = 0
    sound: str = "waveform"
    microphones: list[str] | None = None
    noise_level: float = 1.0
    room_noise: str | None = None
    room_noise_level: float = 1.0
    microphone_response: str = "flat"
    spectrogram: str | None = None
    # Task
    task_options: dict[str, Any] = field(default_factory=dict)
    hidden_object: bool = True
    # For people
    visualization_width: int = 480
    visualization_height: int = 480
    attempts_file: str | None = None
    # Filled in by __post_init__ from the fields above
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._check()
        cameras = [camera.name for camera in self._definition().cameras]
        picture = (FeatureType.VISUAL, (self.image_size, self.image_size, 3))
        entries: dict[str, tuple[FeatureType, tuple[int, ...], str]] = {
            ACTION: (FeatureType.ACTION, (_ACTION_DIM,), ACTION),
            **{f"pixels/{camera}": (*picture, f"{OBS_IMAGES}.{camera}") for camera in cameras},
            "agent_pos": (FeatureType.STATE, (_STATE_DIM,), OBS_STATE),
        }
        if self.sound == "waveform":
            for mic in self.microphones or []:
                entries[f"audio.{mic}"] = (FeatureType.STATE, (self.samples_per_frame,), f"{OBS_STR}.audio.{mic}")
            for how in self._sound_pictures():
                entries[f"pixels/{how.name}"] = (FeatureType.VISUAL, (how.height, how.width, 3), how.feature)
        elif self.sound == "contact_force":
            entries["contact_force"] = (FeatureType.STATE, (_FORCE_DIM,), f"{OBS_STR}.contact_force")
        self.features = {key: PolicyFeature(type=kind, shape=shape) for key, (kind, shape, _) in entries.items()}
        self.features_map = {key: policy_key for key, (_, _, policy_key) in entries.items()}

    @property
    def samples_per_frame(self) -> int:
        """Samples of one microphone between two frames, S."""
        return self.sample_rate // self.fps

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """The arguments of the tasks' constructor."""
        return {
            "image_size": self.image_size,
            "sample_rate": self.sample_rate,
            "sound": self.sound,
            "noise_level": self.noise_level,
            "microphones": tuple(self.microphones or ()),
            "horizon": self.episode_length,
            "hidden_object": self.hidden_object,
            "room": self._room(),
            "render_mode": "rgb_array",
            "render_size": self.visualization_width,
            **self.task_options,
        }

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Makes `n_envs` environments that step together.

        Each factory imports `gym_playbyear` itself, because the workers of an asynchronous vector environment start
        from a fresh process. An environment whose episode has ended stands still until the next rollout, instead of
        simulating an episode that nobody looks at. When they are closed, the log says in how many episodes the hand acted
        before anything was heard; `acted_early` has it of each, in the order of LeRobot's evaluations.

        Args:
            n_envs: How many, at least 1.
            use_async_envs: One process each instead of all in this one; without effect for `n_envs=1`.

        Returns:
            {"playbyear": {0: the vector environment}}.

        Raises:
            DecodingError: `task` is none that `gym_playbyear` registers.
        """
        self._check()
        _tasks().register_tasks()  # those of distributions that were installed since gym_playbyear was imported
        make: Callable[[], gym.Env] = partial(
            gym.make,
            f"{self.package_name}:{self.gym_id}",
            disable_env_checker=self.disable_env_checker,
            **self.gym_kwargs,
        )
        if self.spectrogram is not None:
            make = self._spectrograms().with_sound_pictures(make, self._sound_pictures())
        if self.attempts_file is not None:
            make = partial(AttemptsFile.around, make, self.attempts_file)
        factories = [freeze_after_episode_end(make) for _ in range(n_envs)]
        vec: gym.vector.VectorEnv
        if use_async_envs and n_envs > 1:
            vec = AsyncVectorEnv(factories, context="forkserver", autoreset_mode=AutoresetMode.SAME_STEP)
        else:
            vec = SyncVectorEnv(factories, autoreset_mode=AutoresetMode.SAME_STEP)
        return {self.type: {0: vec}}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """What LeRobot runs on each observation before, and on each action after, the policy's own processors."""
        return PolicyProcessorPipeline(steps=[PcmToFloatProcessorStep()]), PolicyProcessorPipeline(steps=[])

    def _room(self) -> dict[str, Any] | None:
        """Options of `gym_playbyear.room.Room`, or None for the task's own room."""
        if self.sound != "waveform" or (self.room_noise is None and self.microphone_response == "flat"):
            return None
        return {"noise": self.room_noise, "noise_level": self.room_noise_level, "response": self.microphone_response}

    def _definition(self) -> "Task":
        return self._asked(lambda: _tasks().registry.make_definition(self.task or "", self.task_options))

    def _spectrograms(self) -> Any:
        """What makes pictures of sound; of another distribution."""
        points = tuple(entry_points(group=SPECTROGRAM))
        if not points:
            raise self._error("spectrogram", "install lerobot_policy_playbyear, which makes the pictures")
        return points[0].load()

    def _sound_pictures(self) -> list[Any]:
        if self.spectrogram is None:
            return []
        rates = dict.fromkeys(self.microphones or [], self.sample_rate)
        cameras = [camera.name for camera in self._definition().cameras]
        makes = self._spectrograms()
        try:
            return makes.pictures_for(self.spectrogram, rates, self.fps, cameras)
        except ValueError as error:
            raise self._error("spectrogram", str(error).rstrip(".")) from error

    def _check(self) -> None:
        definition = self._definition()
        hz = definition.control_hz
        self.fps, self.sample_rate = self.fps or hz, self.sample_rate or definition.sample_rate
        if self.microphones is None:
            self.microphones = list(definition.microphones)
        if self.fps != hz:
            raise self._error("fps", f"{self.task} is controlled at {hz} Hz, give {hz}, or leave it out")
        if self.visualization_width != self.visualization_height:
            raise self._error("visualization_width", "the picture is square: give both sides the same")
        if self.attempts_file is not None and Path(self.attempts_file).is_dir():
            raise self._error("attempts_file", "it is a folder, give a file in it, such as attempts.jsonl")
        if self.attempts_file is not None and not holds_attempts(Path(self.attempts_file)):
            raise self._error("attempts_file", "it holds something else than attempts, give another file")
        for name in ("room_noise", "microphone_response", "spectrogram"):
            if self.sound != "waveform" and getattr(self, name) not in (None, "flat"):
                raise self._error(name, f"--env.sound={self.sound} has no sound for it; leave one of them out")
        if self.room_noise is None and self.room_noise_level != 1.0:
            raise self._error("room_noise_level", "no noise plays in the room; name a WAV file with --env.room_noise")
        # Whose messages tell what works.
        self._asked(lambda: _tasks().environment.TaskEnv(self.task or "", **self.gym_kwargs))

    def _asked[T](self, what: Callable[[], T]) -> T:
        """What the tasks answer; their complaint names the option of this configuration."""
        known = _tasks().registry
        try:
            return what()
        except known.OptionError as error:
            name = _OPTIONS.get(error.option, error.option)
            raise self._error(name if hasattr(self, name) else "task_options", error.wanted) from error
        except known.PluginError as error:
            raise self._error("task", str(error).rstrip(".")) from error

    def _error(self, name: str, what_to_do: str) -> DecodingError:
        # Not a ValueError: draccus hides a ValueError of __post_init__ behind a traceback, and prints this as one line.
        return DecodingError(("env", name), f"{getattr(self, name)!r} does not work: {what_to_do}.")


def _tasks() -> Any:
    """`gym_playbyear`, imported when it is asked for: LeRobot keeps to itself why a package cannot be imported, and goes on
    without its `--env.type`.

    Raises:
        DecodingError: MuJoCo cannot draw as `MUJOCO_GL` says.
    """
    try:
        import gym_playbyear.environment
    except RuntimeError as error:
        raise DecodingError(("env", "type"), f"'playbyear' does not work: {error}") from error
    return gym_playbyear
