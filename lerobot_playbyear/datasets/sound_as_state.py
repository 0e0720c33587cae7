"""The sound of each frame as a state, for policies that read states: nothing is computed, they get the samples.

`observation.environment_state` holds what every microphone heard since the previous frame, one microphone after the other.
LeRobot's ACT and Diffusion read this key as it is. `--env.sound_as_state=true` gives the same numbers at rollout.
"""

from pathlib import Path

import numpy as np
from lerobot.datasets import LeRobotDataset, modify_features
from lerobot.utils.constants import OBS_ENV_STATE

from lerobot_playbyear.audio.attach import write_new_dataset
from lerobot_playbyear.datasets.audio_feature import AUDIO_PREFIX, audio_keys, check_audio_features
from lerobot_playbyear.datasets.errors import InputError, errors_of_input
from lerobot_playbyear.datasets.statistics import numeric_stats, write_stats
from lerobot_playbyear.datasets.tensors import value_pieces

_FULL_SCALE = 32768  # int16 PCM; a power of two, so that dividing by it loses nothing


def sound_as_state(dataset: LeRobotDataset, target: str | Path) -> Path:
    """Copies a dataset; in the copy sound is a state and nothing else.

    All of the sound is in memory meanwhile. Its statistics are LeRobot's, of every sample's place in the frame: so LeRobot
    normalises it as any other state.

    Args:
        dataset: It has sound, and all of its episodes are opened. It is not changed.
        target: The copy's folder, which must not be there yet.

    Returns:
        The folder. It holds `observation.environment_state`, float32 (S of all microphones,), samples in [-1, 1], microphones
        in the order of their keys; and no `observation.audio.<microphone>`.

    Raises:
        InputError: There is no sound, or no place for it, or it cannot be read.
        OSError: The copy cannot be written.
    """
    target = Path(target)
    microphones = _check(dataset, target)
    with errors_of_input():
        waves = [_floats(np.concatenate(list(value_pieces(dataset, key)))) for key in microphones]  # (N, S) each
    state = np.concatenate(waves, axis=1)  # (N, S of all)
    feature = {"dtype": "float32", "shape": state.shape[1:], "names": None}
    stats = numeric_stats({OBS_ENV_STATE: state}, {OBS_ENV_STATE: feature})

    def write(root: Path, folder: Path) -> None:
        folder.rmdir()  # LeRobot makes it
        copy = modify_features(dataset, {OBS_ENV_STATE: (state, feature)}, microphones, folder, dataset.repo_id)
        write_stats({**(copy.meta.stats or {}), **stats}, folder)

    write_new_dataset(Path(dataset.root), target, write)
    return target


def _check(dataset: LeRobotDataset, target: Path) -> list[str]:
    """The keys of the microphones, in their order."""
    if target.exists():
        raise InputError(f"{target} is there already. Choose another folder, or delete it.")
    with errors_of_input():
        check_audio_features(dataset.meta.features, dataset.fps)
    microphones = sorted(audio_keys(dataset.meta.features))
    if not microphones:
        raise InputError(
            f"The dataset '{dataset.repo_id}' has no sound in columns '{AUDIO_PREFIX}<microphone>'; wanted one at least. "
            "Choose another, or add sound first: playbyear-attach-audio."
        )
    if OBS_ENV_STATE in dataset.meta.features:
        raise InputError(
            f"The dataset '{dataset.repo_id}' has '{OBS_ENV_STATE}' already, where the sound is to go; wanted none. "
            "Remove it first: lerobot-edit-dataset --operation.type=remove_feature."
        )
    if len(dataset) != dataset.meta.total_frames:
        raise InputError(
            f"The dataset '{dataset.repo_id}' was opened with {len(dataset)} of its {dataset.meta.total_frames} frames; wanted "
            "all of them. Open it without `episodes`."
        )
    return microphones


def _floats(wave: np.ndarray) -> np.ndarray:
    return wave / np.float32(_FULL_SCALE) if wave.dtype.kind == "i" else wave
