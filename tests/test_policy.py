"""The policy: its configuration, training and rollout as one function, checkpoints, the paper's network, and what acts."""

import copy
from types import SimpleNamespace

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies.factory import make_policy as make_policy_for
from lerobot.policies.factory import make_pre_post_processors
from support.policy import (
    MICROPHONE,
    N_STEPS,
    batch_of,
    make_config,
    make_episode,
    make_policy,
    run_ending_at,
    step_through,
)
from torch import nn
from torchvision.models import resnet18

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.cpu_inference import FoldedVisionEncoder, PackedResNet
from lerobot_playbyear.policy.image_augmentation import Augmentation, resize
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.policy.networks import VisionEncoder

TINY = {"image_size": 32, "vision_width": 4, "hidden_size": 32, "device": "cpu", "push_to_hub": False}
NO_AUGMENTATION = {
    f"augmentation_{kind}": 0.0 for kind in ("crop", "brightness", "hue", "degrees", "translate", "scale")
}


# Configuration


def dataset_meta(fps: int = 20):
    """What `make_policy` reads of a dataset."""
    info = {"encoding": "pcm_s16", "sample_rate": 16000}
    names = ["height", "width", "channels"]
    features = {
        "observation.images.front": {"dtype": "image", "shape": (40, 40, 3), "names": names},
        "observation.state": {"dtype": "float32", "shape": (7,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
        MICROPHONE: {"dtype": "int16", "shape": (800,), "names": None, "info": info},
    }
    return SimpleNamespace(features=features, fps=fps, stats={}, root=None)


def test_lerobot_finds_and_makes_the_policy_from_its_name_and_a_dataset():
    import lerobot_policy_playbyear  # noqa: F401

    config = PreTrainedConfig.get_choice_class("playbyear")(**TINY)
    policy = make_policy_for(config, ds_meta=dataset_meta())
    assert isinstance(policy, PlaybyearPolicy)
    assert config.sample_rate == 16000
    assert config.audio_keys == [MICROPHONE]
    assert config.low_dimensional_keys == ["observation.state"]


@pytest.mark.parametrize(("fps", "frames"), [(5, 10), (20, 40), (30, 60)])
def test_two_seconds_are_as_many_frames_as_the_frame_rate_says(fps, frames):
    config = PlaybyearConfig(fps=fps, n_supervised_steps=1, device="cpu")
    windows = resolve_delta_timestamps(config, dataset_meta(fps))
    assert config.n_audio_frames == frames + 9
    assert len(windows[MICROPHONE]) == max(frames + 9, 12)
    assert windows[MICROPHONE][-1] == 0
    assert windows["action"] == [0]


def test_only_low_dimensional_observations_and_the_action_are_normalised():
    config = make_config()
    stats = {key: {"mean": torch.full(f.shape, 2.0), "std": torch.full(f.shape, 4.0)} for key, f in
             config.input_features.items()}  # fmt: skip
    stats["action"] = {"min": torch.full((4,), -3.0), "max": torch.full((4,), 1.0)}
    preprocessor, postprocessor = make_pre_post_processors(config, dataset_stats=stats)
    batch = {
        "observation.images.front": torch.rand(2, 5, 3, 40, 40),
        MICROPHONE: torch.randint(-3000, 3000, (2, 5, 800)),
        "observation.state": torch.full((2, 5, 7), 10.0),
        "action": torch.full((2, 5, 4), 0.0),
        "observation.state_is_pad": torch.zeros(2, 5, dtype=torch.bool),
    }
    processed = preprocessor(dict(batch))
    for key in ("observation.images.front", MICROPHONE, "observation.state_is_pad"):
        assert torch.equal(processed[key], batch[key])
    torch.testing.assert_close(processed["observation.state"], torch.full((2, 5, 7), 2.0))
    torch.testing.assert_close(processed["action"], torch.full((2, 5, 4), 0.5))
    torch.testing.assert_close(postprocessor(torch.full((1, 4), 0.5)), torch.zeros(1, 4))


# Training and rollout are one function: stepping through an episode equals one forward over it


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"normalize_encodings": False, "low_dimensional_gain": 1.0, "action_range": 2.0},
        {"low_dimensional_noise": 0.5},
        {"use_audio": False},
        {"use_vision": False},
        {"use_memory": False},
        {"cameras": ("front", "side"), "microphones": ("gripper", "table")},
        {"microphones": ("gripper", "room"), "reference_microphone": "room", "audio_envelope_gain": 1.0},
    ],
    ids=str,
)
@torch.no_grad()
def test_stepping_equals_one_forward_over_the_episode(options):
    policy = make_policy(**options)
    episode = make_episode(seed=1, config=policy.config)
    stepped = step_through(policy, [episode])
    with torch.enable_grad():  # the network as it learns; steps are taken by its folded copy
        whole = policy.act_from(policy.memory_run(run_ending_at(episode, N_STEPS - 1, policy.config, N_STEPS), N_STEPS))
    torch.testing.assert_close(stepped, whole, atol=1e-5, rtol=0)


