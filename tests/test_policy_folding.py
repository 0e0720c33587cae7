"""What acts is a folded copy of what learns: the same function, never that of earlier weights, and in no checkpoint."""

import copy
import pickle

import pytest
import torch
from test_policy_contract import make_episode, make_policy, run_ending_at, step_through

from lerobot_playbyear.policy.cpu_inference import FoldedVisionEncoder, PackedResNet
from lerobot_playbyear.policy.networks import VisionEncoder


@pytest.fixture
def encoder() -> FoldedVisionEncoder:
    """An encoder whose statistics and norms are not those of a new one."""
    torch.manual_seed(0)
    encoder = FoldedVisionEncoder(VisionEncoder(3, 8))
    for _ in range(3):
        encoder(torch.rand(8, 9, 32, 32))
    for module in encoder.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.uniform_(module.bias, -0.5, 0.5)
    return encoder.eval()


def both(encoder: FoldedVisionEncoder) -> tuple[torch.Tensor, torch.Tensor]:
    """What the encoder computes as it acts, and as it learns, in eval mode."""
    images = torch.rand(2, 9, 40, 40, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        acting = encoder(images)
    return acting, encoder(images).detach()


def assert_same(encoder: FoldedVisionEncoder) -> None:
    acting, learning = both(encoder)
    torch.testing.assert_close(acting, learning, rtol=1e-4, atol=max(1e-4, 1e-5 * float(learning.abs().max())))


def change_in_place(encoder):
    with torch.no_grad():
        encoder.network.conv1.weight.mul_(1.5)


def change_statistics(encoder):
    encoder.network.bn1.running_mean.add_(0.5)


def update(encoder):
    optimizer = torch.optim.Adam(encoder.parameters(), lr=0.1)
    encoder(torch.rand(2, 9, 32, 32)).square().mean().backward()
    optimizer.step()


def load(encoder):
    other = copy.deepcopy(encoder)
    change_in_place(other)
    encoder.load_state_dict(other.state_dict())


def load_by_assignment(encoder):
    other = copy.deepcopy(encoder)
    change_in_place(other)
    encoder.load_state_dict(other.state_dict(), assign=True)


def train_and_return(encoder):
    encoder.train()
    encoder(torch.rand(8, 9, 32, 32))
    encoder.eval()


@pytest.mark.parametrize(
    "change", [change_in_place, change_statistics, update, load, load_by_assignment, train_and_return]
)
def test_the_folded_copy_follows_every_change_of_the_weights(change, encoder):
    assert_same(encoder)
    before, _ = both(encoder)
    change(encoder)
    after, _ = both(encoder)
    assert (after - before).abs().max() > 1e-2
    assert_same(encoder)


def test_a_new_episode_sees_even_what_torch_does_not_count_as_a_change():
    policy = make_policy()
    encoder = policy.model.vision["images_front"]
    policy.reset()
    before, _ = both(encoder)
    encoder.network.layer1[0].conv1.weight.data.neg_()
    policy.reset()
    after, _ = both(encoder)
    assert (after - before).abs().max() > 1e-2 * before.abs().max()
    assert_same(encoder)


def test_the_copy_is_made_once_per_episode_and_is_in_no_checkpoint():
    policy = make_policy()
    keys = list(policy.state_dict())
    policy.reset()
    made = policy.model.vision["images_front"]._folded._copy
    assert made is not None
    episode = make_episode(1, policy.config, 3)
    for t in range(3):
        policy.select_action({key: episode[key][t : t + 1] for key in policy.config.input_features})
    assert policy.model.vision["images_front"]._folded._copy is made
    assert list(policy.state_dict()) == keys
    assert len(list(made.parameters())) < len(list(policy.model.vision["images_front"].network.parameters()))
    assert policy.train().model.vision["images_front"]._folded._copy is None


def test_acting_in_inference_mode_and_under_autocast():
    policy = make_policy()
    episode = make_episode(1, policy.config, 12)
    plain = step_through(policy, [episode])
    with torch.inference_mode():
        torch.testing.assert_close(step_through(policy, [episode]), plain, rtol=0, atol=1e-6)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        coarse = step_through(policy, [episode])
    torch.testing.assert_close(coarse.float(), plain, rtol=0, atol=0.05)
    policy.train()
    policy.forward(run_ending_at(episode, 11, policy.config))[0].backward()  # and it still learns


@pytest.mark.parametrize(("width", "size"), [(8, 33), (16, 84), (64, 96)])
def test_packed_convolutions_compute_the_same_for_one_picture_and_many(width, size):
    torch.manual_seed(width)
    encoder = FoldedVisionEncoder(VisionEncoder(3, width)).eval()
    pictures = torch.rand(5, 9, size, size)
    assert PackedResNet.suits(pictures)
    plain = encoder(pictures).detach()
    with torch.no_grad(), torch.backends.mkldnn.flags(enabled=False):
        assert not PackedResNet.suits(pictures)
        torch.testing.assert_close(encoder(pictures), plain, rtol=1e-4, atol=1e-5)
        assert encoder._folded._packed is None
    for n in (1, 5, 2):
        with torch.inference_mode():
            torch.testing.assert_close(encoder(pictures[:n]), plain[:n], rtol=1e-4, atol=1e-5)
        assert encoder._folded._packed is not None


def test_what_acts_can_be_copied_and_pickled():
    encoder = FoldedVisionEncoder(VisionEncoder(3, 8)).eval()
    pictures = torch.rand(1, 9, 64, 64)
    with torch.no_grad():
        acting = encoder(pictures)
    assert encoder._folded._packed is not None
    for other in (
        copy.deepcopy(encoder),
        pickle.loads(pickle.dumps(encoder)),
    ):  # as a test alone: nothing here loads pickles
        assert other._folded._packed is None
        with torch.no_grad():
            torch.testing.assert_close(other(pictures), acting)
