"""A microphone's picture from camera to policy: through encoders, into a dataset's columns, and while acting."""

import itertools
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy
from lerobot.utils.feature_utils import hw_to_dataset_features
from support.recording import edit_info

from lerobot_playbyear.audio import camera_sound
from lerobot_playbyear.audio.attach_audio import AttachAudioConfig, DatasetPlace, attach_audio
from lerobot_playbyear.audio.audio_files import write_audio
from lerobot_playbyear.audio.control_steps import HALF, ControlStepSound
from lerobot_playbyear.audio.microphone_pictures import (
    Strip,
    n_kept,
    n_rows,
    read_strip,
    read_timecode,
    session_path,
    write_strip,
    write_timecode,
)
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.microphones.camera import MicrophoneCamera, MicrophoneCameraConfig
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.processor_playbyear import MicrophonePicturesToAudioStep
from lerobot_playbyear.training import EpisodeStore

RATE, FPS, SIZE = 16000, 20, 800
KEY, PICTURE = "observation.audio.mic", "observation.images.mic"


def sound(seconds: float, rate: int = RATE) -> np.ndarray:
    """Quiet noise with a loud chirp in every second, no place like any other, (n,) int16."""
    rng, time_s = np.random.default_rng(0), np.arange(round(seconds * rate)) / rate
    wave = rng.normal(0, 100, len(time_s)) + 8000 * np.sin(2 * np.pi * time_s * (500 + 200 * time_s)) * (
        time_s % 1 < 0.2
    )
    return wave.astype(np.int16)


class Session:
    """A microphone whose steps a test chooses: its pictures are those of a camera, and its file lies in a folder.

    Args:
        folder: For the session's file.
        samples: What it hears.
        session: Its number.
    """

    def __init__(self, folder: Path, samples: np.ndarray, session: int = 0xABCDEF01, rate: int = RATE) -> None:
        self.samples, self.session, self.rate = samples, session, rate
        write_audio(session_path(folder, session, "2026-01-01_00-00-00"), samples, rate)
        self._noise = np.random.default_rng(1)

    def strip(self, counter: int) -> Strip:
        padded = np.concatenate([np.zeros(n_kept(self.rate), np.int16), self.samples[:counter]])
        return Strip(self.session, counter, self.rate, padded[-n_kept(self.rate) :], -90, -20)

    def picture(self, counter: int) -> np.ndarray:
        picture = self._noise.integers(0, 256, (224, 224, 3)).astype(np.uint8)
        write_strip(picture, self.strip(counter))
        write_timecode(picture, self.session, counter)
        return picture


def counters_of(n: int, first: int = 8000, seed: int = 0) -> list[int]:
    """Steps as LeRobot's loop makes them, a little too long [samples]."""
    return [first, *(first + np.cumsum(np.random.default_rng(seed).integers(801, 815, n - 1))).tolist()]


def recorded(
    root: Path, session: Session, episodes: list[list[int]], video: bool = False, by_person=None, table=None, **others
) -> Path:
    """A dataset of these steps, with LeRobot's own functions; `table` is a second microphone, which never pauses."""
    microphones = {name: (224, 224, 3) for name in ("mic", "table") if name == "mic" or table}
    features = hw_to_dataset_features({"a.pos": float, "b.pos": float, **microphones}, "observation", video)
    features |= hw_to_dataset_features({"a.pos": float, "b.pos": float}, "action", video)
    if by_person:
        features["intervention"] = {"dtype": "bool", "shape": (1,), "names": None}
    dataset = LeRobotDataset.create("me/heard", FPS, features, root=root, use_videos=video, **others)
    for counters in episodes:
        for i, counter in enumerate(counters):
            low = np.array([i, counter % 7], np.float32)
            frame = {"observation.state": low, "action": low, PICTURE: session.picture(counter), "task": "listen"}
            if table:
                frame["observation.images.table"] = table.picture(8000 + SIZE * i)
            if by_person:
                frame["intervention"] = np.array([bool(by_person[i])])
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return root


