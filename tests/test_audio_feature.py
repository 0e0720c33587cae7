"""The dataset's audio contract: good features pass, every broken one is named."""

import wave

import numpy as np
import pytest
from dataset_factory import CAMERA, MICROPHONE, make_dataset

from lerobot_playbyear.datasets.audio_files import write_wav
from lerobot_playbyear.datasets.features import (
    audio_feature,
    audio_keys,
    check_audio_features,
    episode_waveform,
)

FPS = 20


@pytest.mark.parametrize(("sample_rate", "fps", "samples"), [(16000, 20, 800), (48000, 20, 2400), (48000, 30, 1600)])
def test_feature_holds_a_whole_number_of_samples(sample_rate, fps, samples):
    feature = audio_feature(sample_rate, fps)

    assert feature["shape"] == (samples,)
    assert feature["info"] == {"sample_rate": sample_rate, "encoding": "pcm_s16"}
    assert check_audio_features({MICROPHONE: feature}, fps) == {MICROPHONE: sample_rate}


def test_a_frame_rate_that_does_not_divide_the_sample_rate_is_refused():
    with pytest.raises(ValueError, match=r"16000 / 30 .* 15990 Hz"):
        audio_feature(16000, 30)


@pytest.mark.parametrize(
    ("change", "fps", "message"),
    [
        ({"shape": (801,)}, FPS, r"'observation.audio.gripper' has shape \(801,\).*\(800,\)"),
        ({"info": None}, FPS, "does not say its sample rate"),
        ({"dtype": "int32"}, FPS, "dtype 'int32'; wanted 'int16'"),
        ({}, 10, r"shape \(800,\); at 16000 Hz and 10 frames per second it must be \(1600,\)"),
        ({}, 30, "not a positive integer"),
    ],
)
def test_broken_features_are_named(change, fps, message):
    with pytest.raises(ValueError, match=message):
        check_audio_features({MICROPHONE: {**audio_feature(16000, FPS), **change}}, fps)


def test_a_dataset_without_sound_breaks_no_contract():
    assert check_audio_features({CAMERA: {"dtype": "image", "shape": (8, 8, 3)}}, FPS) == {}


def test_an_episode_is_heard_as_it_was_recorded(tmp_path):
    dataset = make_dataset(tmp_path / "noise", episode_lengths=(4, 6), image_size=8)

    waveform, sample_rate = episode_waveform(dataset, 1, MICROPHONE)
    path = write_wav(tmp_path / "episode.wav", waveform, sample_rate)

    with wave.open(str(path)) as file:
        assert (file.getframerate(), file.getnchannels(), file.getnframes()) == (16000, 1, 6 * 800)
        written = np.frombuffer(file.readframes(6 * 800), dtype="<i2")
    stock = np.concatenate([dataset[i][MICROPHONE].numpy() for i in range(4, 10)])
    assert np.array_equal(written, stock)
    assert audio_keys(dataset.meta.features) == [MICROPHONE]


def test_missing_microphone_and_episode_are_named(tmp_path):
    dataset = make_dataset(tmp_path / "noise", episode_lengths=(3,), image_size=8)

    with pytest.raises(ValueError, match=r"no 'observation.audio.table'; its audio keys are"):
        episode_waveform(dataset, 0, "observation.audio.table")
    with pytest.raises(ValueError, match="no episode 7"):
        episode_waveform(dataset, 7, MICROPHONE)


def test_float_sound_is_written_at_full_scale(tmp_path):
    path = write_wav(tmp_path / "float.wav", np.array([-1.5, -1.0, 0.0, 0.5, 1.0], dtype=np.float32), 8000)

    with wave.open(str(path)) as file:
        samples = np.frombuffer(file.readframes(5), dtype="<i2")
    assert samples.tolist() == [-32768, -32768, 0, 16384, 32767]
    with pytest.raises(ValueError, match="NaN"):
        write_wav(tmp_path / "nan.wav", np.array([np.nan]), 8000)
