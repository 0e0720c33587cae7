"""A recording with a microphone that is killed: every episode that repair keeps gets its sound."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.utils.feature_utils import hw_to_dataset_features

from lerobot_playbyear.audio.attach_audio import AttachAudioConfig, DatasetPlace, attach_audio
from lerobot_playbyear.audio.audio_files import write_audio
from lerobot_playbyear.audio.control_steps import ControlStepSound
from lerobot_playbyear.audio.microphone_pictures import Strip, read_timecode
from lerobot_playbyear.microphones.camera import MicrophoneCamera, MicrophoneCameraConfig
from lerobot_playbyear.repair.repair import RepairConfig, repair

RATE, FPS, N_FRAMES, KEY = 16000, 20, 12, "observation.images.mic"


def record(root: Path, sessions: Path, noise: Path, video: bool) -> None:
    """Episodes one after the other, as lerobot-record makes them, until somebody ends it."""
    camera = MicrophoneCamera(MicrophoneCameraConfig(file=str(noise), save_to=str(sessions)))
    features = hw_to_dataset_features({"a.pos": float, "mic": (224, 224, 3)}, "observation", video)
    features |= hw_to_dataset_features({"a.pos": float}, "action", video)
    camera.connect()
    dataset = LeRobotDataset.create("me/killed", FPS, features, root=root, use_videos=video)
    while True:
        for _ in range(N_FRAMES):
            begun, low = time.perf_counter(), np.zeros(1, np.float32)
            dataset.add_frame({"observation.state": low, "action": low, KEY: camera.read_latest(), "task": "listen"})
            time.sleep(max(begun + 1 / FPS - time.perf_counter(), 0))
        dataset.save_episode()


@pytest.mark.slow
@pytest.mark.parametrize("video", [False, True], ids=["pictures", "videos"])
def test_killed_at_ten_moments_every_episode_that_repair_keeps_gets_its_sound(video, tmp_path):
    rng = np.random.default_rng(int(video))
    samples = rng.normal(0, 3000, 60 * RATE).astype(np.int16)
    noise = write_audio(tmp_path / "noise.wav", samples, RATE)
    n_kept = 0
    for number in range(10):
        root, sessions = tmp_path / f"run{number}", tmp_path / f"sessions{number}"
        child = os.fork()
        if child == 0:
            try:
                record(root, sessions, noise, video)
            finally:
                os._exit(1)
        time.sleep(rng.uniform(3, 9))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        if not list(root.glob("data/*/*.parquet")):
            continue  # it was killed before there was anything
        report = repair(RepairConfig(root=root))
        root = report.target or root
        repaired = LeRobotDataset("me/killed", root=root, video_backend="pyav", return_uint8=True)
        if repaired.num_episodes == 0:
            continue
        target = attach_audio(AttachAudioConfig(DatasetPlace("me/killed", str(root)), session=sessions))
        heard = LeRobotDataset("me/killed_with_sound", root=target, video_backend="pyav", return_uint8=True)
        assert heard.num_episodes == repaired.num_episodes
        n_kept += heard.num_episodes
        for i in range(len(heard)):
            frame = heard[i]
            session, counter = read_timecode(frame[KEY].permute(1, 2, 0).numpy()) or (0, 0)
            if frame["frame_index"] == 0:
                steps = ControlStepSound(RATE // FPS)
            kept = samples[np.arange(counter - RATE // 4, counter) % len(samples)]
            block, _ = steps.next(Strip(session, counter, RATE, kept))
            np.testing.assert_array_equal(frame["observation.audio.mic"].numpy(), block)
    assert n_kept >= 10
