"""What happens to observations and actions around the network: LeRobot's own steps, and two of ours for sound."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.processor import (
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)
from torch import Tensor

from lerobot_playbyear.audio.control_steps import ControlStepSound, check_pace
from lerobot_playbyear.audio.microphone_pictures import Strip, read_strip
from lerobot_playbyear.audio.sound_picture import PICTURE_PREFIX
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.features import AUDIO_PREFIX, samples_per_frame
from lerobot_playbyear.datasets.frame_rate import nearest_sample_rate
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.extension import SoundStep, made_with_options

_FULL_SCALE = 32768  # int16: samples are in [-32768, 32767]
_USUAL_RATES = (16000, 48000, 44100, 32000, 22050, 8000, 96000)  # Hz
_PACE_STEPS = slice(2, 22)
"""Steps of an episode whose lengths are looked at; the first ones wait for the policy's first thoughts."""


def make_playbyear_pre_post_processors(
    config: PlaybyearConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Builds both pipelines.

    Only the low-dimensional observations and the action are normalised. Images and waveforms reach the network as they
    are, which carries its own front ends; sound after the configured `audio_steps`. Where an observation has a microphone's
    picture instead of its sound, as on a robot, the sound is taken from the picture.

    Args:
        config: The policy's configuration, with its features.
        dataset_stats: LeRobot's statistics of the dataset.

    Raises:
        ValueError: No installed package registers one of the `audio_steps`.
    """
    steps = make_default_policy_processor_steps(config, dataset_stats, normalizer_device=config.device)
    steps.normalize.normalize_observation_keys = set(config.low_dimensional_keys)
    heard = [microphone_step(name, config) for name in config.audio_steps]
    if config.use_audio and config.sample_rate is not None:
        heard.insert(0, MicrophonePicturesToAudioStep(config.audio_keys, config.sample_rate, config.control_hz))
    return make_policy_processor_pipelines(
        input_steps=[steps.rename_observations, steps.add_batch_dim, steps.to_device, *heard, steps.normalize],
        output_steps=[steps.unnormalize, steps.to_cpu],
    )


def microphone_step(name: str, config: PlaybyearConfig) -> ProcessorStep:
    if name not in ProcessorStepRegistry.list():
        raise ValueError(
            f"--policy.audio_steps names '{name}', which no installed package registers in LeRobot's ProcessorStepRegistry: "
            "install the one that does; its distribution's name begins with lerobot_policy_ (docs/how_to/train.md)."
        )
    return made_with_options(name, ProcessorStepRegistry.get(name), config)


@dataclass
@ProcessorStepRegistry.register(name="playbyear_microphone_pictures_to_audio")
class MicrophonePicturesToAudioStep(SoundStep):
    """Makes `observation.audio.<mic>` of `observation.images.<mic>`, where the sound is not there yet.

    In training and in simulation the sound is in the observation, and nothing is done. On a robot the microphone is a camera
    (`microphones.camera`), whose picture carries its newest samples.

    Args:
        microphones: Keys of the sound that the policy hears, `observation.audio.<mic>`.
        sample_rate: Of the sound that it was trained with [Hz].
        fps: Control steps per second [Hz].
    """

    microphones: list[str] = field(default_factory=list)
    sample_rate: int = 16000
    fps: float = 20

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The next observation is an episode's first one."""
        self._sounds: dict[tuple[str, int], ControlStepSound] = {}
        self._spacing: list[int] = []

    def get_config(self) -> dict[str, Any]:
        return {"microphones": list(self.microphones), "sample_rate": self.sample_rate, "fps": self.fps}

    def observation(self, observation: dict) -> dict:
        """Adds the sound that is missing, (B, S) float32 in [-1, 1].

        Raises:
            InputError: A microphone is missing, has another name or sample rate, or control steps have another length.
        """
        missing = [key for key in self.microphones if key not in observation]
        if not missing or not observation:  # an action alone, as when one is only normalised
            return observation
        return {**observation, **{key: self._sound(key, observation) for key in missing}}

    def _sound(self, key: str, observation: dict) -> Tensor:
        name = key.removeprefix(AUDIO_PREFIX)
        picture = observation.get(PICTURE_PREFIX + name)
        if not isinstance(picture, Tensor) or picture.ndim < 3:
            cameras = [one.removeprefix(PICTURE_PREFIX) for one in observation if one.startswith(PICTURE_PREFIX)]
            raise InputError(
                f"This policy hears '{name}', and there is neither '{key}' nor a camera '{name}' in the observation; the "
                f"cameras are {', '.join(cameras) or 'none'}. On a robot give the microphone that name: "
                f"--robot.cameras='{{{name}: {{type: microphone, device: ...}}}}' (playbyear-find-microphones prints it); in "
                "a simulation name all that the policy hears, --env.microphones='[...]'."
            )
        pictures = picture if picture.ndim == 4 else picture[None]  # (B, 3, H, W)
        blocks = [self._block(key, number, self._strip(key, one)) for number, one in enumerate(pictures)]
        return torch.from_numpy(np.stack(blocks).astype(np.float32) / 32768).to(picture.device)

    def _strip(self, key: str, picture: Tensor) -> Strip:
        """The strip of a picture (3, H, W), floats in [0, 1] or uint8."""
        pixels = picture if picture.dtype == torch.uint8 else (picture * 255).round().to(torch.uint8)
        strip = read_strip(pixels.permute(1, 2, 0).cpu().numpy())
        name = key.removeprefix(AUDIO_PREFIX)
        if strip is None:
            raise InputError(
                f"This policy hears '{name}', and the picture '{PICTURE_PREFIX}{name}' carries no samples: it is another "
                f"camera's, or was compressed or resized. Give --robot.cameras='{{{name}: {{type: microphone, device: ...}}}}'."
            )
        if nearest_sample_rate(strip.sample_rate, self.fps) != self.sample_rate:  # the one that it has in a dataset
            fitting = [rate for rate in _USUAL_RATES if nearest_sample_rate(rate, self.fps) == self.sample_rate]
            raise InputError(
                f"The microphone '{name}' has sample_rate={strip.sample_rate}, and this policy was trained with "
                f"{self.sample_rate} Hz at {self.fps} frames per second: give sample_rate={(*fitting, self.sample_rate)[0]} in "
                "--robot.cameras."
            )
        return strip

    def _block(self, key: str, number: int, strip: Strip) -> np.ndarray:
        sound = self._sounds.setdefault((key, number), ControlStepSound(samples_per_frame(self.sample_rate, self.fps)))
        block, _ = sound.next(strip)
        if number == 0 and key == self.microphones[0] and sound.n_heard is not None:
            self._watch_pace(sound.n_heard, strip.sample_rate)
        return block

    def _watch_pace(self, n_heard: int, sample_rate: int) -> None:
        if len(self._spacing) >= _PACE_STEPS.stop:
            return
        self._spacing.append(n_heard)
        if len(self._spacing) == _PACE_STEPS.stop:
            misfit = "The control loop does not fit the policy: "
            check_pace(self._spacing[_PACE_STEPS], sample_rate, self.fps, "the policy", misfit, is_live=True)


@dataclass
@ProcessorStepRegistry.register(name="playbyear_pcm16_to_float")
class Pcm16ToFloatProcessorStep(SoundStep):
    """Divides the int16 sound of an environment by 32,768: policies want floats in [-1, 1].

    An environment gives `audio.<microphone>` as int16; LeRobot's `preprocess_observation` makes floats of it without scaling
    them, and nothing in them tells a quiet room from the loudest noise. So the environment's configuration says what they are:

        def get_env_processors(self):
            return PolicyProcessorPipeline(steps=[Pcm16ToFloatProcessorStep()]), PolicyProcessorPipeline(steps=[])

    Every command that lets a policy act asks for it: lerobot-eval, lerobot-train, and ours. Datasets keep int16.
    """

    def observation(self, observation: dict) -> dict:
        """Scales every `observation.audio.<microphone>`, (B, S).

        Raises:
            ValueError: The samples are not those of int16 sound.
        """
        sound = {key: _scaled(value, key) for key, value in observation.items() if key.startswith(AUDIO_PREFIX)}
        return {**observation, **sound}


def _scaled(samples: Tensor, key: str) -> Tensor:
    wave = samples.to(torch.float32)
    strange = (wave != wave.round()) | (wave.abs() > _FULL_SCALE)
    if strange.any():
        raise ValueError(
            f"{key} holds {wave[strange][0].item():.6g}, which is not an int16 sample. If these are floats in [-1, 1], remove "
            f"{Pcm16ToFloatProcessorStep.__name__} from the environment's `get_env_processors`. If they are other integers, "
            "give int16 in the environment."
        )
    return wave / _FULL_SCALE
