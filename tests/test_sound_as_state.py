"""Sound as a state: the same numbers in a dataset and at rollout, and LeRobot's policies that read them."""

import json
from pathlib import Path

import draccus
import numpy as np
import pytest
import torch
from dataset_factory import CAMERA, MICROPHONE, dataset_features, make_dataset
from draccus.utils import DecodingError
from lerobot.configs import PipelineFeatureType, PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.envs import make_env, make_env_pre_post_processors, preprocess_observation
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, env_to_policy_features
from lerobot.policies import make_policy_config
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file
from test_peers import needs
from test_sound_picture import SMALL, call, roll_out
from torchvision.ops import FrozenBatchNorm2d

from experiments import act_start, others
from experiments.training import Job
from lerobot_env_playbyear import PlaybyearEnvConfig, SoundAsStateProcessorStep
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.sound_as_state import sound_as_state
from lerobot_playbyear.episodes import frames
from lerobot_playbyear.episodes.environment import RolloutError, env_facts, env_spec
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.script import Script
from lerobot_playbyear.inspection import DatasetSource, check_numbers
from lerobot_playbyear.recording.record import RecordConfig, record

STATE = "observation.environment_state"
TABLE = "observation.audio.table"
TASK = "OccludedGrasp-v1"


def load(root: Path) -> LeRobotDataset:
    return LeRobotDataset("t/sound", root=root, video_backend="pyav")


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> LeRobotDataset:
    """Noise; the keys of its microphones are not in their order."""
    root = tmp_path_factory.mktemp("heard") / "dataset"
    return make_dataset(root, (12, 25, 9), image_size=16, microphones=(TABLE, MICROPHONE))


def test_every_frame_holds_its_samples_and_all_else_stays(original, tmp_path):
    copy = load(sound_as_state(original, tmp_path / "state"))
    assert set(copy.features) == set(original.features) - {MICROPHONE, TABLE} | {STATE}
    states = []
    for row in range(len(original)):
        old, new = original[row], copy[row]
        heard = torch.cat([old[MICROPHONE], old[TABLE]]).float()  # in the order of their keys
        assert torch.equal(new[STATE] * 32768, heard)
        assert all(torch.equal(new[key], old[key]) for key in (CAMERA, "observation.state", "action", "episode_index"))
        states.append(new[STATE].numpy())
    for name, of in (("mean", np.mean), ("std", np.std), ("min", np.min), ("max", np.max)):
        np.testing.assert_allclose(copy.meta.stats[STATE][name], of(states, axis=0), rtol=1e-4, atol=1e-6)
    for name, value in original.meta.stats["observation.state"].items():
        np.testing.assert_array_equal(copy.meta.stats["observation.state"][name], value)
    assert [verdict for verdict in check_numbers(DatasetSource(copy)) if verdict.level == "error"] == []


def test_floats_stay_as_they_are(tmp_path):
    features = dataset_features(image_size=16)
    features[MICROPHONE] |= {"dtype": "float32", "info": {"sample_rate": 16000}}
    heard = make_dataset(tmp_path / "heard", (5,), features=features)
    copy = load(sound_as_state(heard, tmp_path / "state"))
    assert all(torch.equal(copy[row][STATE], heard[row][MICROPHONE]) for row in range(5))


def test_what_has_no_sound_or_no_place_for_it_is_one_clear_error(original, tmp_path):
    deaf = {key: feature for key, feature in dataset_features(image_size=16).items() if key != MICROPHONE}
    full = {**dataset_features(image_size=16), STATE: {"dtype": "float32", "shape": (3,), "names": None}}
    wrong = dataset_features(image_size=16)
    wrong[MICROPHONE] |= {"info": {"sample_rate": 8000}}
    for name, features, message in (
        ("deaf", deaf, "no sound in columns 'observation.audio.<microphone>'.*playbyear-attach-audio"),
        ("full", full, f"has '{STATE}' already.*remove_feature"),
        ("wrong", wrong, r"'observation.audio.gripper' has shape \(800,\); at 8000 Hz .* must be \(400,\)"),
    ):
        with pytest.raises(InputError, match=message):
            sound_as_state(make_dataset(tmp_path / name, (5,), features=features), tmp_path / "state")
    part = LeRobotDataset("t/sound", root=original.root, episodes=[1])
    with pytest.raises(InputError, match=r"opened with 25 of its 46 frames.*without `episodes`"):
        sound_as_state(part, tmp_path / "state")
    with pytest.raises(InputError, match="is there already"):
        sound_as_state(original, tmp_path / "deaf")
    assert not (tmp_path / "state").exists()


