"""Small recordings whose every value follows from the episode's number, and what is on disk of them.

Nothing here needs the plugin, so that a process without it can tell whether a dataset is what was recorded.
"""

from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

FPS = 20
REPO_ID = "test/recorded"
CAMERA = "observation.images.front"
FILM = "observation.images.film"
MICROPHONE = "observation.audio.gripper"
SECOND_MICROPHONE = "observation.audio.table"
TASKS = ("Grasp the cube.", "Knock on the table.")
LENGTHS = (4, 7, 3, 5)

_NAMES = ["height", "width", "channels"]
FEATURES: dict[str, dict[str, Any]] = {
    CAMERA: {"dtype": "image", "shape": (16, 16, 3), "names": _NAMES},
    MICROPHONE: {
        "dtype": "int16",
        "shape": (80,),
        "names": None,
        "info": {"sample_rate": 1600, "encoding": "pcm_s16"},
    },
    "action": {"dtype": "float32", "shape": (4,), "names": None},
}
RICH_FEATURES: dict[str, dict[str, Any]] = {
    **FEATURES,
    FILM: {"dtype": "video", "shape": (64, 64, 3), "names": _NAMES},
    SECOND_MICROPHONE: FEATURES[MICROPHONE],
    "intervention": {"dtype": "bool", "shape": (1,), "names": None},
}


def episode_length(number: int) -> int:
    """How many frames an episode has."""
    return LENGTHS[number % len(LENGTHS)]


def episode_frames(number: int, features: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """The frames of an episode: noise from the episode's number, and pictures of one colour for films."""
    rng = np.random.default_rng(number)
    return [
        {key: _value(key, feature, number, rng) for key, feature in sorted(features.items())}
        | {"task": TASKS[number % len(TASKS)]}
        for _ in range(episode_length(number))
    ]


def brightness(number: int) -> int:
    """The colour of an episode's film."""
    return 40 + 10 * (number % 16)


def load(root: str | Path) -> LeRobotDataset:
    """The dataset, opened by plain LeRobot."""
    return LeRobotDataset(REPO_ID, root=root, video_backend="pyav")


def differences(dataset: LeRobotDataset, numbers: dict[int, int], features: dict[str, dict[str, Any]]) -> list[str]:
    """What a dataset holds that was not recorded.

    Args:
        dataset: An opened dataset.
        numbers: For each episode in it, the number it was recorded with.
        features: What was recorded.
    """
    wrong = []
    for now, recorded in numbers.items():
        row = dataset.meta.episodes[now]
        frames = episode_frames(recorded, features)
        if row["length"] != len(frames):
            wrong.append(f"episode {now} has {row['length']} frames; wanted {len(frames)}")
            continue
        for offset, frame in enumerate(frames):
            item = dataset[row["dataset_from_index"] + offset]
            if (int(item["episode_index"]), int(item["frame_index"])) != (now, offset):
                wrong.append(f"frame {offset} of episode {now} is numbered wrongly")
            if item["task"] != frame["task"]:
                wrong.append(f"task of frame {offset} of episode {now}")
            wrong += [
                f"'{key}' in frame {offset} of episode {now}"
                for key in features
                if not _same(key, item[key], frame[key])
            ]
    return wrong


def _value(key: str, feature: dict[str, Any], number: int, rng: np.random.Generator) -> np.ndarray:
    shape, dtype = feature["shape"], feature["dtype"]
    if dtype == "video":
        return np.full(shape, brightness(number), np.uint8)
    if dtype == "image":
        return rng.integers(0, 256, shape, np.uint8)
    if dtype == "bool":
        return rng.random(shape) < 0.5
    if dtype == "int16":
        return rng.integers(-32768, 32768, shape).astype(np.int16)
    return rng.normal(size=shape).astype(dtype)


def _same(key: str, found: Any, recorded: np.ndarray) -> bool:
    found = found.numpy()
    if key == CAMERA:
        return np.array_equal((found.transpose(1, 2, 0) * 255).round().astype(np.uint8), recorded)
    if key == FILM:
        return abs(float(found.mean()) * 255 - float(recorded.mean())) < 8
    return np.array_equal(found.reshape(recorded.shape), recorded)
