"""What the policy refuses, with one error that says what to do, and what it derives from seconds."""

from types import SimpleNamespace

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.factory import make_policy, make_pre_post_processors
from test_policy_contract import make_config

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

MICROPHONE = "observation.audio.gripper"
SMALL = {"image_size": 32, "vision_width": 4, "hidden_size": 32, "device": "cpu", "push_to_hub": False}


def dataset_meta(fps: int = 20, sample_rate: int | None = 16000, samples: int = 800, audio: bool = True):
    """What `make_policy` reads of a dataset."""
    info = {"encoding": "pcm_s16"} | ({} if sample_rate is None else {"sample_rate": sample_rate})
    names = ["height", "width", "channels"]
    features = {
        "observation.images.front": {"dtype": "image", "shape": (40, 40, 3), "names": names},
        "observation.state": {"dtype": "float32", "shape": (7,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
    }
    if audio:
        features[MICROPHONE] = {"dtype": "int16", "shape": (samples,), "names": None, "info": info}
    return SimpleNamespace(features=features, fps=fps, stats={}, root=None)


def test_lerobot_finds_and_makes_the_policy_from_its_name_and_a_dataset():
    import lerobot_policy_playbyear  # noqa: F401

    config = PreTrainedConfig.get_choice_class("playbyear")(**SMALL)
    policy = make_policy(config, ds_meta=dataset_meta())
    assert isinstance(policy, PlaybyearPolicy)
    assert config.sample_rate == 16000
    assert config.audio_keys == [MICROPHONE]
    assert config.low_dimensional_keys == ["observation.state"]


@pytest.mark.parametrize(("fps", "frames"), [(5, 10), (20, 40), (30, 60)])
def test_two_seconds_are_as_many_frames_as_the_frame_rate_says(fps, frames):
    config = PlaybyearConfig(fps=fps, n_supervised_steps=1, device="cpu")
    meta = dataset_meta(fps=fps)
    windows = resolve_delta_timestamps(config, meta)
    assert config.n_audio_frames == frames + 9
    assert len(windows[MICROPHONE]) == max(frames + 9, 12)
    assert windows[MICROPHONE][-1] == 0
    assert windows["action"] == [0]


@pytest.mark.parametrize(
    ("options", "meta", "message"),
    [
        ({}, {"audio": False}, r"observation\.audio.*use_audio=false"),
        ({}, {"fps": 30, "samples": 1600, "sample_rate": 48000}, r"fps=20.*--policy\.fps=30"),
        ({"use_audio": False}, {"fps": 30}, r"fps=30.*fps=20.*--policy\.fps=30"),
        ({"sample_rate": 48000}, {}, r"gripper.*16000 Hz.*48000 Hz.*--policy\.sample_rate=16000"),
        ({"fps": 30}, {"fps": 30, "samples": 533}, r"16000 / fps 30 is not an integer"),
        ({}, {"sample_rate": None}, r"info\.sample_rate.*--policy\.sample_rate"),
    ],
    ids=["no audio key", "other fps", "other fps, deaf", "other rate", "S not an integer", "rate unknown"],
)
def test_a_dataset_that_does_not_fit_is_refused(options, meta, message):
    with pytest.raises(ValueError, match=message):
        make_policy(PlaybyearConfig(**SMALL, **options), ds_meta=dataset_meta(**meta))


def test_a_trained_policy_refuses_a_dataset_without_sound():
    config = make_config()
    with pytest.raises(ValueError, match=r"observation\.audio"):
        config.set_dataset_feature_metadata(dataset_meta(audio=False).features)


def test_missing_action_camera_and_inputs_are_refused():
    config = make_config()
    config.output_features = {}
    with pytest.raises(ValueError, match="no 'action'"):
        PlaybyearPolicy(config)
    with pytest.raises(ValueError, match=r"No camera.*use_vision=false"):
        PlaybyearPolicy(make_config(cameras=()))
    with pytest.raises(ValueError, match=r"fps must be at least 1, got 0"):
        make_config(fps=0)
    with pytest.raises(ValueError, match="too few for 4 convolutions"):
        PlaybyearPolicy(make_config(audio_window_s=0.5))


def test_the_checkpoint_of_another_policy_is_refused():
    features = {"observation.environment_state": PolicyFeature(FeatureType.ENV, (3,))}
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (4,))}
    with pytest.raises(ValueError, match=r"'act'.*'playbyear'"):
        PlaybyearPolicy(ACTConfig(input_features=features, output_features=outputs, device="cpu"))


def test_only_low_dimensional_observations_and_the_action_are_normalised(tmp_path):
    config = make_config()
    stats = {key: {"mean": torch.full(f.shape, 2.0), "std": torch.full(f.shape, 4.0)} for key, f in
             config.input_features.items()}  # fmt: skip
    stats["action"] = {"min": torch.full((4,), -3.0), "max": torch.full((4,), 1.0)}
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    before.save_pretrained(tmp_path)
    after.save_pretrained(tmp_path)
    # The overrides with which `lerobot-train` opens a checkpoint.
    overrides = {
        "normalizer_processor": {
            "features": {**config.input_features, **config.output_features},
            "norm_map": config.normalization_mapping,
            "stats": stats,
        }
    }
    reopened = make_pre_post_processors(config, pretrained_path=str(tmp_path), preprocessor_overrides=overrides)
    batch = {
        "observation.images.front": torch.rand(2, 5, 3, 40, 40),
        MICROPHONE: torch.randint(-3000, 3000, (2, 5, 800)),
        "observation.state": torch.full((2, 5, 7), 10.0),
        "action": torch.full((2, 5, 4), 0.0),
        "observation.state_is_pad": torch.zeros(2, 5, dtype=torch.bool),
    }
    for preprocessor, postprocessor in ((before, after), reopened):
        processed = preprocessor(dict(batch))
        torch.testing.assert_close(processed["observation.images.front"], batch["observation.images.front"])
        assert torch.equal(processed[MICROPHONE], batch[MICROPHONE])
        torch.testing.assert_close(processed["observation.state"], torch.full((2, 5, 7), 2.0))
        torch.testing.assert_close(processed["action"], torch.full((2, 5, 4), 0.5))
        assert "observation.state_is_pad" in processed
        torch.testing.assert_close(postprocessor(torch.full((1, 4), 0.5)), torch.zeros(1, 4))
    assert config.normalization_mapping["VISUAL"] is NormalizationMode.IDENTITY


@pytest.mark.parametrize("n_steps", [20, 5000, 100_000])
def test_the_learning_rate_warms_up_and_decays_within_any_number_of_steps(n_steps):
    config = make_config()
    optimizer = config.get_optimizer_preset().build([torch.nn.Parameter(torch.zeros(1))])
    scheduler = config.get_scheduler_preset().build(optimizer, n_steps)
    factor = scheduler.lr_lambdas[0]
    assert max(factor(step) for step in range(0, n_steps, max(1, n_steps // 100))) == pytest.approx(1.0, abs=0.02)
    assert factor(n_steps) == pytest.approx(0.01)
