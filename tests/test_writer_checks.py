"""What cannot become a good dataset is refused before it is written: features at the start, frames when they come."""

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from recording_factory import CAMERA, FEATURES, FPS, MICROPHONE, REPO_ID, episode_frames, load

from lerobot_playbyear.datasets.durable import DurableWriter

SOUND = FEATURES[MICROPHONE]
FLOATS = {**FEATURES, MICROPHONE: {**SOUND, "dtype": "float32"}}


def with_sound(**changes: Any) -> dict[str, dict[str, Any]]:
    return {**FEATURES, MICROPHONE: {**deepcopy(SOUND), **changes}}


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (with_sound(info=None), "does not say its sample rate"),
        (with_sound(info={"sample_rate": 1600.5}), r"sample_rate 1600\.5.*whole number of Hz"),
        (with_sound(info={"sample_rate": np.int64(1600)}), "sample_rate .*whole number of Hz"),
        (with_sound(info={"sample_rate": 1601}), "a frame must hold a whole number of samples"),
        (with_sound(info={"sample_rate": 3200}), r"has shape \(80,\).*must be \(160,\)"),
        (with_sound(dtype="int32"), "dtype 'int32'; wanted 'int16'"),
        (with_sound(shape=(80, 2)), "every microphone is its own key"),
        (with_sound(shape=(80, 1)), r"wanted \(80,\)"),
        ({**FEATURES, "action": {"dtype": "float33", "shape": (4,), "names": None}}, "'action' has dtype 'float33'"),
        ({**FEATURES, "action": {"dtype": "float32", "shape": (0,), "names": None}}, r"'action' has shape \(0,\)"),
        ({**FEATURES, "action": {"dtype": "float32", "names": None}}, "'action' has no shape"),
        ({**FEATURES, "my/action": FEATURES["action"]}, r"'my/action' has a '/'.*'my\.action'"),
    ],
)
def test_features_that_cannot_be_written_are_refused_at_the_start(tmp_path, features, message):
    with pytest.raises(ValueError, match=message):
        DurableWriter(REPO_ID, tmp_path / "dataset", FPS, features)
    for fps in (0, 29.97, True, "20"):
        with pytest.raises(ValueError, match=rf"fps={fps!r}"):
            DurableWriter(REPO_ID, tmp_path / "dataset", fps, FEATURES)
    assert not (tmp_path / "dataset").exists()


def floats(value: float) -> np.ndarray:
    sound = np.zeros(80, np.float32)
    sound[17] = value
    return sound


REFUSED = [
    (MICROPHONE, floats(np.nan), f"'{MICROPHONE}': sample 17 is nan"),
    (MICROPHONE, floats(1.25), r"sample 17 is 1\.25; .*\[-1, 1\]"),
    (MICROPHONE, floats(0).astype(np.float64), "float64"),
    (MICROPHONE, np.zeros(79, np.float32), r"\(79,\)"),
    (MICROPHONE, [0.0] * 80, "list"),
    (CAMERA, np.full((16, 16, 3), 2.0, np.float32), rf"'{CAMERA}'.*\[0\.0, 1\.0\]"),
    (CAMERA, np.zeros((16, 8, 3), np.uint8), r"\(16, 8, 3\)"),
    ("task", None, "'task'"),
    ("task", b"Knock.", "'task'"),
]


def test_a_bad_frame_is_refused_and_the_episode_goes_on(tmp_path):
    root = tmp_path / "dataset"
    good = [
        {**frame, MICROPHONE: (frame[MICROPHONE] / 32768).astype(np.float32)} for frame in episode_frames(0, FEATURES)
    ]
    good += [{**good[0], MICROPHONE: floats(value)} for value in (1.0, -1.0)]  # full scale is not too loud
    with DurableWriter(REPO_ID, root, FPS, FLOATS) as writer:
        for frame in good:
            for key, value, message in REFUSED:
                with pytest.raises(ValueError, match=message):
                    writer.add_frame({**frame, key: value})
            again = {key: value.copy() if isinstance(value, np.ndarray) else value for key, value in frame.items()}
            writer.add_frame(again)
            for value in again.values():  # a camera, or a sound card, may use its memory again
                if isinstance(value, np.ndarray):
                    value.fill(0)
        writer.save_episode()
    dataset = load(root)
    assert dataset.num_frames == len(good)
    for index, frame in enumerate(good):
        for key in (MICROPHONE, "action"):
            np.testing.assert_array_equal(dataset[index][key].numpy(), frame[key])
        pixels = (dataset[index][CAMERA].numpy().transpose(1, 2, 0) * 255).round().astype(np.uint8)
        np.testing.assert_array_equal(pixels, frame[CAMERA])