def attached(root: Path, sessions: Path | None = None) -> LeRobotDataset:
    target = root.with_name(root.name + "_with_sound")
    attach_audio(
        AttachAudioConfig(DatasetPlace("me/heard", str(root)), DatasetPlace("me/sound", str(target)), session=sessions)
    )
    return LeRobotDataset("me/sound", root=target, video_backend="pyav")


def column(dataset: LeRobotDataset, key: str = KEY) -> np.ndarray:
    return np.array(dataset.hf_dataset.with_format("numpy")[key])


# The picture


@pytest.mark.parametrize("rate", [16000, 44100, 48000])
def test_a_picture_carries_its_samples_and_one_wrong_bit_is_noticed(rate, tmp_path):
    session = Session(tmp_path, sound(2, rate), rate=rate)
    picture, strip = session.picture(rate), session.strip(rate)
    found = read_strip(picture)
    assert found is not None
    np.testing.assert_array_equal(found.samples, strip.samples)
    assert (found.session, found.counter, found.sample_rate) == (strip.session, strip.counter, rate)
    assert (found.low_db, found.high_db) == (-90, -20)
    assert read_timecode(picture) == (strip.session, strip.counter)
    for place in (picture.size - 1, picture.size - 30, picture.size - 3 * 224 * n_rows(rate, 224)):
        wrong = picture.copy()
        wrong.reshape(-1)[place] ^= 1
        assert read_strip(wrong) is None
    wrong = picture.copy()
    wrong[8:16, 8:16] = 255 - wrong[8:16, 8:16]  # a bit of the timecode
    assert read_timecode(wrong) is None
    assert read_timecode(np.zeros((224, 224, 3), np.uint8)) is None
    assert read_strip(np.zeros((224, 224, 3), np.uint8)) is None


@pytest.mark.parametrize(
    "options",
    [{}, pytest.param({"streaming_encoding": True, "encoder_queue_maxsize": 150}, marks=pytest.mark.slow)],
    ids=["after", "streaming"],
)
def test_timecodes_survive_lerobots_video_encoder_at_its_defaults(options, tmp_path):
    session, counters = Session(tmp_path, sound(5)), counters_of(60)
    root = recorded(tmp_path / "heard", session, [counters], video=True, **options)
    dataset = LeRobotDataset("me/heard", root=root, video_backend="pyav", return_uint8=True)
    pictures = [dataset[i][PICTURE].permute(1, 2, 0).numpy() for i in range(len(dataset))]
    assert [read_timecode(picture) for picture in pictures] == [(session.session, counter) for counter in counters]
    assert all(read_strip(picture) is None for picture in pictures)  # which is why the session's file is needed


def test_a_camera_draws_the_newest_sound_at_the_right_and_its_range_beside_the_timecode(tmp_path):
    tone = MicrophoneCamera(MicrophoneCameraConfig(tone_hz=2000.0, save_to="none"))
    silent = MicrophoneCamera(MicrophoneCameraConfig(tone_hz=2000.0, gain_db=-60, low_db=-60, save_to="none"))
    for camera in (tone, silent):
        camera.connect()
    time.sleep(0.5)
    pictures = [camera.read_latest() for camera in (tone, silent)]
    for camera in (tone, silent):
        camera.disconnect()
    bright = pictures[0][64:200, -30:, 0].mean(axis=1)
    mel = 2595 * np.log10(1 + 2000 / 700) / (2595 * np.log10(1 + 8000 / 700))
    assert 64 + bright.argmax() == pytest.approx(212 * (1 - mel), abs=3)
    assert bright.max() > 240
    assert pictures[0][100, :100].max() == 0  # nothing was heard two seconds ago
    assert pictures[1][64:200, -30:].max() == 0
    assert not np.array_equal(pictures[0][:16, 96:200], pictures[1][:16, 96:200])


# The sound of a control step


def test_steps_of_uneven_length_join_without_a_click_a_millisecond_late():
    wave = 20000 * np.sin(2 * np.pi * 1000 * np.arange(10 * RATE) / RATE)
    counters, steps = counters_of(100), ControlStepSound(SIZE)
    blocks = [steps.next(Strip(1, c, RATE, wave[c - 4000 : c].astype(np.int16)))[0] for c in counters]
    places = np.concatenate([a + (np.arange(SIZE) + 1) * (b - a) / SIZE for a, b in itertools.pairwise(counters)])
    expected = 20000 * np.sin(2 * np.pi * 1000 * (places - 1 - HALF) / RATE)
    assert np.abs(np.concatenate(blocks[1:]) - expected).max() < 3