# Environments


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """Two attempts of the expert, cut off; both microphones, whose names are not in their order."""
    folder = tmp_path_factory.mktemp("recorded")
    env = env_spec(PlaybyearEnvConfig(task=TASK, episode_length=12, microphones=["table", "gripper"])).make()
    features = frames.dataset_features(env_facts(env))
    with DurableWriter("t/heard", folder / "dataset", 20, features) as writer:
        for seed in (0, 1):
            for frame in frames.episode_frames(play(env, Script(), seed), features):
                writer.add_frame(frame)
            writer.save_episode()
    env.close()
    return sound_as_state(load(folder / "dataset"), folder / "state")


def test_a_rollout_gives_what_the_dataset_holds_bit_for_bit(recorded):
    dataset = load(recorded)
    starts = [0, int(dataset.meta.episodes["length"][0])]
    cfg = PlaybyearEnvConfig(task=TASK, microphones=["table", "gripper"], sound_as_state=True)
    preprocessor, _ = make_env_pre_post_processors(cfg, make_policy_config("act", device="cpu", push_to_hub=False))
    vec = make_env(cfg, n_envs=2)["playbyear"][0]
    observation, _ = vec.reset(seed=[int(dataset[row]["seed"]) for row in starts], options={NEW_ROLLOUT_OPTION: True})
    for frame in range(12):
        batch = preprocessor(preprocess_observation(observation))
        items = [dataset[row + frame] for row in starts]
        for key in (STATE, CAMERA):
            assert torch.equal(batch[key], torch.stack([item[key] for item in items])), (key, frame)
        observation, *_ = vec.step(np.stack([item["action"].numpy() for item in items]))
    vec.close()
    declared = {key: feature.shape for key, feature in env_to_policy_features(cfg).items() if key != "action"}
    assert {key: tuple(value.shape[1:]) for key, value in batch.items() if key in declared} == declared


def test_the_step_declares_what_it_gives_and_refuses_what_it_cannot():
    step = SoundAsStateProcessorStep()
    features = env_to_policy_features(PlaybyearEnvConfig(task=TASK, microphones=["table", "gripper"]))
    declared = step.transform_features({PipelineFeatureType.OBSERVATION: features})[PipelineFeatureType.OBSERVATION]
    with_state = env_to_policy_features(
        PlaybyearEnvConfig(task=TASK, microphones=["table", "gripper"], sound_as_state=True)
    )
    assert declared == with_state
    with pytest.raises(ValueError, match=r"has observation.state; wanted a key 'observation.audio.<microphone>'"):
        step.observation({"observation.state": torch.zeros(1, 7)})


def test_an_environment_without_samples_is_refused_and_so_is_recording_with_the_state(tmp_path):
    with pytest.raises(DecodingError, match=r"sound_as_state.*True does not work: --env.sound=none has no samples"):
        PlaybyearEnvConfig(task=TASK, sound="none", sound_as_state=True)
    arguments = ["--env.type=playbyear", "--env.sound_as_state=true", f"--env.task={TASK}"]
    data = ["--dataset.repo_id=t/new", f"--dataset.root={tmp_path / 'new'}"]
    with pytest.raises(RolloutError, match="Leave it out here"):
        record(draccus.parse(RecordConfig, args=[*arguments, *data]))
    assert not (tmp_path / "new").exists()


