"""What a dataset holds of an episode: its features and its frames, and how they are saved."""

import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pyarrow.parquet as pq
from lerobot.utils.constants import ACTION, DONE, OBS_IMAGE, OBS_IMAGES, OBS_STATE, OBS_STR, REWARD, SUCCESS

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.errors import DatasetWriteError, InputError
from lerobot_playbyear.datasets.features import AUDIO_PREFIX, INTERVENTION, audio_feature
from lerobot_playbyear.episodes.environment import EnvFacts
from lerobot_playbyear.episodes.play import Episode, Observation

SEED = "seed"

_STATE_KEYS = {"agent_pos": OBS_STATE}  # the others have LeRobot's names


def dataset_features(facts: EnvFacts, video: bool = False) -> dict[str, dict[str, Any]]:
    """The features of a dataset of expert episodes, as the raw observation space gives them.

    Args:
        facts: What the environment looks like.
        video: Whether pictures become video.

    Raises:
        InputError: An observation has no place in a LeRobotDataset.
    """
    features: dict[str, dict[str, Any]] = {}
    names: list[str] | None
    for key, space in _observation_boxes(facts.observation_space).items():
        if key.startswith((OBS_IMAGES, OBS_IMAGE)):
            names = ["height", "width", "channel"]
            features[key] = {"dtype": "video" if video else "image", "shape": space.shape, "names": names}
        elif key.startswith(AUDIO_PREFIX):
            features[key] = audio_feature(sample_rate=space.shape[0] * facts.fps, fps=facts.fps)
        else:
            names = facts.state_names if key == OBS_STATE else None
            features[key] = {"dtype": "float32", "shape": space.shape, "names": names}
    features[ACTION] = {"dtype": "float32", "shape": facts.action_space.shape, "names": facts.action_names}
    for key, dtype in ((INTERVENTION, "bool"), (REWARD, "float32"), (SUCCESS, "bool"), (DONE, "bool"), (SEED, "int64")):
        features[key] = {"dtype": dtype, "shape": (1,), "names": None}
    return features


def episode_frames(episode: Episode, features: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """The T frames of an episode: frame t holds what was observed, the action taken then, and what came of it.

    Args:
        episode: An episode of an expert, or of a policy that an expert corrected.
        features: From `dataset_features`.
    """
    by_expert = np.ones(len(episode), bool) if episode.interventions is None else episode.interventions
    frames: list[dict[str, Any]] = []
    for t in range(len(episode)):
        frame = _flat_observation(episode.observations[t])
        for key, value in frame.items():
            if features[key]["dtype"] == "float32":
                frame[key] = np.asarray(value, np.float32)
        frame[ACTION] = episode.actions[t]
        frame[INTERVENTION] = np.array([by_expert[t]], bool)
        frame[REWARD] = np.array([episode.rewards[t]], np.float32)
        frame[SUCCESS] = np.array([episode.successes[t]], bool)
        frame[DONE] = np.array([t == len(episode) - 1])
        frame[SEED] = np.array([episode.seed], np.int64)
        frame["task"] = episode.task
        frames.append(frame)
    return frames


def save_episode(episode: Episode, writer: DurableWriter) -> list[dict[str, Any]]:
    """Appends an episode to a dataset.

    Where that fails, such as on a full disk, and somebody sits at the terminal, it is tried as often as they want: a person may
    have made the episode by hand.

    Returns:
        Its frames, as the dataset holds them.

    Raises:
        DatasetWriteError: It could not be written; the dataset is as it was before.
    """
    frames = episode_frames(episode, writer.features)
    save_or_ask(writer, frames)
    return frames


def save_or_ask(writer: DurableWriter, frames: Sequence[dict[str, Any]]) -> None:
    """Saves an episode; where that fails and somebody sits at the terminal, as often as they want it.

    Args:
        writer: Without an episode in progress.
        frames: All frames of the episode.

    Raises:
        DatasetWriteError: It could not be written, and nobody is there to make room, or they gave it up.
    """
    try:
        for frame in frames:
            writer.add_frame(frame)
        while True:
            try:
                writer.save_episode()
                return
            except DatasetWriteError as error:
                if not _wants_again(error):
                    raise
    except DatasetWriteError:
        with contextlib.suppress(DatasetWriteError):  # what got through would be the beginning of the next episode
            writer.discard_episode()
        raise


def _wants_again(error: DatasetWriteError) -> bool:
    """Asks at the terminal whether to try again; where there is none nobody wants it."""
    if sys.stdin is None or not sys.stdin.isatty():
        return False
    print(f"\n{error}", file=sys.stderr)
    try:
        answer = input("Press Enter to save it again once there is room, or type q to give it up: ")
    except EOFError:
        return False
    return answer.strip().lower() != "q"


def next_seed(root: Path, seed: int) -> int:
    """The seed after the largest in the dataset, so that no attempt is made twice.

    Args:
        root: The dataset's folder.
        seed: What to begin with when that is larger, or when the dataset holds no seeds.
    """
    files = sorted(root.glob("data/*/*.parquet"))
    used = [pq.read_table(path, columns=[SEED])[SEED].to_numpy().max() for path in files]
    return max([seed, *(int(value) + 1 for value in used)])


def _observation_boxes(space: gym.spaces.Dict) -> dict[str, gym.spaces.Box]:
    boxes = _flat_observation(dict(space.spaces))
    for key, box in boxes.items():
        if not isinstance(box, gym.spaces.Box) or (key.startswith(AUDIO_PREFIX) and box.dtype != np.int16):
            raise InputError(f"The observation {key!r} cannot be recorded: its space is {box}.")
        if key.startswith(AUDIO_PREFIX) and len(box.shape) != 1:
            raise InputError(f"Observation {key!r} has shape {box.shape}; wanted (S,), one microphone per key.")
    return boxes


def _flat_observation(observation: Observation) -> dict[str, Any]:
    """Names a raw observation's entries, or those of its space, as LeRobot's `preprocess_observation` does."""
    flat: dict[str, Any] = {}
    for key, value in observation.items():
        if key != "pixels":
            flat[_STATE_KEYS.get(key, f"{OBS_STR}.{key}")] = value
        elif isinstance(value, dict | gym.spaces.Dict):
            flat.update({f"{OBS_IMAGES}.{camera}": picture for camera, picture in value.items()})
        else:
            flat[OBS_IMAGE] = value
    return flat