def test_steps_as_long_as_they_should_be_keep_the_samples_bit_for_bit():
    samples, steps = sound(5), ControlStepSound(SIZE)
    blocks = [steps.next(Strip(1, c, RATE, samples[c - 4000 : c]))[0] for c in range(8000, 40001, SIZE)]
    np.testing.assert_array_equal(np.concatenate(blocks), samples[8000 - SIZE - HALF : 40000 - HALF])


@pytest.mark.parametrize(("n", "is_resampled", "is_first"), [(399, 0, 0), (400, 1, 0), (1601, 0, 0), (8001, 0, 1)])
def test_nothing_is_stretched_over_a_gap(n, is_resampled, is_first):
    samples, steps = sound(5), ControlStepSound(SIZE)
    steps.next(Strip(1, 20000, RATE, samples[16000:20000]))
    block, first = steps.next(Strip(1, 20000 + n, RATE, samples[16000 + n : 20000 + n]))
    as_heard = samples[20000 + n - SIZE - HALF : 20000 + n - HALF]
    assert (not np.array_equal(block, as_heard), first) == (is_resampled, is_first)


# Into a dataset


def test_columns_are_the_same_from_videos_and_from_pictures_and_gaps_are_noted(tmp_path, capsys):
    session = Session(tmp_path / "sessions", sound(20))
    pause = counters_of(20)
    episodes = [counters_of(20, 30000), [*pause, *counters_of(15, pause[-1] + 20000, seed=1)]]
    videos = attached(recorded(tmp_path / "videos", session, episodes, video=True), tmp_path / "sessions")
    shutil.rmtree(tmp_path / "sessions")  # pictures need no file
    capsys.readouterr()
    images = attached(recorded(tmp_path / "images", session, episodes))
    assert (
        "episode 1, observation.audio.mic: 35 frames, exact samples of 35 from the pictures" in capsys.readouterr().out
    )
    np.testing.assert_array_equal(column(videos), column(images))
    is_first = np.zeros(55, bool)
    is_first[[0, 20, 40]] = True
    np.testing.assert_array_equal(column(images, "is_first").reshape(-1), is_first)
    expected = []
    for counters in episodes:
        steps = ControlStepSound(SIZE)
        expected += [steps.next(session.strip(counter))[0] for counter in counters]
    np.testing.assert_array_equal(column(images), expected)
    assert images.meta.features[KEY]["info"] == {"sample_rate": RATE, "encoding": "pcm_s16"}
    assert images.meta.features[PICTURE]["info"]["microphone"] == KEY
    store = EpisodeStore.from_dataset(images, [KEY, "action"])
    assert (store.starts, store.ends) == ([0, 20, 40], [20, 40, 55])  # memory ends where the policy is reset


def test_a_rate_that_the_frame_rate_does_not_divide_becomes_one_that_it_does(tmp_path):
    """LeRobot's own 30 frames per second, and 16,000 Hz."""
    session = Session(tmp_path / "sessions", sound(8))
    root = recorded(tmp_path / "heard", session, [[8000 + round(i * RATE / 30) for i in range(40)]])
    edit_info(root, lambda info: info.update(fps=30))
    dataset = attached(root)
    assert dataset.meta.features[KEY]["info"]["sample_rate"] == 15990
    assert column(dataset).shape == (40, 533)


def test_a_timecode_that_cannot_be_read_follows_from_its_neighbours(tmp_path, capsys):
    session = Session(tmp_path / "sessions", sound(8))
    counters = [8000 + SIZE * i for i in range(20)]
    good = attached(recorded(tmp_path / "good", session, [counters]), tmp_path / "sessions")

    class Torn(Session):
        def picture(self, counter: int) -> np.ndarray:
            is_torn = counter in [counters[i] for i in (0, 7, 8, 19)]
            return super().picture(counter) * np.uint8(0 if is_torn else 1)

    torn = Torn(tmp_path / "sessions", sound(8))
    broken = attached(recorded(tmp_path / "broken", torn, [counters]), tmp_path / "sessions")
    assert "4 timecodes could not be read" in capsys.readouterr().out
    np.testing.assert_array_equal(column(broken), column(good))
    np.testing.assert_array_equal(column(broken, "is_first"), column(good, "is_first"))


