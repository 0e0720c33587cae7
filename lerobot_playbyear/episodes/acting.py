"""A policy and everything between it and an environment, loaded as lerobot-eval loads them."""

from dataclasses import dataclass
from typing import Any

from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs import EnvConfig, make_env_pre_post_processors
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline


@dataclass(frozen=True)
class RolloutParts:
    """What LeRobot's `rollout` needs beside an environment."""

    policy: PreTrainedPolicy
    env_preprocessor: PolicyProcessorPipeline
    env_postprocessor: PolicyProcessorPipeline
    preprocessor: PolicyProcessorPipeline
    postprocessor: PolicyProcessorPipeline

    def in_order(self) -> tuple[Any, ...]:
        """As `rollout` takes them, after the environment."""
        return self.policy, self.env_preprocessor, self.env_postprocessor, self.preprocessor, self.postprocessor


def load_for_rollout(policy_cfg: PreTrainedConfig, env_cfg: EnvConfig) -> RolloutParts:
    """Loads a trained policy for an environment.

    Args:
        policy_cfg: Its configuration, with `pretrained_path`.
        env_cfg: Where it shall act.
    """
    policy = make_policy(cfg=policy_cfg, env_cfg=env_cfg)
    policy.eval()
    preprocessor, postprocessor = make_pre_post_processors(
        policy_cfg=policy_cfg,
        pretrained_path=str(policy_cfg.pretrained_path),
        preprocessor_overrides={"device_processor": {"device": str(policy.config.device)}},
    )
    env_preprocessor, env_postprocessor = make_env_pre_post_processors(env_cfg=env_cfg, policy_cfg=policy_cfg)
    return RolloutParts(policy, env_preprocessor, env_postprocessor, preprocessor, postprocessor)
