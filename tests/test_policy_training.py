"""Batches and checkpoints: any sensors, any history length, and everything that training must save."""

from types import SimpleNamespace

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state
from test_policy_contract import make_config, make_episode, make_policy, run_ending_at

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

MICROPHONE = "observation.audio.gripper"


def batch_of(policy, lasts=(30, 45), seed=1):
    episode = make_episode(seed, policy.config)
    runs = [run_ending_at(episode, last, policy.config) for last in lasts]
    return {key: torch.cat([run[key] for run in runs]) for key in runs[0]}


def test_checkpoints_hold_weights_statistics_and_optimizer(tmp_path):
    policy = make_policy(n_supervised_steps=2)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()
    for _ in range(2):
        policy.forward(batch_of(policy))[0].backward()
        optimizer.step()
    policy.eval()
    policy.save_pretrained(tmp_path)
    save_optimizer_state(optimizer, tmp_path)
    again = PlaybyearPolicy.from_pretrained(tmp_path)
    assert not again.training
    assert policy.state_dict().keys() == again.state_dict().keys()
    assert any("spectrogram" in key and "mean" in key for key in again.state_dict())
    for name, value in policy.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=0, atol=0)
    with torch.no_grad():
        batch = batch_of(policy)
        torch.testing.assert_close(again.predict_run(batch), policy.predict_run(batch), rtol=0, atol=1e-6)
    resumed = policy.config.get_optimizer_preset().build(again.get_optim_params())
    load_optimizer_state(resumed, tmp_path)
    assert len(resumed.state_dict()["state"]) == len(list(policy.parameters()))


def test_a_checkpoint_that_lacks_weights_of_the_policy_is_refused(tmp_path):
    make_policy(use_audio=False).save_pretrained(tmp_path)
    with pytest.raises(ValueError, match="does not fit"):
        PlaybyearPolicy.from_pretrained(tmp_path, config=make_config())


def test_a_checkpoint_of_other_sizes_is_refused(tmp_path):
    make_policy().save_pretrained(tmp_path)
    with pytest.raises(ValueError, match="does not fit"):
        PlaybyearPolicy.from_pretrained(tmp_path, config=make_config(vision_width=8))


@pytest.mark.parametrize("n_supervised_steps", [1, 4])
def test_longer_histories_than_needed_change_nothing(n_supervised_steps):
    policy = make_policy(n_supervised_steps=n_supervised_steps)
    config = policy.config
    batch = batch_of(policy, lasts=(3, 30))
    needed = {"observation.state": config.n_run_frames, "action": n_supervised_steps}
    needed["observation.images.front"], needed[MICROPHONE] = config.n_image_frames, config.n_audio_frames
    short = {name: value[:, -needed[name.removesuffix("_is_pad")] :] for name, value in batch.items()}
    with torch.no_grad():
        assert policy.forward(short)[0] == policy.forward(batch)[0]
    short[MICROPHONE] = short[MICROPHONE][:, 1:]
    with pytest.raises(ValueError, match=rf"{MICROPHONE}.*{config.n_audio_frames} frames"):
        policy.forward(short)


def test_several_windows_share_what_single_windows_compute_alone():
    many = make_policy(n_supervised_steps=4)
    single = PlaybyearPolicy(make_config(n_supervised_steps=1)).eval()
    single.load_state_dict(many.state_dict())
    episode = make_episode(3, many.config)
    with torch.no_grad():
        shared = many.predict_run(run_ending_at(episode, 33, many.config))
        alone = torch.cat([single.predict_run(run_ending_at(episode, last, single.config)) for last in range(30, 34)])
    torch.testing.assert_close(shared[0], alone[:, 0], rtol=0, atol=1e-5)


def test_cameras_microphones_and_states_of_any_number_and_size():
    config = PlaybyearConfig(
        fps=30,
        sample_rate=48000,
        image_size=32,
        vision_width=4,
        hidden_size=32,
        n_supervised_steps=2,
        device="cpu",
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
        expected = (policy.predict_run(batch)[..., 0] - batch["action"]).square().mean()
    torch.testing.assert_close(loss, expected)


@pytest.mark.parametrize(
    ("option", "prefix"), [("use_vision", "observation.images."), ("use_audio", "observation.audio.")]
)
def test_a_sense_that_is_switched_off_does_not_matter(option, prefix):
    policy = make_policy(**{option: False}, n_supervised_steps=2)
    batch = batch_of(policy)
    without = {key: value for key, value in batch.items() if not key.startswith(prefix)}
    with torch.no_grad():
        assert policy.forward(without)[0] == policy.forward(batch)[0]


def test_without_memory_only_the_newest_image_and_embedding_count():
    policy = make_policy(use_memory=False, n_supervised_steps=1, image_size=64)
    batch = batch_of(policy)
    with torch.no_grad():
        before = policy.predict_run(batch)
        batch["observation.images.front"][:, :-1] = 0
        batch["observation.state"][:, :-1] = 0
        torch.testing.assert_close(policy.predict_run(batch), before, rtol=0, atol=0)


def test_a_renamed_observation_that_lost_its_padding_flags_is_still_padded():
    """`--rename_map` renames an observation but not its flags."""
    policy = make_policy(n_supervised_steps=2)
    batch = batch_of(policy, lasts=(3, 30))
    with torch.no_grad():
        expected = policy.predict_run(batch)
        renamed = {key: value for key, value in batch.items() if key not in (f"{MICROPHONE}_is_pad",)}
        del renamed["observation.state_is_pad"]
        torch.testing.assert_close(policy.predict_run(renamed), expected, rtol=0, atol=0)


def test_sample_weights_get_one_loss_per_item():
    policy = make_policy(n_supervised_steps=3)
    batch = batch_of(policy, lasts=(1, 30))
    with torch.no_grad():
        losses, _ = policy.forward(batch, reduction="none")
        for item, loss in enumerate(losses):
            alone = {key: value[item : item + 1] for key, value in batch.items()}
            torch.testing.assert_close(policy.forward(alone)[0], loss)


def test_masked_windows_do_not_count():
    policy = make_policy(n_supervised_steps=3)
    batch = batch_of(policy)
    with torch.no_grad():
        error = (policy.predict_run(batch) - batch["action"]).square().mean(-1)
        batch["action_is_pad"] = torch.tensor([[True, True, False], [True, False, True]])
        loss, _ = policy.forward(batch)
    torch.testing.assert_close(loss, (error[0, 2] + error[1, 1]) / 2)


def test_a_rollout_with_another_sample_rate_is_refused():
    policy = make_policy()
    frame = {key: torch.zeros(1, *feature.shape) for key, feature in policy.config.input_features.items()}
    frame[MICROPHONE] = torch.zeros(1, 2400)
    with pytest.raises(ValueError, match=rf"{MICROPHONE}.*2400.*800"):
        policy.select_action(frame)


def test_broken_sound_stops_training_with_its_key():
    policy = make_policy()
    batch = batch_of(policy)
    batch[MICROPHONE] = batch[MICROPHONE] / 32768.0
    batch[MICROPHONE][1, -3, 5] = float("nan")
    with pytest.raises(ValueError, match=rf"{MICROPHONE}.*NaN"):
        policy.forward(batch)


def test_lerobots_metadata_of_another_frame_rate_is_refused():
    with pytest.raises(ValueError, match=r"--policy\.fps=30"):
        PlaybyearPolicy(make_config(), dataset_meta=SimpleNamespace(fps=30))
