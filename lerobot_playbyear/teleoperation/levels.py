"""How loud a microphone is."""

import numpy as np

from lerobot_playbyear.episodes.episode import Observation

FLOOR_DB = -80.0
_AUDIO = "audio."  # how raw observations name microphones
_FULL_SCALE = 32768.0


def microphone_blocks(observation: Observation) -> dict[str, np.ndarray]:
    """The samples (S,) of each microphone in a raw observation, floats of full scale 1, by the microphone's name."""
    blocks = {key.removeprefix(_AUDIO): np.asarray(v) for key, v in observation.items() if key.startswith(_AUDIO)}
    return {name: as_float(block) for name, block in blocks.items()}


def as_float(block: np.ndarray) -> np.ndarray:
    """Samples as float32: integers are PCM at full scale, floats are in [-1, 1] already."""
    return block.astype(np.float32) / (_FULL_SCALE if np.issubdtype(block.dtype, np.integer) else 1.0)


def level_db(block: np.ndarray) -> float:
    """Root mean square of samples in [-1, 1] [dB of full scale], at least `FLOOR_DB`."""
    power = float(np.mean(np.square(block, dtype=np.float64))) if block.size else 0.0
    return max(10 * np.log10(power), FLOOR_DB) if power > 0 else FLOOR_DB
