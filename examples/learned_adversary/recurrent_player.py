"""The learned adversary's parts: a recurrent player whose critic sees the truth, imitation to begin with, checkpoints."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numeric_task import N_PLAYER, NumericTask
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from gym_playbyear.check.report import EXPERT, deaf_scripts
from gym_playbyear.panda import ACTION_SCALE

_BATCH = 16  # demonstrations


class _PlayerOnly(BaseFeaturesExtractor):
    """Zeros in place of the truth: what a player sees."""

    def __init__(self, observation_space):
        super().__init__(observation_space, observation_space.shape[0])
        seen = torch.zeros(observation_space.shape[0])
        seen[:N_PLAYER] = 1.0
        self.register_buffer("seen", seen)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return observations * self.seen


class RecurrentPlayer(RecurrentActorCriticPolicy):
    """An LSTM that sees the player's numbers, and a critic without memory that sees the truth.

    Args:
        deviation: Of the actions that it explores with, to begin with. With 0.135 (3 mm in each step) who hears the cube and
            solves 16 of 40 episodes without chance solves 5, and learns that it is best not to try; with 0.04 it is 21.
    """

    def __init__(self, *args: Any, deviation: float = 0.04, **kwargs: Any):
        super().__init__(
            *args,
            share_features_extractor=False,
            shared_lstm=False,
            enable_critic_lstm=False,
            lstm_hidden_size=64,
            net_arch={"pi": [64], "vf": [128, 128]},
            log_std_init=math.log(deviation),
            **kwargs,
        )
        self.pi_features_extractor = self.features_extractor = _PlayerOnly(self.observation_space)

    @staticmethod
    def _process_sequence(features, lstm_states, episode_starts, lstm):
        """As the original, in one call: a sequence of the rollout buffer begins with its episode or later, and ends with it."""
        n_sequences = lstm_states[0].shape[1]
        sequence = features.reshape((n_sequences, -1, lstm.input_size)).swapaxes(0, 1)  # (T, sequences, features)
        goes_on = 1.0 - episode_starts.reshape((n_sequences, -1))[:, 0].view(1, n_sequences, 1)
        output, states = lstm(sequence, (goes_on * lstm_states[0], goes_on * lstm_states[1]))
        return torch.flatten(output.transpose(0, 1), start_dim=0, end_dim=1), states

    def own_parameters(self) -> Iterator[nn.Parameter]:
        """What acts; the rest is the critic's."""
        for name, parameter in self.named_parameters():
            if name == "log_std" or name.startswith(("lstm_actor", "mlp_extractor.policy_net", "action_net")):
                yield parameter


# Imitation


def demonstrations(env: NumericTask, teacher: str, seeds: range) -> list[tuple[np.ndarray, np.ndarray]]:
    """Success episodes of a teacher, in the learner's terms.

    Args:
        env: The task in numbers.
        teacher: `expert`, which knows the truth, or one of the task's deaf scripts.
        seeds: Of the episodes.

    Returns:
        Observations (T, features) and actions (T, 4) of each.

    Raises:
        ValueError: There is no such teacher.
    """
    solved, scripts = [], deaf_scripts(env.task)
    if teacher not in (EXPERT, *scripts):
        raise ValueError(f"teacher={teacher!r} does not know this task: choose from {', '.join((EXPERT, *scripts))}.")
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        expert = env.task.env.scripted_expert() if teacher == EXPERT else None
        script = None if expert else scripts[teacher](env.task.facts, np.random.default_rng(seed))
        observations, actions, done, info = [], [], False, {"is_success": False}
        while not done:
            observations.append(observation)
            taken = []
            env.begin_action()
            for _ in range(env.repeat):
                taken.append(expert.act() if expert else script.act(env.view))
                done, info = env.advance(taken[-1])
                if done:
                    break
            move = np.mean([action[:3] for action in taken], axis=0) * ACTION_SCALE / env.step_size
            actions.append(np.append(np.clip(move, -1, 1), 1.0 if taken[0][3] > 0 else -1.0))
            observation = env.end_action(actions[-1])
        if info["is_success"]:
            solved.append((np.stack(observations), np.stack(actions).astype(np.float32)))
    return solved