def test_only_the_episodes_are_named_whose_sound_is_missing(tmp_path):
    first, second = (Session(tmp_path / "sessions", sound(8), session) for session in (0x11, 0x22))

    class Both(Session):
        def picture(self, counter: int) -> np.ndarray:
            return (first if counter < 20000 else second).picture(counter)

    both = Both(tmp_path / "unused", sound(8))
    root = recorded(tmp_path / "heard", both, [counters_of(8), counters_of(8, 30000)], video=True)
    session_path(tmp_path / "sessions", 0x11, "2026-01-01_00-00-00").unlink()
    with pytest.raises(InputError, match=r"images\.mic, episode 0: its pictures were compressed.*_00000011\.wav"):
        attached(root, tmp_path / "sessions")


def test_a_dataset_of_the_hub_gets_no_sound_of_this_machines_sessions_by_itself(tmp_path, monkeypatch, capsys):
    """Whoever saw a session's pictures could name it in their own, and have its voices copied."""
    monkeypatch.setattr(camera_sound, "SESSIONS", tmp_path / "own")
    session = Session(tmp_path / "own", sound(8))
    root = recorded(tmp_path / "strange", session, [counters_of(8)], video=True)
    (root / ".cache/huggingface").mkdir(parents=True)
    with pytest.raises(InputError, match="came from the Hub and may be a stranger's"):
        attached(root)
    write_audio(tmp_path / "other0.wav", sound(8), RATE)
    places = DatasetPlace("me/strange", str(root)), DatasetPlace("me/copy", str(tmp_path / "copy"))
    attach_audio(AttachAudioConfig(*places, files=f"{tmp_path}/other{{episode}}.wav", microphone="other"))
    with pytest.raises(InputError, match="came from the Hub and may be a stranger's"):
        attached(tmp_path / "copy")
    shutil.rmtree(root / ".cache")
    attached(root)
    assert "0.2 to 0.9 s of" in capsys.readouterr().out


def test_a_second_microphone_follows_and_the_pauses_of_the_first_are_kept(tmp_path):
    session, table = (Session(tmp_path / "sessions", sound(20), number) for number in (0x11, 0x22))
    pause = counters_of(20)
    root = recorded(tmp_path / "heard", session, [[*pause, *counters_of(15, pause[-1] + 20000, seed=1)]], table=table)
    one, both = DatasetPlace("me/one", str(tmp_path / "one")), DatasetPlace("me/both", str(tmp_path / "both"))
    attach_audio(AttachAudioConfig(DatasetPlace("me/heard", str(root)), one, microphone="mic"))
    attach_audio(AttachAudioConfig(one, both))
    dataset = LeRobotDataset("me/both", root=tmp_path / "both")
    assert {KEY, "observation.audio.table"} <= set(dataset.features)
    assert np.flatnonzero(column(dataset, "is_first")).tolist() == [0, 20]
    assert not survey(tmp_path / "both").damage


def test_a_hand_back_begins_anew_however_short_the_pause(tmp_path):
    session = Session(tmp_path / "sessions", sound(8))
    root = recorded(tmp_path / "heard", session, [counters_of(9)], by_person=[0, 0, 0, 1, 1, 1, 0, 0, 0])
    assert np.flatnonzero(column(attached(root), "is_first")).tolist() == [0, 6]


