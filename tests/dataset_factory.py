"""Small LeRobotDatasets for tests, made with LeRobot's own API."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset

from lerobot_playbyear.datasets.features import audio_feature

CAMERA = "observation.images.front"
MICROPHONE = "observation.audio.gripper"
TASK = "Grasp the hidden cube."


def dataset_features(
    fps: int = 20,
    sample_rate: int = 16000,
    image_size: int = 32,
    use_videos: bool = False,
    microphones: tuple[str, ...] = (MICROPHONE,),
    cameras: tuple[str, ...] = (CAMERA,),
    state_size: int = 7,
    action_size: int = 4,
) -> dict[str, dict[str, Any]]:
    """The features of a dataset with sound."""
    names = ["height", "width", "channels"]
    camera = {"dtype": "video" if use_videos else "image", "shape": (image_size, image_size, 3), "names": names}
    return {
        **{key: dict(camera) for key in cameras},
        **{key: audio_feature(sample_rate, fps) for key in microphones},
        "observation.state": {"dtype": "float32", "shape": (state_size,), "names": None},
        "action": {"dtype": "float32", "shape": (action_size,), "names": None},
        "intervention": {"dtype": "bool", "shape": (1,), "names": None},
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    }


def random_frame(features: dict[str, dict[str, Any]], rng: np.random.Generator) -> dict[str, Any]:
    """One frame of noise; the action is a function of the state, so that there is something to learn."""
    frame: dict[str, Any] = {}
    for key, feature in features.items():
        shape, dtype = feature["shape"], feature["dtype"]
        if dtype in ("image", "video"):
            frame[key] = rng.integers(0, 256, shape, dtype=np.uint8)
        elif dtype == "bool":
            frame[key] = rng.random(shape) < 0.5
        elif dtype == "string":
            frame[key] = "a word"
        elif dtype == "int16":
            frame[key] = rng.normal(0, 300, shape).astype(np.int16)
        else:
            frame[key] = rng.normal(size=shape).astype(dtype)
    size = features["action"]["shape"][0]
    frame["action"] = np.tanh(np.resize(frame["observation.state"], size)).astype(np.float32)
    return frame


def make_dataset(
    root: str | Path,
    episode_lengths: tuple[int, ...] = (12, 17, 9),
    fps: int = 20,
    seed: int = 0,
    features: dict[str, dict[str, Any]] | None = None,
    repo_id: str = "tests/noise",
    robot_type: str | None = None,
    frame_of: Callable[[int, int, dict[str, Any]], dict[str, Any]] = lambda episode, step, frame: frame,
    **kwargs: Any,
) -> LeRobotDataset:
    """Write episodes of noise to `root` and open them for reading.

    Args:
        frame_of: Makes the frame that is written of episode, step and a frame of noise.
        kwargs: As for `dataset_features`, where there are no `features`.
    """
    rng = np.random.default_rng(seed)
    features = dataset_features(fps=fps, **kwargs) if features is None else features
    options: dict[str, Any] = {"robot_type": robot_type, "use_videos": False, "video_backend": "pyav"}
    if any(feature["dtype"] == "video" for feature in features.values()):
        # LeRobot's default encoder does not take pictures as small as these
        options |= {"use_videos": True, "rgb_encoder": RGBEncoderConfig(vcodec="h264")}
    dataset = LeRobotDataset.create(repo_id, fps, features, root=root, **options)
    for episode, length in enumerate(episode_lengths):
        for step in range(length):
            dataset.add_frame({**frame_of(episode, step, random_frame(features, rng)), "task": TASK})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset(repo_id, root=root, video_backend="pyav")


def rollout_dataset(
    root: Path, lengths: tuple[int, ...], mark: Callable[[int], bool], use_videos: bool = False, by_policy: float = 0.0
) -> None:
    """A dataset as `lerobot-rollout --strategy.type=dagger` writes it: observations, action and `intervention`, no more."""

    def marked(episode: int, step: int, frame: dict[str, Any]) -> dict[str, Any]:
        action = frame["action"] + np.float32(by_policy * (not mark(step)))
        return {**frame, "action": action, "intervention": np.array([mark(step)])}

    features = dataset_features(image_size=16, use_videos=use_videos)
    del features["next.reward"]
    repo_id = "tests/rollout_corrections"
    make_dataset(root, lengths, features=features, repo_id=repo_id, robot_type="so100", frame_of=marked)
