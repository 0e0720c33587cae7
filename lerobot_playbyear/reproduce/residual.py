"""Residual reinforcement learning on a policy that stays as it is (Johannink et al., 2019), with Stable-Baselines3's SAC.

    python -m lerobot_playbyear.reproduce.residual --policy.path=outputs/train/checkpoints/last/pretrained_model \
        --env.type=playbyear --env.task=OccludedGrasp-v1 --steps=20000 --output_dir=outputs/residual

The learner sees what the policy remembers (its LSTM's output), the arm's state and the policy's action. It adds a bounded part
to the displacement of the hand, nothing at first; the gripper stays the policy's. The reward is the task's own, 1 at success.
Needs the extra `rl`. The same command goes on where a run was killed; the episode in progress is lost.
"""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed
from safetensors import safe_open
from safetensors.torch import load_file, save

from lerobot_playbyear.datasets.errors import InputError, PlaybyearError
from lerobot_playbyear.datasets.files import write_atomically
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import Observation
from lerobot_playbyear.episodes.policy_actor import PolicyActor, load_policy_actor
from lerobot_playbyear.film.rollout_film import env_of_lerobot

_N_DISPLACED = 3  # numbers of the action that the learner adds to; the gripper's is the fourth
_FIRST_DEVIATION = 0.05  # of what is added, before anything was learned, as a share of the bound
_LARGEST_BUFFER = 100_000  # steps


@dataclass
class ResidualConfig:
    """Options of `python -m lerobot_playbyear.reproduce.residual`.

    Attributes:
        env: The environment.
        policy: The policy that stays as it is, `--policy.path`.
        steps: Of the environment, to learn in.
        seed: Of the learner; with `residual`, of the first episode.
        bound: The most that is added to a number of the action, whose unit is 5 cm.
        warmup_steps: In which the policy acts almost alone; in as many again the critic alone learns, of these.
        batch_size: Steps in an update, of which there is one for each step.
        learning_rate: Of actor and critic.
        residual: A folder with what was learned: it is evaluated, and nothing is learned.
        n_episodes: Of the evaluation.
        output_dir: Of the run.
    """

    env: EnvConfig
    policy: PreTrainedConfig | None = None
    steps: int = 20_000
    seed: int = 1
    bound: float = 0.2
    warmup_steps: int = 1000
    batch_size: int = 256
    learning_rate: float = 3e-4
    residual: Path | None = None
    n_episodes: int = 100
    output_dir: Path = field(default=Path("outputs/residual"))

    def __post_init__(self) -> None:
        path = parser.get_path_arg("policy")
        if not path:
            raise InputError("The policy that stays as it is: give its folder, --policy.path.")
        self.policy = PreTrainedConfig.from_pretrained(path, cli_overrides=parser.get_cli_overrides("policy") or [])
        self.policy.pretrained_path = Path(path)

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        return ["policy"]


class ResidualEnv(gym.Env):
    """A task in which the policy acts, and a learner adds to it.

    Args:
        env: The task.
        actor: The policy, which stays as it is.
        bound: As in `ResidualConfig`.
    """

    def __init__(self, env: gym.Env, actor: PolicyActor, bound: float) -> None:
        self.env, self._actor, self._bound = env, actor, bound
        seen, _ = self.reset(seed=0)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, seen.shape, np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (_N_DISPLACED,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(10_000, 40_000))  # of what is learned from, not of what is judged on
        observation, info = self.env.reset(seed=seed)
        self._actor.reset(self.env)
        return self._look(observation), info

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(added(self._action, action, self._bound))
        return self._look(observation), float(reward), terminated, truncated, info

    def _look(self, observation: Observation) -> np.ndarray:
        """What the learner sees, (D + state + action,) float32: what the policy remembers, the arm, and the policy's action."""
        self._action = self._actor.act(observation)
        policy: Any = self._actor.policy
        memory = policy.memory[0].to("cpu", torch.float32).numpy()
        return np.concatenate([memory, observation["agent_pos"], self._action]).astype(np.float32)

    def close(self):
        self.env.close()


def added(action: np.ndarray, residual: np.ndarray, bound: float) -> np.ndarray:
    """An action (action dim,) with its displacement changed by at most `bound`, within [-1, 1]."""
    sum_ = action[:_N_DISPLACED] + bound * np.clip(residual, -1, 1)
    return np.concatenate([np.clip(sum_, -1, 1), action[_N_DISPLACED:]]).astype(np.float32)