def test_what_is_missing_is_named_and_nothing_is_written(tmp_path):
    session = Session(tmp_path / "sessions", sound(8))
    root = recorded(tmp_path / "heard", session, [counters_of(10)], video=True)
    with pytest.raises(InputError, match=r"session's file \*_abcdef01.wav is not in .*--session=FOLDER"):
        attached(root)
    write_audio(session_path(tmp_path / "short", session.session, "x"), sound(0.1), RATE)
    with pytest.raises(InputError, match="has 1600 samples, and a frame needs 8000"):
        attached(root, tmp_path / "short")
    with pytest.raises(InputError, match=r"fps=20, and the control steps are 33\.3 ms apart"):
        attached(recorded(tmp_path / "fast", session, [[8000 + 533 * i for i in range(10)]]))
    assert not list(tmp_path.glob("*_with_sound"))


def test_a_policy_never_sees_a_microphone_and_is_not_trained_without_its_sound(tmp_path):
    """A policy that was trained deaf would read the spectrogram, and hear."""
    session = Session(tmp_path / "sessions", sound(4))
    root = recorded(tmp_path / "heard", session, [counters_of(8)])
    dataset = attached(root)
    for options in ({"use_audio": False}, {}):
        config = PlaybyearConfig(device="cpu", fps=FPS, use_vision=False, vision_width=8, image_size=48, **options)
        policy = make_policy(config, ds_meta=dataset.meta)
        assert PICTURE not in policy.config.input_features
    unheard = LeRobotDataset("me/heard", root=root)
    for options in ({"use_audio": False}, {"use_audio": False, "use_vision": False}):
        config = PlaybyearConfig(device="cpu", fps=FPS, vision_width=8, image_size=48, **options)
        with pytest.raises(
            ValueError, match=r"sound is not attached: playbyear-attach-audio --dataset\.repo_id=me/heard"
        ):
            make_policy(config, ds_meta=unheard.meta)


# While acting


def acting(pictures: list[np.ndarray]) -> dict[str, torch.Tensor]:
    """An observation as LeRobot prepares it."""
    tensor = torch.from_numpy(np.stack(pictures)).type(torch.float32) / 255
    return {PICTURE: tensor.permute(0, 3, 1, 2).contiguous(), "observation.state": torch.zeros(len(pictures), 2)}


def test_a_policy_hears_while_acting_what_attaching_writes(tmp_path):
    session = Session(tmp_path / "sessions", sound(20))
    episodes = [counters_of(25), counters_of(25, 100000, seed=3)]
    dataset = attached(recorded(tmp_path / "heard", session, episodes))
    step = MicrophonePicturesToAudioStep([KEY], RATE, FPS)
    step = MicrophonePicturesToAudioStep(**step.get_config())  # as from a checkpoint
    with_sound = {**acting([session.picture(9000)]), KEY: torch.ones(1, SIZE)}
    assert step.observation(with_sound) is with_sound
    heard = []
    for counters in episodes:
        step.reset()
        heard += [step.observation(acting([session.picture(counter)]))[KEY] for counter in counters]
    assert heard[0].shape == (1, SIZE)
    np.testing.assert_array_equal((torch.cat(heard).numpy() * 32768).astype(np.int16), column(dataset))


def test_a_microphone_that_does_not_fit_the_policy_is_told_at_once(tmp_path):
    session = Session(tmp_path, sound(8))
    observation = acting([session.picture(9000)])
    for step, said in (
        (
            MicrophonePicturesToAudioStep(["observation.audio.gripper"], RATE, FPS),
            r"hears 'gripper'.*the cameras are mic",
        ),
        (MicrophonePicturesToAudioStep([KEY], 48000, FPS), "has sample_rate=16000, .* give sample_rate=48000"),
    ):
        with pytest.raises(InputError, match=said):
            step.observation(observation)
    with pytest.raises(InputError, match="carries no samples"):
        MicrophonePicturesToAudioStep([KEY], RATE, FPS).observation(acting([np.zeros((224, 224, 3), np.uint8)]))


def test_a_loop_of_another_rate_is_told_after_a_second(tmp_path):
    session, step = Session(tmp_path, sound(8)), MicrophonePicturesToAudioStep([KEY], RATE, FPS)
    for i in range(22):
        step.observation(acting([session.picture(8000 + 533 * i)]))
    with pytest.raises(InputError, match=r"fps=20, and the control steps are 33\.3 ms apart"):
        step.observation(acting([session.picture(8000 + 533 * 22)]))
