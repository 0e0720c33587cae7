"""Options of the policy that cannot be, refused with the key, what was given and what is wanted."""

import math
from typing import TYPE_CHECKING

from lerobot_playbyear.policy.precision import DTYPES

if TYPE_CHECKING:
    from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig


def check_options(config: "PlaybyearConfig") -> None:
    """Checks the numbers of a configuration, and that they go together.

    Raises:
        ValueError: Names the option.
    """
    for name in ("fps", "n_frame_stack", "n_memory_steps", "n_supervised_steps", "vision_width", "image_size"):
        if getattr(config, name) < 1:
            raise ValueError(f"--policy.{name} must be at least 1, got {getattr(config, name)}.")
    if not 0 < config.action_range < math.inf:
        raise ValueError(f"--policy.action_range must be above 0 and finite, got {config.action_range}.")
    for name in ("audio_envelope_gain", "memory_displacement_gain", "low_dimensional_noise", "low_dimensional_offset"):
        if not 0 <= getattr(config, name) < math.inf:
            raise ValueError(f"--policy.{name} must be at least 0 (none) and finite, got {getattr(config, name)}.")
    if config.memory_displacement_gain and not config.low_dimensional_gain:
        raise ValueError(
            f"--policy.memory_displacement_gain={config.memory_displacement_gain} compares low-dimensional observations, and "
            "--policy.low_dimensional_gain is 0: give 4, its usual value."
        )
    if config.memory_readers < 0:
        raise ValueError(f"--policy.memory_readers must be at least 0 (none), got {config.memory_readers}.")
    if config.memory_readers and not config.memory_displacement_gain:
        raise ValueError(
            f"--policy.memory_readers={config.memory_readers} read displacements, and --policy.memory_displacement_gain is 0: "
            "give 10, its usual value."
        )
    if config.audio_noise_files is not None and config.audio_noise_db is None:
        raise ValueError(
            f"--policy.audio_noise_files={config.audio_noise_files} says nothing of how loud the noise may be: add "
            "--policy.audio_noise_db=24 (dB above the recordings' own noise floor)."
        )
    if config.audio_colour_db < 0:
        raise ValueError(f"--policy.audio_colour_db must be at least 0 dB, got {config.audio_colour_db}.")
    for kind in ("onset", "balance", "way"):
        weight = getattr(config, f"auxiliary_{kind}")
        if not 0 <= weight < math.inf:
            raise ValueError(f"--policy.auxiliary_{kind} must be at least 0 (off) and finite, got {weight}.")
    if config.audio_window_s < config.segment_s or config.hop_s <= 0:
        raise ValueError(
            f"--policy.audio_window_s ({config.audio_window_s}) must hold at least one segment of "
            f"--policy.segment_s ({config.segment_s}), and --policy.hop_s ({config.hop_s}) must be positive."
        )
    if not (config.use_vision or config.use_audio or config.low_dimensional_keys or not config.input_features):
        raise ValueError(
            "use_vision and use_audio are both off and there is no other observation: nothing to learn from."
        )
    if config.dtype not in (None, *DTYPES):
        raise ValueError(f"--policy.dtype must be one of {', '.join(DTYPES)}, got {config.dtype!r}.")
