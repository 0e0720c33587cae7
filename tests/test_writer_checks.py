"""What cannot become a good dataset is refused before it is written: features at the start, frames when they come."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_factory import FEATURES, FPS, MICROPHONE, REPO_ID, episode_frames, load

from lerobot_playbyear.datasets.durable import DurableWriter

SOUND = FEATURES[MICROPHONE]
FLOATS = {**FEATURES, MICROPHONE: {**SOUND, "dtype": "float32"}}


def with_sound(**changes: Any) -> dict[str, dict[str, Any]]:
    return {**FEATURES, MICROPHONE: {**deepcopy(SOUND), **changes}}


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (with_sound(info={}), "does not say its sample rate"),
        (with_sound(info=None), "does not say its sample rate"),
        (with_sound(info={"sample_rate": 1600.0}), r"sample_rate 1600\.0.*whole number of Hz"),
        (with_sound(info={"sample_rate": 1600.5}), r"sample_rate 1600\.5.*whole number of Hz"),
        (with_sound(info={"sample_rate": "1600"}), "sample_rate '1600'.*whole number of Hz"),
        (with_sound(info={"sample_rate": True}), "sample_rate True.*whole number of Hz"),
        (with_sound(info={"sample_rate": np.int64(1600)}), "sample_rate .*whole number of Hz"),
        (with_sound(info={"sample_rate": -1600}), "positive integer"),
        (with_sound(info={"sample_rate": 1601}), "a frame must hold a whole number of samples"),
        (with_sound(info={"sample_rate": 3200}), r"has shape \(80,\).*must be \(160,\)"),
        (with_sound(dtype="int32"), "dtype 'int32'; wanted 'int16'"),
        (with_sound(dtype="uint8"), "dtype 'uint8'; wanted 'int16'"),
        (with_sound(dtype="string"), "dtype 'string'; wanted 'int16'"),
        (with_sound(shape=(80, 2)), "every microphone is its own key"),
        (with_sound(shape=(2, 80)), "every microphone is its own key"),
        (with_sound(shape=(80, 1)), r"wanted \(80,\)"),
        (with_sound(shape=()), r"must be \(80,\)"),
        ({**FEATURES, "action": {"dtype": "float33", "shape": (4,), "names": None}}, "'action' has dtype 'float33'"),
        ({**FEATURES, "action": {"dtype": "float32", "shape": (0,), "names": None}}, r"'action' has shape \(0,\)"),
        ({**FEATURES, "action": {"dtype": "float32", "names": None}}, "'action' has no shape"),
        ({**FEATURES, "action": {"shape": (4,), "names": None}}, "'action' has no dtype"),
    ],
)
def test_features_that_cannot_be_written_are_refused_at_the_start(tmp_path, features, message):
    with pytest.raises(ValueError, match=message):
        DurableWriter(REPO_ID, tmp_path / "dataset", FPS, features)
    assert not (tmp_path / "dataset").exists()


@pytest.mark.parametrize("fps", [0, -20, 20.0, 29.97, True, "20"])
def test_a_frame_rate_is_a_whole_number(tmp_path, fps):
    with pytest.raises(ValueError, match="fps"):
        DurableWriter(REPO_ID, tmp_path / "dataset", fps, FEATURES)
    assert not (tmp_path / "dataset").exists()


def floats(value: float) -> np.ndarray:
    sound = np.zeros(80, np.float32)
    sound[17] = value
    return sound


@pytest.mark.parametrize(
    ("sound", "message"),
    [
        (floats(np.nan), f"'{MICROPHONE}': sample 17 is nan"),
        (floats(np.inf), f"'{MICROPHONE}': sample 17 is inf"),
        (floats(-np.inf), "sample 17 is -inf"),
        (floats(1.25), r"sample 17 is 1\.25; .*\[-1, 1\]"),
        (floats(-32768), r"sample 17 is -32768.*\[-1, 1\]"),
        (floats(0).astype(np.float64), "float64"),
        (np.zeros(80, np.int16), "int16"),
        (np.zeros(79, np.float32), r"\(79,\)"),
        (np.zeros((80, 1), np.float32), r"\(80, 1\)"),
        (np.zeros((80, 2), np.float32), r"\(80, 2\)"),
        ([0.0] * 80, "list"),
        (None, "None"),
    ],
)
def test_a_frame_with_bad_sound_is_refused_and_the_episode_goes_on(tmp_path, sound, message):
    root = tmp_path / "dataset"
    with DurableWriter(REPO_ID, root, FPS, FLOATS) as writer:
        good = [
            {**frame, MICROPHONE: (frame[MICROPHONE] / 32768).astype(np.float32)}
            for frame in episode_frames(0, FEATURES)
        ]
        for frame in good:
            with pytest.raises(ValueError, match=message):
                writer.add_frame({**frame, MICROPHONE: sound})
            writer.add_frame(frame)
        writer.save_episode()
    dataset = load(root)
    assert dataset.num_frames == len(good)
    for index, frame in enumerate(good):
        for key in (MICROPHONE, "action"):
            np.testing.assert_array_equal(dataset[index][key].numpy(), frame[key])


@pytest.mark.parametrize("task", [None, 3, b"Knock."])
def test_a_task_is_a_text(tmp_path, task):
    with DurableWriter(REPO_ID, tmp_path / "dataset", FPS, FEATURES) as writer:
        frame = episode_frames(0, FEATURES)[0]
        with pytest.raises(ValueError, match="'task'"):
            writer.add_frame({**frame, "task": task})
        writer.add_frame(frame)
        writer.save_episode()
    assert load(tmp_path / "dataset").num_frames == 1


def test_full_scale_is_not_too_loud(tmp_path):
    root: Path = tmp_path / "dataset"
    with DurableWriter(REPO_ID, root, FPS, FLOATS) as writer:
        frame = episode_frames(0, FEATURES)[0]
        for value in (1.0, -1.0):
            writer.add_frame({**frame, MICROPHONE: floats(value)})
        writer.save_episode()
    assert load(root).num_frames == 2