@pytest.mark.parametrize("n_supervised_steps", [1, 6])
@torch.no_grad()
def test_training_windows_equal_stepping_at_every_frame(n_supervised_steps):
    policy = make_policy(n_supervised_steps=n_supervised_steps)
    episode = make_episode(seed=2, config=policy.config)
    stepped = step_through(policy, [episode])
    for last in (0, 1, 5, 9, 10, 39, 40, 41, N_STEPS - 1):
        with torch.enable_grad():
            predicted = policy.act_from(policy.memory_run(run_ending_at(episode, last, policy.config)))
        for back in range(min(n_supervised_steps, last + 1)):
            torch.testing.assert_close(predicted[:, -1 - back], stepped[:, last - back], atol=1e-5, rtol=0)


@torch.no_grad()
def test_two_environments_in_one_batch_equal_each_alone():
    policy = make_policy()
    episodes = [make_episode(seed, policy.config, 15) for seed in (3, 4)]
    together = step_through(policy, episodes)
    alone = torch.cat([step_through(policy, [episode]) for episode in episodes])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=0)


def test_every_frame_is_encoded_once():
    policy = make_policy(n_supervised_steps=6)
    seen: list[int] = []
    encoder = policy.model.vision["images_front"]
    encoder.register_forward_hook(lambda module, inputs, output: seen.append(len(inputs[0])))
    policy.train()
    policy.forward(run_ending_at(make_episode(seed=6, config=policy.config), 40, policy.config))
    assert seen == [6 + 10 - 1]
    seen.clear()
    step_through(policy, [make_episode(seed=7, config=policy.config, n_frames=5)])
    assert seen == [1] * 5


def test_windows_before_the_episode_are_not_supervised():
    policy = make_policy(n_supervised_steps=6)
    episode = make_episode(seed=8, config=policy.config)
    batch = run_ending_at(episode, 2, policy.config)
    loss, _ = policy.forward(batch)
    batch["action"][:, :3] += 7.0  # targets that lie before the episode
    assert policy.forward(batch)[0] == loss
    batch["action"][:, 3:] += 7.0
    assert policy.forward(batch)[0] > loss


