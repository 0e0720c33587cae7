"""HG-DAgger with policies that predict chunks of actions: what the policy chose by itself is never imitated."""

import numpy as np
import pytest
import torch
from dagger_factory import command
from dataset_factory import TASK, dataset_features, make_dataset, random_frame
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from lerobot.utils.random_utils import set_seed
from safetensors.torch import load_file

from lerobot_playbyear.datasets.errors import PlaybyearError

pytestmark = pytest.mark.usefixtures("one_thread")

FEATURES = dataset_features(image_size=16, microphones=())
BY_EXPERT = "...xx......xxx.......x..."


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "demos"
    make_dataset(root, (20, 20), features=FEATURES)
    return root


def attempts(root, by_policy: float):
    """An attempt with short corrections, whose policy added `by_policy` to everything that it did."""
    dataset = LeRobotDataset.create("tests/attempts", 20, FEATURES, root=root, use_videos=False)
    rng = np.random.default_rng(1)
    for mark in BY_EXPERT:
        frame = {**random_frame(FEATURES, rng), "intervention": np.array([mark == "x"]), "task": TASK}
        frame["action"] += by_policy * (mark != "x")
        dataset.add_frame(frame)
    dataset.save_episode()
    dataset.finalize()


def checkpoint(config, demos, folder):
    """A policy with random weights, as LeRobot saves it."""
    set_seed(0)
    meta = LeRobotDataset("tests/noise", root=demos).meta
    policy = make_policy(config, ds_meta=meta)
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(policy.config, dataset_stats=meta.stats):
        processor.save_pretrained(folder)
    return folder


def corrected(policy, demos, corrections, out):
    """The weights after three updates on recorded corrections."""
    data = ("--demos.repo_id=tests/noise", f"--demos.root={demos}", "--interventions.repo_id=tests/attempts")
    run = ("--episodes=0", "--updates=3", "--batch_size=8", "--learning_rate=1e-3", "--warmup_updates=0")
    command(f"--policy.path={policy}", *data, f"--interventions.root={corrections}", *run, f"--output_dir={out}")
    return load_file(out / "checkpoints/last/pretrained_model/model.safetensors")


def test_the_policys_own_actions_behind_a_correction_change_nothing(demos, tmp_path):
    """Also with ACT's variational encoder, which reads the chunk that is to be predicted."""
    small = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "n_vae_encoder_layers": 1}
    act = ACTConfig(
        **small, chunk_size=6, n_action_steps=6, pretrained_backbone_weights=None, device="cpu", push_to_hub=False
    )
    policy = checkpoint(act, demos, tmp_path / "act")
    attempts(tmp_path / "mild", by_policy=0.0)
    attempts(tmp_path / "wild", by_policy=5.0)

    mild = corrected(policy, demos, tmp_path / "mild", tmp_path / "out_mild")
    wild = corrected(policy, demos, tmp_path / "wild", tmp_path / "out_wild")

    before = load_file(policy / "model.safetensors")
    assert any(not torch.equal(mild[key], before[key]) for key in before)
    assert all(torch.equal(mild[key], wild[key]) for key in mild)


def test_a_policy_whose_loss_knows_no_mask_is_refused_before_any_work(demos, tmp_path):
    """VQ-BeT's loss counts every action of a chunk."""
    small = {"gpt_input_dim": 16, "gpt_output_dim": 16, "gpt_hidden_dim": 16, "gpt_n_layer": 1, "gpt_n_head": 2}
    vqbet = VQBeTConfig(
        **small, crop_shape=None, pretrained_backbone_weights=None, use_group_norm=True, device="cpu", push_to_hub=False
    )
    policy = checkpoint(vqbet, demos, tmp_path / "vqbet")
    attempts(tmp_path / "attempts", by_policy=0.0)

    with pytest.raises(PlaybyearError, match=r"'vqbet' learns chunks of 11 actions.*would be imitated.*such as act"):
        corrected(policy, demos, tmp_path / "attempts", tmp_path / "out")

    assert not (tmp_path / "out").exists()