def imitate(
    policy: RecurrentPlayer, solved: list[tuple[np.ndarray, np.ndarray]], n_updates: int, seed: int
) -> list[float]:
    """Trains the player to act as its teacher did. Returns the loss of each update."""
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.Adam(list(policy.own_parameters()), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, n_updates)
    losses = []
    for _ in range(n_updates):
        chosen = [solved[i] for i in rng.choice(len(solved), min(_BATCH, len(solved)), replace=False)]
        length = max(len(actions) for _, actions in chosen)
        observed = torch.zeros(len(chosen), length, chosen[0][0].shape[1])
        wanted, real = torch.zeros(len(chosen), length, 4), torch.zeros(len(chosen), length, 1)
        for row, (observations, actions) in enumerate(chosen):
            observed[row, : len(actions)] = torch.from_numpy(observations)
            wanted[row, : len(actions)] = torch.from_numpy(actions)
            real[row, : len(actions)] = 1.0
        meant = mean_actions(policy, observed)
        loss = (((meant - wanted) ** 2) * real).sum() / real.sum()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(list(policy.own_parameters()), 1.0)
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
    return losses


def mean_actions(policy: RecurrentPlayer, observed: torch.Tensor) -> torch.Tensor:
    """The player's actions without chance (episodes, T, 4) for whole episodes (episodes, T, features)."""
    n, length, _ = observed.shape
    zeros = torch.zeros(1, n, policy.lstm_actor.hidden_size)
    starts = torch.zeros(n, length)
    starts[:, 0] = 1.0
    distribution, _ = policy.get_distribution(observed.flatten(0, 1), (zeros, zeros), starts.flatten())
    return distribution.distribution.mean.reshape(n, length, 4)


# Checkpoints: tensors in safetensors, the rest in JSON


def save_checkpoint(model: RecurrentPPO, folder: Path, progress: dict[str, Any]) -> None:
    """Writes policy, optimiser and progress; a checkpoint that is there stays whole until the new one is."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {f"policy.{name}": tensor.contiguous() for name, tensor in model.policy.state_dict().items()}
    for index, state in model.policy.optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
    text = {"progress": json.dumps(progress)}
    save_file({name: tensor.clone() for name, tensor in tensors.items()}, folder / "checkpoint.new", metadata=text)
    (folder / "checkpoint.new").replace(folder / "checkpoint.safetensors")


def load_checkpoint(model: RecurrentPPO, folder: Path) -> dict[str, Any] | None:
    """Continues from a checkpoint. Returns its progress, or None where there is none."""
    path = folder / "checkpoint.safetensors"
    if not path.exists():
        return None
    tensors = load_file(path)
    model.policy.load_state_dict({name[7:]: tensor for name, tensor in tensors.items() if name.startswith("policy.")})
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".")
            state.setdefault(int(index), {})[key] = tensor
    groups = model.policy.optimizer.state_dict()["param_groups"]
    model.policy.optimizer.load_state_dict({"state": state, "param_groups": groups})
    return progress_of(path)


def progress_of(path: Path) -> dict[str, Any]:
    """What a checkpoint says of how far it is."""
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["progress"])


def play_episode(policy: RecurrentPlayer, env: NumericTask, seed: int) -> bool:
    """Whether the player, without chance, solves the episode."""
    observation, _ = env.reset(seed=seed)
    zeros = torch.zeros(1, 1, policy.lstm_actor.hidden_size)
    states, start, done, info = (zeros, zeros), torch.ones(1), False, {"is_success": False}
    while not done:
        with torch.no_grad():
            distribution, states = policy.get_distribution(torch.from_numpy(observation)[None], states, start)
        action = distribution.distribution.mean[0].numpy()
        observation, _, done, _, info = env.step(np.clip(action, -1, 1))
        start = torch.zeros(1)
    return bool(info["is_success"])
