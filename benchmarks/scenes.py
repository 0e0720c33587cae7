"""Frames of datasets that compress about like a camera's and a microphone's."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from lerobot_playbyear.datasets import audio_feature

CAMERAS = ("observation.images.front", "observation.images.wrist")
MICROPHONES = ("observation.audio.left", "observation.audio.right")


def dataset_features(
    image_size: tuple[int, int],
    sample_rate: int,
    fps: int,
    n_microphones: int = 1,
    dtype: str = "image",
    n_cameras: int = 1,
) -> dict[str, dict[str, Any]]:
    """Cameras, microphones, the arm's state and the action."""
    camera = {"dtype": dtype, "shape": (*image_size, 3), "names": ["height", "width", "channels"]}
    return {
        **{key: dict(camera) for key in CAMERAS[:n_cameras]},
        **{key: audio_feature(sample_rate, fps) for key in MICROPHONES[:n_microphones]},
        "observation.state": {"dtype": "float32", "shape": (7,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
    }


def pictures(height: int, width: int, rng: np.random.Generator, noise_std: float = 2) -> Callable[[int], np.ndarray]:
    """A scene of smooth shapes that moves, with a camera's noise [levels], as pictures compress about like a camera's."""
    y, x = np.mgrid[0:height, 0:width] / width
    scene = np.stack([127 + 90 * np.sin(a * x + b * y) for a, b in ((9, 4), (3, 11), (14, 2))], axis=-1)
    noise = [rng.normal(0, noise_std, scene.shape) for _ in range(4)]
    moved = [np.roll(scene, 3 * i, axis=1) + np.roll(noise[i % 4], 17 * (i // 4), axis=0) for i in range(40)]
    rolled = [np.clip(picture, 0, 255).astype(np.uint8) for picture in moved]
    return lambda i: rolled[i % 40]


def frames(features: dict[str, dict[str, Any]], n: int, seed: int = 0) -> Iterator[dict[str, Any]]:
    """The frames of an episode, as `add_frame` takes them."""
    rng = np.random.default_rng(seed)
    height, width, _ = features[CAMERAS[0]]["shape"]
    picture = pictures(height, width, rng)
    for i in range(n):
        frame: dict[str, Any] = {CAMERAS[0]: picture(i), "task": "listen"}
        for key, feature in features.items():
            if feature["dtype"] == "int16":
                frame[key] = rng.normal(0, 300, feature["shape"]).astype(np.int16)
            elif feature["dtype"] == "float32":
                frame[key] = rng.normal(size=feature["shape"]).astype(np.float32)
        yield frame
