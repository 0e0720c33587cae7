"""Training and rollout are one function: stepping through an episode equals one forward over it."""

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

N_STEPS, SAMPLES = 55, 800


def make_config(cameras=("front",), microphones=("gripper",), **options) -> PlaybyearConfig:
    inputs = {"observation.state": PolicyFeature(FeatureType.STATE, (7,))}
    inputs |= {f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 40, 40)) for name in cameras}
    inputs |= {f"observation.audio.{name}": PolicyFeature(FeatureType.STATE, (SAMPLES,)) for name in microphones}
    defaults = {"image_size": 32, "vision_width": 4, "hidden_size": 32, "sample_rate": 16000, "device": "cpu"}
    return PlaybyearConfig(
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (4,))},
        push_to_hub=False,
        **(defaults | options),
    )


def make_policy(**options) -> PlaybyearPolicy:
    """A policy whose running statistics have seen something."""
    torch.manual_seed(0)
    policy = PlaybyearPolicy(make_config(**options))
    policy.train()
    policy.forward(run_ending_at(make_episode(seed=9, config=policy.config), 30, policy.config))
    return policy.eval()


def make_episode(seed: int, config: PlaybyearConfig, n_frames: int = N_STEPS) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    episode = {"action": torch.rand(n_frames, 4, generator=generator) * 2 - 1}
    for key, feature in config.input_features.items():
        if key in config.audio_keys:
            episode[key] = torch.randint(-3000, 3000, (n_frames, *feature.shape), generator=generator).to(torch.int16)
        else:
            episode[key] = torch.rand(n_frames, *feature.shape, generator=generator)
    return episode


def window(episode, key: str, last: int, n_frames: int):
    """Frames up to `last` as LeRobot pads them: (1, n_frames, ...) and the flags (1, n_frames)."""
    wanted = torch.arange(last - n_frames + 1, last + 1)
    return episode[key][wanted.clamp(min=0)].unsqueeze(0), (wanted < 0).unsqueeze(0)


def run_ending_at(episode, last: int, config: PlaybyearConfig, n_steps: int | None = None):
    n_frames = (n_steps or config.n_supervised_steps) + config.audio_frames + config.memory_steps
    batch = {}
    for key in config.input_features:
        batch[key], batch[f"{key}_is_pad"] = window(episode, key, last, n_frames)
    steps = n_steps or config.n_supervised_steps
    batch["action"], batch["action_is_pad"] = window(episode, "action", last, steps)
    return batch


def step_through(policy, episodes):
    policy.reset()
    actions = []
    for t in range(len(episodes[0]["action"])):
        observation = {key: torch.stack([e[key][t] for e in episodes]) for key in policy.config.input_features}
        actions.append(policy.select_action(observation))
    return torch.stack(actions, dim=1)  # (n_episodes, T, 4)


@pytest.mark.parametrize(
    "options",
    [
        {"n_supervised_steps": 1},
        {"n_supervised_steps": 6},
        {"normalize_encodings": False, "low_dimensional_gain": 1.0},
        {"action_range": 2.0},
        {"use_audio": False},
        {"use_vision": False},
        {"use_memory": False},
        {"cameras": ("front", "side"), "microphones": ("gripper", "table")},
    ],
    ids=str,
)
@torch.no_grad()
def test_stepping_equals_one_forward_over_the_episode(options):
    policy = make_policy(**options)
    episode = make_episode(seed=1, config=policy.config)
    stepped = step_through(policy, [episode])
    with torch.enable_grad():  # the network as it learns; steps are taken by its folded copy
        whole = policy.predict_run(run_ending_at(episode, N_STEPS - 1, policy.config, N_STEPS), N_STEPS)
    torch.testing.assert_close(stepped, whole, atol=1e-5, rtol=0)


@pytest.mark.parametrize("n_supervised_steps", [1, 6])
@torch.no_grad()
def test_training_windows_equal_stepping_at_every_frame(n_supervised_steps):
    policy = make_policy(n_supervised_steps=n_supervised_steps)
    episode = make_episode(seed=2, config=policy.config)
    stepped = step_through(policy, [episode])
    for last in range(N_STEPS):
        with torch.enable_grad():
            predicted = policy.predict_run(run_ending_at(episode, last, policy.config))
        for back in range(min(n_supervised_steps, last + 1)):
            torch.testing.assert_close(predicted[:, -1 - back], stepped[:, last - back], atol=1e-5, rtol=0)


@torch.no_grad()
def test_two_environments_in_one_batch_equal_each_alone():
    policy = make_policy()
    episodes = [make_episode(seed, policy.config) for seed in (3, 4)]
    together = step_through(policy, episodes)
    alone = torch.cat([step_through(policy, [episode]) for episode in episodes])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=0)


@torch.no_grad()
def test_the_past_matters_exactly_as_far_as_the_windows_reach():
    policy = make_policy(n_supervised_steps=1)
    config = policy.config
    episode = make_episode(seed=5, config=config, n_frames=80)
    before = policy.predict_run(run_ending_at(episode, 79, config))
    key = "observation.audio.gripper"
    oldest = 79 - (config.memory_steps - 1) - (config.audio_frames - 1)
    episode[key][oldest - 1] = 0
    torch.testing.assert_close(policy.predict_run(run_ending_at(episode, 79, config)), before, atol=0, rtol=0)
    episode[key][oldest] = 0
    assert not torch.equal(policy.predict_run(run_ending_at(episode, 79, config)), before)


@torch.no_grad()
def test_acting_is_exact_under_autocast():
    policy = make_policy()
    episode = make_episode(seed=1, config=policy.config)
    expected = step_through(policy, [episode])

    with torch.autocast("cpu", dtype=torch.bfloat16):
        actions = step_through(policy, [episode])

    assert actions.dtype == torch.float32
    torch.testing.assert_close(actions, expected, rtol=0, atol=0)


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


def test_noise_on_low_dimensional_observations_is_for_training_alone():
    policy = make_policy(low_dimensional_noise=0.5, use_vision=False, use_audio=False)
    batch = run_ending_at(make_episode(seed=10, config=policy.config), 30, policy.config)
    with torch.no_grad():
        torch.testing.assert_close(policy.predict_run(batch), policy.predict_run(batch), atol=0, rtol=0)
        policy.train()
        assert not torch.equal(policy.predict_run(batch), policy.predict_run(batch))
