"""What other packages add to the policy by name, without a fork: encoders, and steps between microphone and network.

A distribution whose name begins with `lerobot_policy_` and whose module has that very name is imported by every LeRobot command
and by ours; what it registers can then be named on the command line. `examples/extension` is one.
"""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep
from torch import Tensor, nn

from lerobot_playbyear.datasets.features import audio_keys
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.spectrogram import to_float_wave

EncoderFactory = Callable[..., nn.Module]

_ENCODERS: dict[str, dict[str, EncoderFactory]] = {"vision_encoder": {}, "audio_encoder": {}}
"""Per option of the policy, by name."""


def register_vision_encoder[Factory: EncoderFactory](name: str) -> Callable[[Factory], Factory]:
    """Decorates what makes a vision encoder, for `--policy.vision_encoder=<name>`; one is made for every camera.

    It gets the policy's configuration and, as keywords, its `extension_options`. It returns a module with

    - `embedding_size`, an int, E;
    - `forward`: (N, 3 * config.frame_stack, config.image_size, config.image_size) in [0, 1] -> (N, E), for any N.

    Where several processes train, every `nn.BatchNorm2d` in it takes the statistics of all their batches.

    Raises:
        ValueError: The name is taken.
    """
    return _register("vision_encoder", name)


def register_audio_encoder[Factory: EncoderFactory](name: str) -> Callable[[Factory], Factory]:
    """Decorates what makes an audio encoder, for `--policy.audio_encoder=<name>`; one is made for every microphone.

    It gets the policy's configuration and, as keywords, its `extension_options`. It returns a module with

    - `embedding_size`, an int, E;
    - `forward`: (N, config.n_frequency_bins, config.n_segments) -> (N, E), for any N: log power, about 0 +- 1 in
      every bin, and 0 where the episode had not begun;
    - optionally `hears_waveform = True`: then `forward` gets (N, config.window_samples) instead, in [-1, 1], 0 where the
      episode had not begun. Training mixes noise into it; other microphones' responses change spectrograms alone.

    In training neighbouring windows share segments. An encoder that is convolutional along time, without padding, may share its
    work too, and says so by an attribute `window_columns`: it then gets (N, n_frequency_bins, n_segments + extra) and returns
    (N, C, window_columns + extra), where every window's embedding is a slice of `window_columns` columns, so that E is C *
    window_columns.

    Raises:
        ValueError: The name is taken.
    """
    return _register("audio_encoder", name)


def make_encoder(option: str, config: PlaybyearConfig) -> nn.Module:
    """One camera's or one microphone's encoder, the one that the configuration names.

    Args:
        option: `vision_encoder` or `audio_encoder`.
        config: The policy's configuration.

    Raises:
        ValueError: There is none of this name, or it does not say how large its embedding is.
    """
    factories, name = _ENCODERS[option], getattr(config, option)
    if name not in factories:
        raise ValueError(
            f"--policy.{option}={name}: there is no such encoder; there are: {', '.join(sorted(factories))}. Install the "
            "package that registers it. LeRobot imports it if its distribution's name begins with lerobot_policy_ "
            "(docs/how_to/train.md)."
        )
    encoder = made_with_options(name, factories[name], config, config)
    if not isinstance(getattr(encoder, "embedding_size", None), int):
        raise ValueError(f"--policy.{option}={name}: {type(encoder).__name__} has no int `embedding_size`: add it.")
    return encoder


def made_with_options[Made](name: str, factory: Callable[..., Made], config: PlaybyearConfig, *args: Any) -> Made:
    """What another package registers, made with its options.

    Args:
        name: Its own.
        factory: Makes it.
        config: With `extension_options`.
        args: Before the options.

    Raises:
        ValueError: It has no such option, or needs one that is not given.
    """
    options = config.extension_options.get(name, {})
    signature = inspect.signature(factory)
    try:
        signature.bind(*args, **options)
    except TypeError as error:
        known = ", ".join(list(signature.parameters)[len(args) :]) or "none"
        raise ValueError(f"--policy.extension_options={{{name}: {options}}}: {error}. Its options: {known}.") from error
    return factory(*args, **options)


class SoundStep(ObservationProcessorStep):
    """A step that changes no feature's shape."""

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


class MicrophoneStep(SoundStep):
    """A step between the microphones and the network, for `--policy.audio_steps=[<name>]`.

    Subclass it, implement `sound`, and decorate the class with LeRobot's `ProcessorStepRegistry.register(name=...)`. The fields
    of a dataclass are its `extension_options`, and are saved. In training it gets runs of frames in any order, and while the
    policy acts one frame at a time: it must remember nothing, and treat every frame by itself, or the policy hears something
    else than it learned from.
    """

    def get_config(self) -> dict[str, Any]:
        """What it is made with again when a checkpoint is loaded."""
        return dataclasses.asdict(self) if dataclasses.is_dataclass(self) else {}

    def sound(self, wave: Tensor) -> Tensor:
        """(..., S) in [-1, 1] -> the same shape: (B, T, S) in training, (B, S) in a rollout."""
        raise NotImplementedError

    def observation(self, observation: dict) -> dict:
        """Every `observation.audio.<microphone>`, integers as PCM at full scale, and nothing else."""
        keys = [key for key in audio_keys(observation) if not key.endswith("_is_pad")]
        return {**observation, **{key: self.sound(to_float_wave(observation[key], key)) for key in keys}}


def _register[Factory: EncoderFactory](option: str, name: str) -> Callable[[Factory], Factory]:
    factories = _ENCODERS[option]

    def add(factory: Factory) -> Factory:
        if name in factories:
            raise ValueError(f"An encoder '{name}' is registered already, by {factories[name].__module__}.")
        factories[name] = factory
        return factory

    return add
