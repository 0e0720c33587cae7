"""Shapes and sizes of every block, as in the paper, and augmentation."""

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from test_policy_contract import make_config
from torch import nn
from torchvision.models import resnet18

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.cpu_inference import FoldedVisionEncoder
from lerobot_playbyear.policy.image_augmentation import Augmentation, resize
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.policy.networks import VisionEncoder

NO_AUGMENTATION = {
    f"augmentation_{kind}": 0.0 for kind in ("crop", "brightness", "hue", "degrees", "translate", "scale")
}


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.fixture(scope="module")
def policy() -> PlaybyearPolicy:
    """The policy with the defaults, that is the paper's sizes, on the simulation's observations."""
    config = PlaybyearConfig(
        input_features={
            "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, 84, 84)),
            "observation.audio.gripper": PolicyFeature(FeatureType.STATE, (800,)),
            "observation.state": PolicyFeature(FeatureType.STATE, (7,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (4,))},
        sample_rate=16000,
        device="cpu",
    )
    return PlaybyearPolicy(config).eval()


def test_the_vision_encoder_is_resnet18_with_nine_channels_and_no_classifier(policy):
    reference = resnet18()
    reference.conv1 = nn.Conv2d(9, 64, 7, stride=2, padding=3, bias=False)
    reference.fc = nn.Identity()
    encoder = policy.model.vision["images_front"]
    assert count(encoder) == count(reference) == 11_195_328
    reference.load_state_dict(encoder.network.state_dict())
    images = torch.rand(2, 9, 64, 64)
    assert encoder(torch.rand(1, 9, 224, 224)).shape == (1, 512)
    with torch.no_grad():
        torch.testing.assert_close(
            encoder(images), reference.eval()((images - encoder.mean) / encoder.std), rtol=1e-4, atol=1e-4
        )


def test_a_quarter_of_the_width_is_a_sixteenth_of_the_weights():
    encoder = VisionEncoder(3, 16)
    assert encoder(torch.rand(2, 9, 84, 84)).shape == (2, 128)
    assert count(encoder) < 11_195_328 / 15


@pytest.mark.parametrize(("size", "in_bfloat16"), [(8, False), (16, False), (17, True), (48, True)])
def test_single_pixels_are_learned_from_in_full_precision(size, in_bfloat16):
    """On a CPU with bfloat16 the gradient of the last stage would be random, and be written beyond its memory."""
    encoder = FoldedVisionEncoder(VisionEncoder(3, 4))
    stacks = torch.rand(2, 9, size, size)
    reference = encoder(stacks)
    with torch.autocast("cpu", torch.bfloat16):
        embeddings = encoder(stacks)
    assert (embeddings.dtype is torch.bfloat16) == in_bfloat16
    if not in_bfloat16:
        torch.testing.assert_close(embeddings, reference)


def test_the_audio_encoder_is_four_convolutions_of_kernel_seven_over_time(policy):
    encoder = policy.model.hearing["audio_gripper"]
    shapes = []
    value = torch.rand(2, 160, 57)
    for layer in encoder.layers:
        value = layer(value)
        shapes.append(tuple(value.shape[1:]))
    assert shapes[::2] == [(64, 51), (32, 45), (16, 39), (8, 33)]
    assert all(isinstance(layer, nn.ReLU) for layer in list(encoder.layers)[1::2])
    assert encoder(torch.rand(2, 160, 57)).shape == (2, 8, 33)
    assert encoder.embedding_size == 264
    assert count(encoder) == 71_744 + 14_368 + 3_600 + 904


def test_fusion_memory_and_head_have_the_papers_sizes(policy):
    assert [layer.weight.shape for layer in policy.model.fusion.layers if isinstance(layer, nn.Linear)] == [
        (1024, 512 + 264 + 7),
        (1024, 1024),
        (50, 1024),
    ]
    assert count(policy.model.fusion) == 1_903_666
    memory = policy.model.memory_head
    assert (memory.lstm.num_layers, memory.lstm.hidden_size, memory.lstm.bidirectional) == (1, 50, False)
    assert count(memory.lstm) == 20_400
    assert count(memory.head) == 1_105_924
    actions = memory(100 * torch.randn(3, 17, 50))
    assert actions.shape == (3, 8, 4)
    assert actions.abs().max() <= 1


def test_a_training_item_has_as_many_frames_as_its_windows_reach_back(policy):
    config = policy.config
    assert (config.n_run_frames, config.n_image_frames, config.n_audio_frames) == (17, 19, 56)
    assert config.observation_delta_indices == list(range(-55, 1))
    assert config.action_delta_indices == list(range(-7, 1))


def test_all_frames_of_a_run_share_one_draw_and_runs_differ():
    torch.manual_seed(0)
    image = torch.rand(1, 1, 3, 40, 40)
    augmented = Augmentation(make_config())(image.expand(2, 6, 3, 40, 40), 32)
    assert augmented.shape == (2, 6, 3, 32, 32)
    assert (augmented == augmented[:, :1]).all()
    assert not torch.allclose(augmented[0], augmented[1], atol=1e-3)
    assert augmented.min() >= 0
    assert augmented.max() <= 1


def test_a_rotated_wide_image_keeps_its_right_angles():
    """Three corners of a square in the middle of a 2:1 image, followed through a rotation."""
    torch.manual_seed(3)
    images = torch.zeros(1, 1, 3, 60, 120)
    corners = [(20, 50), (20, 70), (40, 50)]
    turned = NO_AUGMENTATION | {"augmentation_degrees": 30.0}
    found = []
    for row, column in corners:
        torch.manual_seed(3)
        dot = images.clone()
        dot[..., row - 1 : row + 2, column - 1 : column + 2] = 1.0
        dot = Augmentation(make_config(**turned))(dot, 120)[0, 0, 0]
        grid = torch.arange(120.0)
        # Back to pixels of the original: the height was stretched by two.
        found.append(torch.stack([(dot.sum(1) @ grid) / dot.sum() / 2, (dot.sum(0) @ grid) / dot.sum()]))
    across, down = found[1] - found[0], found[2] - found[0]
    assert abs(across[0]) > 1  # it was turned
    assert abs(across @ down) / 20**2 < 0.02
    torch.testing.assert_close(across.norm(), torch.tensor(20.0), rtol=0.02, atol=0)


def test_shrinking_averages_instead_of_skipping_pixels():
    stripes = torch.zeros(1, 1, 3, 96, 96)
    stripes[..., ::2] = 1.0
    plain = Augmentation(make_config(**NO_AUGMENTATION))
    for shrunk in (resize(stripes, 32), plain(stripes, 32)):
        torch.testing.assert_close(shrunk, torch.full_like(shrunk, 0.5), rtol=0, atol=0.1)


@pytest.mark.parametrize(("height", "size"), [(40, 40), (40, 90), (60, 32)])
def test_augmentation_without_strength_is_resizing(height, size):
    images = torch.rand(2, 3, 3, height, 40)
    plain = Augmentation(make_config(**NO_AUGMENTATION))(images, size)
    torch.testing.assert_close(plain, resize(images, size), rtol=0, atol=1e-4)


def test_brightness_and_hue_leave_grey_grey():
    grey = torch.full((4, 2, 3, 20, 20), 0.5)
    colours = NO_AUGMENTATION | {"augmentation_brightness": 0.05, "augmentation_hue": 0.05}
    augmented = Augmentation(make_config(**colours))(grey, 20)
    torch.testing.assert_close(augmented[:, :, 0], augmented[:, :, 2], rtol=0, atol=5e-3)
    levels = augmented[:, 0, 0, 0, 0]
    assert ((levels > 0.5 * 0.94) & (levels < 0.5 * 1.06)).all()
    assert levels.std() > 0
