"""LeRobot's own commands for robots carry no sound: a policy that hears says so there, and one that does not acts."""

import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import lerobot
import numpy as np
import pytest
from lerobot.configs import parser
from lerobot.scripts import lerobot_rollout
from robot_factory import joint_config, noise_file

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.episodes.environment import env_facts, env_spec
from lerobot_playbyear.episodes.frames import dataset_features, episode_frames
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.training.loop import train

TINY = (
    *("--policy.type=playbyear", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.image_size=16"),
    *("--policy.vision_width=4", "--policy.audio_window_s=0.9", "--policy.n_memory_steps=2"),
    *("--policy.n_supervised_steps=4", "--policy.hidden_size=32"),
)


@pytest.fixture(scope="module")
def arm_dataset(tmp_path_factory):
    """Two short episodes of the arm of joints, with its microphone."""
    folder = tmp_path_factory.mktemp("rollout")
    env = env_spec(joint_config(noise_file(folder, 16000), episode_s=0.6)).make()
    try:
        facts = env_facts(env)
        features = dataset_features(facts)
        writer = DurableWriter("tests/arm", folder / "arm", facts.fps, features)
        for seed in range(2):
            actor = SimpleNamespace(reset=lambda env: None, act=lambda observation: np.ones(3, np.float32))
            for frame in episode_frames(play(env, actor, seed=seed), features):
                writer.add_frame(frame)
            writer.save_episode()
    finally:
        env.close()
    return folder / "arm"


@pytest.fixture
def policy(arm_dataset, tmp_path, monkeypatch):
    """Makes a policy that knows nothing, with these options."""

    def make(*options):
        data = ("--dataset.repo_id=tests/arm", f"--dataset.root={arm_dataset}", "--num_workers=0")
        run = ("--steps=1", "--batch_size=2", f"--output_dir={tmp_path / 'train'}")
        monkeypatch.setattr(sys, "argv", ["train", *TINY, *data, *run, *options])
        parser.wrap()(train)()
        return tmp_path / "train/checkpoints/last/pretrained_model"

    return make


@pytest.fixture
def told(monkeypatch):
    """What every robot is told."""
    from lerobot_robot_playbyear_sim import JointArm

    all_told, send = [], JointArm.send_action

    def spy(self, action):
        all_told.append(action)
        return send(self, action)

    monkeypatch.setattr(JointArm, "send_action", spy)
    return all_told


def rollout(monkeypatch, policy, *options):
    """`lerobot-rollout` on the arm of joints."""
    given = (f"--policy.path={policy}", "--robot.type=playbyear_joints", "--device=cpu", "--fps=20", "--task=Reach out")
    monkeypatch.setattr(
        sys, "argv", ["lerobot-rollout", *given, "--duration=0.5", "--return_to_initial_position=false", *options]
    )
    lerobot_rollout.main()


def test_a_policy_that_hears_says_that_there_is_no_sound_and_moves_nothing(policy, told, monkeypatch):
    checkpoint = policy()
    with pytest.raises(ValueError, match="there is no sound in the observation") as caught:
        rollout(monkeypatch, checkpoint)
    assert "observation.audio.gripper is missing" in str(caught.value)
    assert "lerobot-eval or playbyear-dagger with --env.type=playbyear_robot" in str(caught.value)
    assert told == []
    with pytest.raises(ValueError, match="RTC inference is not supported by policy type 'playbyear'"):
        rollout(monkeypatch, checkpoint, "--inference.type=rtc")


@pytest.mark.slow
def test_a_policy_that_does_not_hear_acts(policy, told, monkeypatch):
    rollout(monkeypatch, policy("--policy.use_audio=false"))
    assert 5 <= len(told) <= 11
    assert all(sorted(action) == ["elbow.pos", "gripper.pos", "shoulder.pos"] for action in told)
    assert np.isfinite([list(action.values()) for action in told]).all()


def test_lerobots_policy_server_refuses_the_policy_by_its_type():
    """It takes what is in this list, and says the list to whoever asks for another. Read without grpc, which it needs."""
    path = Path(lerobot.__file__).parent / "async_inference" / "constants.py"
    constants = runpy.run_path(str(path))
    assert "act" in constants["SUPPORTED_POLICIES"]
    assert "playbyear" not in constants["SUPPORTED_POLICIES"]
