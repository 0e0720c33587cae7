"""`lerobot-rollout` with a microphone: policies hear in every strategy, and one without a microphone says so."""

from pathlib import Path

import lerobot_operator  # noqa: F401  (LeRobot finds the arm of joints then)
import numpy as np
import pytest
from dataset_factory import make_dataset
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_rollout
from support.shared import TINY, run_in_process

from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.audio.attach_audio import AttachAudioConfig, DatasetPlace, attach_audio
from lerobot_playbyear.datasets import audio_feature
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.scripts.commands import train


def record_arm(root: Path, microphones=("gripper",)) -> Path:
    """Two short episodes of the arm of joints, with microphones."""
    numbers = {"dtype": "float32", "shape": (3,), "names": ["shoulder.pos", "elbow.pos", "gripper.pos"]}
    features = {
        "observation.images.front": {"dtype": "image", "shape": (48, 64, 3), "names": ["height", "width", "channel"]},
        "observation.state": numbers,
        **{f"observation.audio.{name}": audio_feature(sample_rate=16000, fps=20) for name in microphones},
        "action": numbers,
    }
    make_dataset(root, (12, 12), features=features, repo_id="tests/arm")
    return root


@pytest.fixture(scope="module")
def arm_dataset(tmp_path_factory):
    return record_arm(tmp_path_factory.mktemp("rollout") / "arm")


def train_on(arm_dataset, folder, *options):
    """A policy that knows nothing, with these options."""
    data = ("--dataset.repo_id=tests/arm", f"--dataset.root={arm_dataset}")
    assert run_in_process(train, *TINY, *data, "--steps=1", f"--output_dir={folder}", *options) is None
    return folder / "checkpoints/last/pretrained_model"


@pytest.fixture(scope="module")
def policy(arm_dataset, tmp_path_factory):
    return train_on(arm_dataset, tmp_path_factory.mktemp("policy") / "train")


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


def rollout(policy, *options):
    """`lerobot-rollout` on the arm of joints."""
    given = (f"--policy.path={policy}", "--robot.type=playbyear_joints", "--device=cpu", "--fps=20", "--task=Reach out")
    run_in_process(lerobot_rollout.main, *given, "--duration=0.5", "--return_to_initial_position=false", *options)


def test_a_policy_that_hears_says_that_there_is_no_sound_and_moves_nothing(policy, told):
    with pytest.raises(InputError, match=r"hears 'gripper'.*the cameras are front.*type: microphone"):
        rollout(policy)
    assert told == []
    with pytest.raises(ValueError, match="RTC inference is not supported by policy type 'playbyear'"):
        rollout(policy, "--inference.type=rtc")


def microphone(folder: Path, *names: str) -> str:
    """Cards that play noise, no place of it like another."""
    noise = np.random.default_rng(3).normal(0, 3000, 30 * 16000).astype(np.int16)
    path = write_audio(folder / "noise.wav", noise, 16000)
    cards = (f"{name}: {{type: microphone, file: {path}, save_to: none}}" for name in names or ("gripper",))
    return f"--robot.cameras={{{', '.join(cards)}}}"


@pytest.fixture
def heard(monkeypatch):
    """The sound that policies act on, step by step."""
    all_heard, act = [], PlaybyearPolicy.select_action

    def spy(self, batch, **options):
        all_heard.append(batch["observation.audio.gripper"][0].cpu().numpy())
        return act(self, batch, **options)

    monkeypatch.setattr(PlaybyearPolicy, "select_action", spy)
    return all_heard


RECORDED = {
    "sentry": (),
    "episodic": ("--dataset.num_episodes=1", "--dataset.episode_time_s=1.5"),
    "dagger": ("--teleop.type=playbyear_joint_leader", "--strategy.record_autonomous=true"),
}


@pytest.mark.parametrize(
    "strategy",
    ["base", "dagger", *(pytest.param(name, marks=pytest.mark.slow) for name in RECORDED if name != "dagger")],
)
def test_a_policy_hears_on_a_robot_what_its_recording_holds(strategy, policy, told, heard, tmp_path):
    root, options = tmp_path / "rollout", [f"--strategy.type={strategy}", "--duration=1.5", "--play_sounds=false"]
    if strategy in RECORDED:
        dataset = ("--dataset.repo_id=tests/rollout_heard", "--dataset.no_stamp=true", f"--dataset.root={root}")
        fixed = ("--dataset.video=false", "--dataset.push_to_hub=false", "--dataset.fps=20")
        options += [*dataset, *fixed, *RECORDED[strategy]]
    rollout(policy, microphone(tmp_path), *options)
    assert len(told) >= len(heard) >= 15
    if strategy in RECORDED:
        target = attach_audio(AttachAudioConfig(DatasetPlace("tests/rollout_heard", str(root))))
        dataset = LeRobotDataset("tests/rollout_heard_with_sound", root=target, video_backend="pyav")
        kept = np.array(dataset.hf_dataset.with_format("numpy")["observation.audio.gripper"])
        assert len(heard) - len(kept) in (0, 1)  # the last step may come too late to be kept
        np.testing.assert_array_equal((np.array(heard)[: len(kept)] * 32768).astype(np.int16), kept)


def test_a_reference_microphone_is_another_camera_of_the_robot(told, heard, tmp_path):
    two = record_arm(tmp_path / "arm", ("gripper", "room"))
    policy = train_on(two, tmp_path / "train", "--policy.reference_microphone=room")
    with pytest.raises(InputError, match=r"hears 'room'.*the cameras are front, gripper"):
        rollout(policy, microphone(tmp_path))
    assert told == []
    rollout(policy, microphone(tmp_path, "gripper", "room"))
    assert len(told) >= len(heard) >= 5


@pytest.mark.slow
def test_a_policy_that_does_not_hear_acts(arm_dataset, told, tmp_path):
    rollout(train_on(arm_dataset, tmp_path / "train", "--policy.use_audio=false"))
    assert 5 <= len(told) <= 11
    assert all(sorted(action) == ["elbow.pos", "gripper.pos", "shoulder.pos"] for action in told)
    assert np.isfinite([list(action.values()) for action in told]).all()