def make_model(cfg: ResidualConfig, env: ResidualEnv) -> Any:
    """A learner that adds nothing yet.

    Raises:
        InputError: Stable-Baselines3 is not installed.
    """
    try:
        from stable_baselines3 import SAC
        from stable_baselines3.common.logger import Logger
    except ImportError as error:
        raise InputError("Residual RL needs Stable-Baselines3: pip install 'lerobot_policy_playbyear[rl]'.") from error

    class Residual(SAC):
        """Explores by its own small noise from the beginning, and leaves the actor alone while the critic warms up."""

        def _sample_action(self, learning_starts, action_noise=None, n_envs=1):
            return super()._sample_action(0, action_noise, n_envs)

        def _update_learning_rate(self, optimizers):
            super()._update_learning_rate(optimizers)
            if self.num_timesteps < 2 * cfg.warmup_steps:
                for optimizer in optimizers:
                    if optimizer is not self.critic.optimizer:
                        optimizer.param_groups[0]["lr"] = 0.0

    model: Any = Residual(
        "MlpPolicy",
        env,
        learning_rate=cfg.learning_rate,
        buffer_size=min(cfg.steps, _LARGEST_BUFFER),
        learning_starts=cfg.warmup_steps,
        batch_size=cfg.batch_size,
        ent_coef="auto_0.01",
        seed=cfg.seed,
        device="cpu",
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    with torch.no_grad():
        for layer, value in ((model.actor.mu, 0.0), (model.actor.log_std, float(np.log(_FIRST_DEVIATION)))):
            layer.weight.zero_()
            layer.bias.fill_(value)
    return model


def learn(cfg: ResidualConfig) -> Path:
    """Learns, or goes on. Returns the folder of what was learned."""
    set_seed(cfg.seed)
    env = ResidualEnv(env_spec(cfg.env).make(), load_policy_actor(cfg.policy, cfg.env), cfg.bound)
    model, kept = make_model(cfg, env), cfg.output_dir / "resume.safetensors"
    if kept.is_file():
        _restore(model, kept)
    kept.parent.mkdir(parents=True, exist_ok=True)
    while model.num_timesteps < cfg.steps:
        part = min(max(cfg.steps // 10, 1), cfg.steps - model.num_timesteps)
        model.learn(part, reset_num_timesteps=False, log_interval=None)
        write_atomically(kept, _kept(model))
        solved = [episode["r"] for episode in model.ep_info_buffer or []]
        share = f"{np.mean(solved):.0%} of the last {len(solved)} episodes" if solved else "no episode is over"
        print(f"{model.num_timesteps} of {cfg.steps} steps: {share}", flush=True)
    env.close()
    folder = cfg.output_dir / "checkpoints" / "last" / "pretrained_model"
    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: value.contiguous() for name, value in model.actor.state_dict().items()}
    write_atomically(folder / "model.safetensors", save(weights))
    return folder


def evaluate(cfg: ResidualConfig) -> None:
    """Plays episodes from `cfg.seed` on; `--env.attempts_file` keeps how they ended."""
    env = ResidualEnv(env_of_lerobot(cfg.env), load_policy_actor(cfg.policy, cfg.env), cfg.bound)
    model = make_model(cfg, env)
    model.actor.load_state_dict(load_file(Path(str(cfg.residual)) / "model.safetensors"))
    n_solved = 0
    for seed in range(cfg.seed, cfg.seed + cfg.n_episodes):
        seen, done, info = env.reset(seed=seed)[0], False, {}
        while not done:
            seen, _, terminated, truncated, info = env.step(model.predict(seen, deterministic=True)[0])
            done = terminated or truncated
        n_solved += bool(info["is_success"])
    env.close()
    print(f"{n_solved} of {cfg.n_episodes}")


# What a run is made of, in one file of tensors: weights and what was seen. Its optimisers begin again after a kill.

_SEEN = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def _kept(model: Any) -> bytes:
    n = model.replay_buffer.size()
    tensors = {f"policy.{name}": value for name, value in model.policy.state_dict().items()}
    tensors |= {f"seen.{name}": torch.from_numpy(getattr(model.replay_buffer, name)[:n]) for name in _SEEN}
    tensors["log_ent_coef"] = model.log_ent_coef.detach()
    progress = {"steps": model.num_timesteps, "pos": model.replay_buffer.pos}
    copies = {name: value.clone().contiguous() for name, value in tensors.items()}
    return save(copies, {"progress": json.dumps(progress)})


def _restore(model: Any, path: Path) -> None:
    tensors = load_file(path)
    with safe_open(path, framework="pt") as file:
        progress = json.loads(file.metadata()["progress"])
    model.policy.load_state_dict({name[7:]: value for name, value in tensors.items() if name.startswith("policy.")})
    model.log_ent_coef.data.copy_(tensors["log_ent_coef"])
    buffer = model.replay_buffer  # of another size, where --steps is another
    n = min(len(tensors["seen.rewards"]), buffer.buffer_size)
    for name in _SEEN:
        getattr(buffer, name)[:n] = tensors[f"seen.{name}"][:n].numpy()
    buffer.full = n == buffer.buffer_size
    buffer.pos = progress["pos"] % n if buffer.full else n
    model.num_timesteps = progress["steps"]


@parser.wrap()
def work(cfg: ResidualConfig) -> None:
    if cfg.residual is None:
        print(f"Residual: {learn(cfg)}")
    else:
        evaluate(cfg)


if __name__ == "__main__":
    register_third_party_plugins()
    try:
        work()  # type: ignore[call-arg]  # its options are the command line's
    except PlaybyearError as error:
        sys.exit(f"error: {error}")
