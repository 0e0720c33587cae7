"""Actions that no demonstration holds: a policy says which of them it cannot learn, and learns them with a larger range."""

import json

import numpy as np
import pytest
import torch
from dagger_factory import dagger
from dataset_factory import dataset_features, make_dataset
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from support.shared import TINY, run_in_process

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.scripts.commands import train

pytestmark = pytest.mark.usefixtures("one_thread")

FEATURES = dataset_features(image_size=16)
FEATURES["action"]["names"] = ["pan", "lift", "elbow", "gripper"]
BLIND_AND_DEAF = ("--policy.use_vision=false", "--policy.use_audio=false", "--steps=1")


def write(root, actions, by_expert=None):
    """A dataset of one episode with these actions (T, 4)."""

    def frame_of(episode, step, frame):
        is_corrected = np.array([by_expert is None or bool(by_expert[step])])
        return {**frame, "action": np.asarray(actions[step], np.float32), "intervention": is_corrected}

    make_dataset(root, (len(actions),), features=FEATURES, repo_id="tests/reach", frame_of=frame_of)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """`demos`, whose actions lie in [-0.1, 0.1], and `policy`, a checkpoint of a policy that was trained on them."""
    folder = tmp_path_factory.mktemp("base")
    actions = np.random.default_rng(0).uniform(-0.1, 0.1, (30, 4))
    actions[:2] = [[-0.1] * 4, [0.1] * 4]
    write(folder / "demos", actions)
    data = ("--dataset.repo_id=tests/reach", f"--dataset.root={folder / 'demos'}")
    run_in_process(train, *TINY, *BLIND_AND_DEAF, *data, f"--output_dir={folder / 'train'}")
    (folder / "policy").symlink_to(folder / "train/checkpoints/last/pretrained_model")
    return folder


def warnings(capfd):
    return [line for line in "\n".join(capfd.readouterr()).splitlines() if "out of the policy's reach" in line]


# What can be learned


@pytest.mark.parametrize(("action_range", "learned"), [(1.0, 2.0), (2.0, 2.5)])
def test_an_action_outside_the_demonstrations_is_learned_only_within_the_range(action_range, learned):
    """The expert wants 2.5 where the demonstrations end at 2."""
    torch.manual_seed(0)
    config = PlaybyearConfig(
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (3,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        **{"use_vision": False, "use_audio": False, "n_supervised_steps": 1, "hidden_size": 32, "device": "cpu"},
        action_range=action_range,
    )
    stats = {
        "action": {"min": torch.tensor([0.0, -1.0]), "max": torch.tensor([2.0, 1.0])},
        "observation.state": {"mean": torch.zeros(3), "std": torch.ones(3)},
    }
    policy, (before, after) = PlaybyearPolicy(config), make_pre_post_processors(config, dataset_stats=stats)
    batch = before({"observation.state": torch.randn(8, 10, 3), "action": torch.tensor([2.5, 0.5]).expand(8, 1, 2)})
    optimizer = torch.optim.Adam(policy.parameters(), 3e-3)
    for _ in range(150):
        optimizer.zero_grad()
        policy.forward(batch)[0].backward()
        optimizer.step()
    action = after(policy.act_from(policy.memory_run(batch))[0, -1:].detach())[0]
    torch.testing.assert_close(action, torch.tensor([learned, 0.5]), atol=0.03, rtol=0)


# What is said


@pytest.mark.slow
def test_recorded_corrections_out_of_reach_are_said_before_any_update_and_a_wider_policy_takes_them(
    base, tmp_path, capfd
):
    actions, by_expert = np.zeros((20, 4)), np.arange(20) >= 10
    actions[:10] = 0.9  # the policy's own: not learned
    actions[10:15, 1] = 0.14
    write(tmp_path / "corrections", actions, by_expert)
    offline = ("--num_episodes=0", "--steps=1", "--dataset.repo_id=tests/reach", f"--dataset.root={base / 'demos'}")

    dagger(tmp_path, *offline, f"--policy.path={base / 'policy'}", env=())
    (message,) = warnings(capfd)
    assert "the corrections" in message
    assert "'lift' in 50.0 % of 10 frames" in message
    assert "--policy.action_range=1.6" in message

    data = ("--dataset.repo_id=tests/reach", f"--dataset.root={base / 'demos'}")
    wider = ("--policy.action_range=1.6", f"--policy.path={base / 'policy'}")
    once = ("--policy.push_to_hub=false", "--num_workers=0", "--batch_size=2", "--steps=1")
    run_in_process(train, *wider, *data, *once, f"--output_dir={tmp_path / 'wide'}")
    policy = tmp_path / "wide/checkpoints/last/pretrained_model"
    assert json.loads((policy / "config.json").read_text())["action_range"] == 1.6
    dagger(tmp_path, *offline, f"--policy.path={policy}", f"--output_dir={tmp_path / 'out_wide'}", env=())
    assert warnings(capfd) == []