def test_cameras_microphones_and_states_of_any_number_and_size():
    config = PlaybyearConfig(
        **(TINY | {"fps": 30, "sample_rate": 48000, "n_supervised_steps": 2}),
        input_features={
            "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, 48, 64)),
            "observation.images.wrist": PolicyFeature(FeatureType.VISUAL, (3, 20, 20)),
            "observation.audio.left": PolicyFeature(FeatureType.STATE, (1600,)),
            "observation.audio.right": PolicyFeature(FeatureType.STATE, (1600,)),
            "observation.state": PolicyFeature(FeatureType.STATE, (5,)),
            "observation.force": PolicyFeature(FeatureType.STATE, (6,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (2,)),
            "observation.gripper": PolicyFeature(FeatureType.STATE, (1,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (9,))},
    )
    policy = PlaybyearPolicy(config)
    n_frames = len(config.observation_delta_indices)
    batch = {key: torch.rand(3, n_frames, *feature.shape) for key, feature in config.input_features.items()}
    batch["observation.gripper"] = torch.rand(3, n_frames)  # as LeRobot reads a feature of shape (1,)
    batch["observation.images.wrist"] = torch.randint(0, 255, (3, n_frames, 3, 20, 20), dtype=torch.uint8)
    batch["action"] = torch.rand(3, 2, 9)
    policy.train()
    loss, log = policy.forward(batch)
    loss.backward()
    assert all(parameter.grad is not None for parameter in policy.parameters())
    assert all(isinstance(value, float) for value in log.values())
    frame = {key: torch.rand(3, *feature.shape) for key, feature in config.input_features.items()}
    assert policy.select_action(frame).shape == (3, 9)
    assert policy.predict_action_chunk(frame).shape == (3, 1, 9)


def test_an_action_of_one_number_is_supervised():
    """LeRobot reads a feature of shape (1,) as a scalar per frame."""
    policy = make_policy(n_supervised_steps=2)
    policy.config.output_features["action"] = PolicyFeature(FeatureType.ACTION, (1,))
    policy = PlaybyearPolicy(policy.config).eval()
    batch = batch_of(policy)
    batch["action"] = batch["action"][..., 0]  # (B, K) with B = K = 2
    with torch.no_grad():
        loss, _ = policy.forward(batch)
        expected = (policy.act_from(policy.memory_run(batch))[..., 0] - batch["action"]).square().mean()
    torch.testing.assert_close(loss, expected)


def test_a_renamed_observation_that_lost_its_padding_flags_is_still_padded():
    """`--rename_map` renames an observation but not its flags."""
    policy = make_policy(n_supervised_steps=2)
    batch = batch_of(policy, lasts=(3, 30))
    with torch.no_grad():
        expected = policy.act_from(policy.memory_run(batch))
        renamed = {key: value for key, value in batch.items() if key not in (f"{MICROPHONE}_is_pad",)}
        del renamed["observation.state_is_pad"]
        torch.testing.assert_close(policy.act_from(policy.memory_run(renamed)), expected, rtol=0, atol=0)


def test_a_rollout_with_another_sample_rate_is_refused():
    policy = make_policy()
    frame = {key: torch.zeros(1, *feature.shape) for key, feature in policy.config.input_features.items()}
    frame[MICROPHONE] = torch.zeros(1, 2400)
    with pytest.raises(ValueError, match=rf"{MICROPHONE}.*2400.*800"):
        policy.select_action(frame)


# Checkpoints


def test_a_checkpoint_that_does_not_fit_is_refused(tmp_path):
    make_policy(use_audio=False).save_pretrained(tmp_path)
    for options in ({}, {"use_audio": False, "vision_width": 8}):
        with pytest.raises(ValueError, match="does not fit"):
            PlaybyearPolicy.from_pretrained(tmp_path, config=make_config(**options))


# The paper's network


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.fixture(scope="module")
def of_the_paper() -> PlaybyearPolicy:
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


def test_the_vision_encoder_is_resnet18_with_nine_channels_and_no_classifier(of_the_paper):
    reference = resnet18()
    reference.conv1 = nn.Conv2d(9, 64, 7, stride=2, padding=3, bias=False)
    reference.fc = nn.Identity()
    encoder = of_the_paper.model.vision["images_front"]
    assert count(encoder) == count(reference) == 11_195_328
    reference.load_state_dict(encoder.network.state_dict())
    images = torch.rand(2, 9, 64, 64)
    assert encoder(torch.rand(1, 9, 224, 224)).shape == (1, 512)
    with torch.no_grad():
        torch.testing.assert_close(
            encoder(images), reference.eval()((images - encoder.mean) / encoder.std), rtol=1e-4, atol=1e-4
        )


def test_the_audio_encoder_is_four_convolutions_of_kernel_seven_over_time(of_the_paper):
    encoder = of_the_paper.model.hearing["audio_gripper"]
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


def test_fusion_memory_and_head_have_the_papers_sizes(of_the_paper):
    assert [layer.weight.shape for layer in of_the_paper.model.fusion.layers if isinstance(layer, nn.Linear)] == [
        (1024, 512 + 264 + 7),
        (1024, 1024),
        (50, 1024),
    ]
    assert count(of_the_paper.model.fusion) == 1_903_666
    memory = of_the_paper.model.memory_head
    assert (memory.lstm.num_layers, memory.lstm.hidden_size, memory.lstm.bidirectional) == (1, 50, False)
    assert count(memory.lstm) == 20_400
    assert count(memory.head) == 1_105_924
    actions = memory(100 * torch.randn(3, 17, 50))
    assert actions.shape == (3, 8, 4)
    assert actions.abs().max() <= 1


# Augmentation of images


def test_all_frames_of_a_run_share_one_draw_and_runs_differ():
    torch.manual_seed(0)
    image = torch.rand(1, 1, 3, 40, 40)
    augmented = Augmentation(make_config())(image.expand(2, 6, 3, 40, 40), 32)
    assert augmented.shape == (2, 6, 3, 32, 32)
    assert (augmented == augmented[:, :1]).all()
    assert not torch.allclose(augmented[0], augmented[1], atol=1e-3)
    assert augmented.min() >= 0
    assert augmented.max() <= 1


def test_shrinking_averages_instead_of_skipping_pixels():
    stripes = torch.zeros(1, 1, 3, 96, 96)
    stripes[..., ::2] = 1.0
    plain = Augmentation(make_config(**NO_AUGMENTATION))
    for shrunk in (resize(stripes, 32), plain(stripes, 32)):
        torch.testing.assert_close(shrunk, torch.full_like(shrunk, 0.5), rtol=0, atol=0.1)


# What acts is a folded copy of what learns: the same function, never that of earlier weights, and in no checkpoint


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


def update(encoder):
    optimizer = torch.optim.Adam(encoder.parameters(), lr=0.1)
    encoder(torch.rand(2, 9, 32, 32)).square().mean().backward()
    optimizer.step()


def load_by_assignment(encoder):
    weights = {name: 1.5 * value for name, value in copy.deepcopy(encoder.state_dict()).items()}
    encoder.load_state_dict(weights, assign=True)


@pytest.mark.parametrize("change", [update, load_by_assignment])
def test_the_folded_copy_follows_every_change_of_the_weights(change, encoder):
    assert_same(encoder)
    before, _ = both(encoder)
    change(encoder)
    after, _ = both(encoder)
    assert (after - before).abs().max() > 1e-2
    assert_same(encoder)


def test_the_copy_is_made_once_per_episode_and_is_in_no_checkpoint():
    policy = make_policy()
    keys, encoder = list(policy.state_dict()), policy.model.vision["images_front"]
    policy.reset()
    made = encoder._folded._copy
    assert made is not None
    episode = make_episode(1, policy.config, 3)
    for t in range(3):
        policy.select_action({key: episode[key][t : t + 1] for key in policy.config.input_features})
    assert encoder._folded._copy is made
    assert list(policy.state_dict()) == keys
    encoder.network.layer1[0].conv1.weight.data.neg_()  # which torch does not count as a change
    policy.reset()
    assert_same(encoder)
    assert policy.train().model.vision["images_front"]._folded._copy is None


def test_acting_is_exact_in_inference_mode_and_under_autocast():
    policy = make_policy()
    episode = make_episode(1, policy.config, 12)
    with torch.no_grad():
        expected = step_through(policy, [episode])
    with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16):
        actions = step_through(policy, [episode])
    assert actions.dtype == torch.float32
    torch.testing.assert_close(actions, expected, rtol=0, atol=0)
    policy.train()
    policy.forward(run_ending_at(episode, 11, policy.config))[0].backward()  # and it still learns


@pytest.mark.parametrize(("width", "size"), [(8, 33), (64, 96)])
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
