"""A policy as an actor, with everything between it and an environment as in lerobot-eval."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs import EnvConfig, make_env_pre_post_processors, preprocess_observation
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import ACTION

from lerobot_playbyear.datasets.checkpoint_steps import check_steps, check_type
from lerobot_playbyear.episodes.environment import task_description
from lerobot_playbyear.episodes.play import Observation


class PolicyActor:
    """A policy as it acts in lerobot-eval, one environment at a time.

    Args:
        policy: The policy; it is reset at each episode's start.
        env_cfg: The environment's configuration, which knows the processors between both.
        preprocessor, postprocessor: The policy's own.
        autocast: Makes the context of the policy's precision.

    Attributes:
        policy: The policy.
    """

    def __init__(
        self,
        policy: PreTrainedPolicy,
        env_cfg: EnvConfig,
        preprocessor: PolicyProcessorPipeline,
        postprocessor: PolicyProcessorPipeline,
        autocast: Callable[[], AbstractContextManager] = nullcontext,
    ) -> None:
        self.policy, self._autocast = policy, autocast
        self._preprocessor, self._postprocessor = preprocessor, postprocessor
        self._env_preprocessor, self._env_postprocessor = make_env_pre_post_processors(env_cfg, policy.config)

    def reset(self, env: gym.Env) -> None:
        """An episode begins."""
        self._env = env
        self.policy.eval()
        self.policy.reset()

    @torch.no_grad()
    def act(self, observation: Observation) -> np.ndarray:
        """The policy's action (action dim,), as the environment takes it."""
        batch: dict[str, Any] = preprocess_observation(_as_batch(observation))
        batch["task"] = [task_description(self._env)]
        with self._autocast():
            action = self.policy.select_action(self._preprocessor(self._env_preprocessor(batch)))
            action = self._env_postprocessor({ACTION: self._postprocessor(action)})[ACTION]
        return action.to("cpu", torch.float32).numpy()[0]


def load_policy_actor(policy_cfg: PreTrainedConfig, env_cfg: EnvConfig) -> PolicyActor:
    """Loads a trained policy for an environment.

    Args:
        policy_cfg: Its configuration, with `pretrained_path`.
        env_cfg: Where it acts.

    Raises:
        InputError: Its processors have steps that nobody registered.
    """
    check_type(policy_cfg.type)
    check_steps(str(policy_cfg.pretrained_path))
    policy = make_policy(cfg=policy_cfg, env_cfg=env_cfg)
    device = torch.device(str(policy.config.device))
    preprocessor, postprocessor = make_pre_post_processors(
        policy_cfg=policy_cfg,
        pretrained_path=str(policy_cfg.pretrained_path),
        preprocessor_overrides={"device_processor": {"device": str(device)}},
    )
    autocast = partial(torch.autocast, device_type=device.type) if policy_cfg.use_amp else nullcontext
    return PolicyActor(policy, env_cfg, preprocessor, postprocessor, autocast)


def _as_batch(raw: Observation) -> Observation:
    """A raw observation as a batch of one."""
    return {key: _as_batch(own) if isinstance(own, dict) else np.asarray(own)[None] for key, own in raw.items()}
