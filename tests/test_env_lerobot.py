"""`--env.type=playbyear`: what LeRobot's commands get from the environments."""

import re
from pathlib import Path

import draccus
import numpy as np
import pytest
import torch
from draccus.utils import DecodingError
from lerobot.configs import PreTrainedConfig
from lerobot.envs import make_env, make_env_pre_post_processors, preprocess_observation
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies import make_policy_config
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import rollout
from torch import nn

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_env_playbyear import config as config_module
from lerobot_playbyear.recording.record import RecordConfig

AUDIO = "observation.audio"


def vector_env(config: PlaybyearEnvConfig, n_envs: int = 1):
    return make_env(config, n_envs=n_envs, use_async_envs=False)["playbyear"][0]


@pytest.fixture
def policy_config() -> PreTrainedConfig:
    return make_policy_config("act", device="cpu", push_to_hub=False)


class ExpertPolicy(nn.Module):
    """Asks each environment's scripted expert, so that LeRobot's rollout sees successes."""

    def __init__(self, vec):
        super().__init__()
        self._vec = vec
        self.seen: list[dict] = []

    def reset(self):
        """LeRobot calls this before the environments have begun an episode."""

    def select_action(self, observation):
        if not self.seen:
            self._experts = [env.unwrapped.scripted_expert() for env in self._vec.envs]
        self.seen.append(observation)
        return torch.tensor(np.stack([expert.act() for expert in self._experts]), dtype=torch.float32)


@pytest.mark.parametrize(
    ("options", "extra_keys"),
    [
        ({"microphones": ["gripper", "table"], "sample_rate": 48000}, {f"{AUDIO}.gripper", f"{AUDIO}.table"}),
        ({"sound": "contact_force"}, {"observation.contact_force"}),
        ({"sound": "none", "task": "OccludedPickPlace-v1"}, set()),
    ],
)
def test_declared_features_are_what_an_observation_holds(options, extra_keys):
    config = PlaybyearEnvConfig(**options)
    vec = vector_env(config)
    observation, _ = vec.reset(seed=0)
    vec.close()
    observed = {key: tuple(value.shape[1:]) for key, value in preprocess_observation(observation).items()}
    declared = {key: feature.shape for key, feature in env_to_policy_features(config).items() if key != "action"}
    assert observed == declared
    assert set(observed) == {"observation.images.front", "observation.state"} | extra_keys


def test_the_policy_receives_sound_between_minus_one_and_one(policy_config):
    config = PlaybyearEnvConfig()
    vec = vector_env(config)
    raw, _ = vec.reset(seed=0)
    vec.close()
    preprocessor, _ = make_env_pre_post_processors(config, policy_config)
    observation = preprocessor(preprocess_observation(raw))
    pcm = raw["audio.gripper"]
    assert pcm.dtype == np.int16
    assert pcm.any()
    np.testing.assert_array_equal(observation["observation.audio.gripper"].numpy(), pcm / np.float32(32768))
    np.testing.assert_array_equal(observation["observation.state"].numpy(), raw["agent_pos"])


def test_lerobots_rollout_sees_the_experts_succeed(policy_config):
    config = PlaybyearEnvConfig(visualization_width=64, visualization_height=64)
    vec = vector_env(config, n_envs=2)
    policy = ExpertPolicy(vec)
    env_processors = make_env_pre_post_processors(config, policy_config)
    nothing = PolicyProcessorPipeline(steps=[])
    identity = PolicyProcessorPipeline(steps=[], to_transition=lambda x: x, to_output=lambda x: x)
    result = rollout(vec, policy, *env_processors, nothing, identity, seeds=[0, 1])
    assert result["success"].any(dim=1).tolist() == [True, True]
    lengths = (~result["done"]).sum(dim=1) + 1
    steps = [env.unwrapped.n_steps for env in vec.envs]
    vec.close()
    assert lengths.max() == result["done"].shape[1]
    assert steps == lengths.tolist(), "an environment whose episode is over was simulated on"
    assert policy.seen[0]["task"] == [vec.envs[0].unwrapped.task_description] * 2
    assert all(observation["observation.audio.gripper"].abs().max() <= 1 for observation in policy.seen)


def test_options_reach_the_environment_and_rates_that_are_not_given_are_the_tasks():
    config = draccus.parse(
        RecordConfig,
        args=["--env.type=playbyear", "--env.task=TellApart-v1", "--env.task_options={contents: peanuts}",
              "--env.image_size=16", "--env.episode_length=1", "--env.visualization_width=96",
              "--env.visualization_height=96", "--dataset.repo_id=a/b"],
    ).env  # fmt: skip
    assert (config.fps, config.features["audio.gripper"].shape) == (5, (3200,))
    vec = vector_env(config)
    observation, _ = vec.reset(seed=[0])
    assert observation["audio.gripper"].shape == (1, 3200)
    assert observation["pixels"]["front"].shape == (1, 16, 16, 3)
    assert vec.call("render")[0].shape == (96, 96, 3)
    *_, infos = vec.step(np.zeros((1, 4), np.float32))
    assert infos["final_info"]["contents"][0] == "peanuts"
    vec.close()


def test_pictures_of_sound_want_the_policys_distribution_which_nothing_here_imports(monkeypatch):
    monkeypatch.setattr(config_module, "entry_points", lambda group: ())
    with pytest.raises(DecodingError, match=r"env\.spectrogram.*install lerobot_policy_playbyear"):
        PlaybyearEnvConfig(spectrogram="outputs/demos")
    sources = [path.read_text() for path in (Path(__file__).parents[1] / "envs").rglob("*.py")]
    assert not any(
        re.search(r"^\s*(from|import) lerobot_(playbyear|policy_playbyear)", source, re.M) for source in sources
    )