# LeRobot's policies


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("act", marks=pytest.mark.slow),  # tests/test_sound_picture.py does the same with pictures of sound
        pytest.param("diffusion", marks=[needs("diffusers", "diffusion"), pytest.mark.slow]),
    ],
)
def test_lerobots_policies_train_and_roll_out_and_hear(name, recorded, tmp_path, one_thread, monkeypatch):
    monkeypatch.setattr(others, "dataset_of", lambda task, condition: recorded)
    settings = f"type={name} pretrained_backbone_weights=null {SMALL[name]}"
    job = Job(others.STUDY, TASK, "state", training_seed=1)
    options = others.training_command(job, settings, tmp_path / "train", "--steps=2")
    call(lerobot_train, *options[1:])
    assert "--dataset.use_imagenet_stats=false" in options
    checkpoint = tmp_path / "train/checkpoints/last/pretrained_model"
    if name == "act":
        norms = [load_file(path / "model.safetensors") for path in (tmp_path / "train.start", checkpoint)]
        before, after = (weights["model.backbone.layer4.1.bn2.running_var"] for weights in norms)
        assert torch.equal(before, after)
        assert not torch.equal(after, torch.ones_like(after))
    sound = others.environment_options(TASK, "state")
    roll_out(checkpoint, tmp_path / "eval", "--env.microphones=[gripper, table]", *sound)
    preprocessor, _ = make_pre_post_processors(
        PreTrainedConfig.from_pretrained(checkpoint), pretrained_path=str(checkpoint)
    )
    policy = get_policy_class(name).from_pretrained(checkpoint).eval()
    dataset = load(recorded)
    batch = {key: value[None] for key, value in dataset[11].items() if key.startswith("observation.")}
    heard = preprocessor({STATE: torch.stack([dataset[row][STATE] for row in range(len(dataset))])})[STATE]
    assert heard.mean(dim=0).tolist() == pytest.approx([0] * 1600, abs=0.01)
    assert heard.std(dim=0, correction=0).tolist() == pytest.approx([1] * 1600, abs=0.01)
    actions = []
    for samples in (batch[STATE], -batch[STATE]):
        policy.reset()
        torch.manual_seed(0)
        actions.append(policy.select_action(preprocessor({**batch, STATE: samples})))
    assert not torch.equal(*actions), "what is heard has no part in what is done"
    policy.reset()
    with pytest.raises(KeyError, match=STATE):
        policy.select_action(preprocessor({key: value for key, value in batch.items() if key != STATE}))


def test_every_policy_of_the_comparison_keeps_lerobots_normalization_of_all_else():
    for settings in others.SETTINGS.values():
        policy = settings.split()[0].removeprefix("type=")
        usual = make_policy_config(policy, device="cpu", push_to_hub=False).normalization_mapping
        given = json.loads(others.NORMALIZATION[policy])
        assert given.pop("ENV") == "MEAN_STD"
        assert given == {kind: mode.value for kind, mode in usual.items()}


def test_act_without_pretrained_weights_begins_with_norms_that_tell_pictures_apart(recorded, tmp_path):
    options = ["pretrained_backbone_weights=null", *SMALL["act"].split()]
    command = act_start.saved_start(options, recorded, tmp_path / "start", seed=0)
    assert command.startswith("python -m experiments.act_start")
    assert "dim_model=32" in command
    written = (tmp_path / "start/model.safetensors").stat().st_mtime_ns
    act_start.saved_start(options, recorded, tmp_path / "start", seed=0)
    assert (tmp_path / "start/model.safetensors").stat().st_mtime_ns == written
    policy = get_policy_class("act").from_pretrained(tmp_path / "start")
    dataset = load(recorded)
    key = dataset.meta.camera_keys[0]
    images = torch.stack([dataset[row][key] for row in range(0, len(dataset), 3)])
    images = (images - images.mean(dim=(0, 2, 3), keepdim=True)) / images.std(dim=(0, 2, 3), keepdim=True)
    calibrated = act_start.difference(policy.model.backbone, images)
    for norm in policy.model.backbone.modules():
        if isinstance(norm, FrozenBatchNorm2d):
            norm.running_mean.zero_()
            norm.running_var.fill_(1)
    assert calibrated > 1.5 * act_start.difference(policy.model.backbone, images)
    act_start.saved_start(options, recorded, tmp_path / "start", seed=1)
    assert (tmp_path / "start/model.safetensors").stat().st_mtime_ns != written
