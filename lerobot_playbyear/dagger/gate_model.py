"""What a robot-gated method knows of a state: how new it is to the policy, and how risky (ThriftyDAgger).

Both are small networks on what the policy's LSTM remembers: by default the policy `playbyear` has neither dropout nor an
ensemble, five policies would cost five times the training, and passes through other augmentations tell of noise in a
picture, not of places where no expert was. So several heads learn the expert's actions from the same memory, each from its
own draw of the data; where they disagree nobody has shown what to do. They are learned again in every round, because the
memory changes with the policy.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_playbyear.policy.networks import mlp

_N_HEADS = 5  # whose disagreement is novelty; ThriftyDAgger: five policies
_DISCOUNT = 0.9999  # of a success, per step (ThriftyDAgger)
_N_UPDATES = 400  # of each head and of each success value
_HIDDEN, _BATCH = 128, 256


@dataclass
class Played:
    """An episode as a gate learns from it, T steps.

    Attributes:
        memories: (T, D) what the policy remembers.
        actions: (T, action dim) what was done.
        policy_actions: (T, action dim) what the policy would do.
        by_expert: (T,) bool.
        success: Whether the task was solved in the end.
        is_visited: Whether the policy was at work, so that thresholds are set by it; demonstrations are not.
        seed: Of the attempt.
    """

    memories: Tensor
    actions: Tensor
    policy_actions: Tensor
    by_expert: np.ndarray
    success: bool
    is_visited: bool
    seed: int = 0


class GateModel:
    """Novelty and risk.

    Risk is what two success values say on average, each of which has seen every other attempt: of an attempt that was learned
    from, the one tells that has not seen it. Thresholds would be those of a success that is known by heart otherwise.

    Args:
        played: Demonstrations and attempts; at least one frame of an expert.
        seed: Of all that is random.
    """

    def __init__(self, played: list[Played], seed: int) -> None:
        memories = torch.cat([each.memories for each in played]).float()
        self._mean, self._std = memories.mean(0), memories.std(0).clamp(min=1e-6)
        with torch.random.fork_rng(devices=[]), torch.enable_grad():
            torch.manual_seed(seed)
            self._heads = self._learn_heads(played)
            self._values = self._learn_values(played)

    @torch.no_grad()
    def novelty(self, memories: Tensor) -> Tensor:
        """(N, D) -> (N,), the variance of the heads' actions, averaged over their numbers."""
        actions = torch.stack([head(self._scaled(memories)) for head in self._heads])  # (heads, N, action dim)
        return actions.var(dim=0, unbiased=False).mean(dim=-1)

    @torch.no_grad()
    def risk(self, memories: Tensor, actions: Tensor, seed: int | None = None) -> Tensor:
        """(N, D), (N, action dim) -> (N,) in [0, 1], one less the discounted success.

        Args:
            memories, actions: What the policy remembers, and what it would do.
            seed: Of the attempt that they are of, if there may be something learned from it.
        """
        seen = torch.cat([self._scaled(memories), actions.float()], dim=-1)
        values = self._values if seed not in self._half else [self._values[self._half[seed]]]
        return 1 - torch.stack([value(seen).sigmoid().squeeze(-1) for value in values]).mean(dim=0)

    def trace(self, played: Played) -> "Trace":
        """What the robot thinks of every step; risk is that of the policy's action, also where the expert acted."""
        risk = self.risk(played.memories, played.policy_actions, played.seed)
        was_expert_before = np.concatenate([[False], played.by_expert[:-1]])
        return Trace(self.novelty(played.memories).numpy(), risk.numpy(), ~was_expert_before)

    def _scaled(self, memories: Tensor) -> Tensor:
        return (memories.float() - self._mean) / self._std

    def _learn_heads(self, played: list[Played]) -> list[nn.Sequential]:
        masks = [torch.from_numpy(each.by_expert) for each in played]
        memories = self._scaled(torch.cat([p.memories[mask] for p, mask in zip(played, masks, strict=True)]))
        actions = torch.cat([p.actions[mask] for p, mask in zip(played, masks, strict=True)]).float()
        heads = []
        for _ in range(_N_HEADS):
            head = mlp(memories.shape[1], _HIDDEN, actions.shape[1])
            own = torch.randint(len(memories), (len(memories),))  # with replacement, as ThriftyDAgger's policies draw
            _fit(head, memories[own], actions[own], nn.functional.mse_loss)
            heads.append(head)
        return heads

    def _learn_values(self, played: list[Played]) -> list[nn.Sequential]:
        kinds = [[each.seed for each in played if each.is_visited and each.success is kind] for kind in (True, False)]
        self._half = {seed: number % 2 for seeds in kinds for number, seed in enumerate(seeds)}  # both see both kinds
        values = []
        for half in range(2):
            seen, outcomes = [], []
            for each in played:
                if each.is_visited and self._half[each.seed] == half:
                    continue
                # Before the last takeover the expert made the outcome what it was.
                begins = np.flatnonzero(each.by_expert[1:] & ~each.by_expert[:-1]) + 1
                own = slice(int(begins[-1]) if len(begins) else 0, None)
                seen.append(torch.cat([self._scaled(each.memories), each.actions.float()], dim=-1)[own])
                ahead = torch.arange(len(each.memories) - 1, -1, -1)[own]
                outcomes.append(each.success * _DISCOUNT ** ahead.float())
            inputs, targets = torch.cat(seen), torch.cat(outcomes).unsqueeze(-1)
            values.append(mlp(inputs.shape[1], _HIDDEN, 1))
            _fit(values[-1], inputs, targets, nn.functional.binary_cross_entropy_with_logits)
        return values


@dataclass(frozen=True)
class Trace:
    """What a robot thought of an attempt of T steps.

    Attributes:
        novelty, risk: (T,)
        is_own: (T,) bool. The policy, and not the expert, acted in the step before; true of the first step.
    """

    novelty: np.ndarray
    risk: np.ndarray
    is_own: np.ndarray


@dataclass(frozen=True)
class Thresholds:
    """The robot asks beyond either of them, and from then on to the end of the attempt."""

    novelty: float
    risk: float

    def are_exceeded(self, novelty: Any, risk: Any) -> Any:
        """Whether the robot asks, of numbers or of arrays of them."""
        return (novelty > self.novelty) | (risk > self.risk)


def thresholds_for(traces: list[Trace], share: float) -> Thresholds:
    """The thresholds with which a robot would have asked in a wanted share of the steps of which that can be told.

    It asks above the same quantile of novelty and of risk. Of all such quantiles from the median on, that one is taken which
    comes nearest. Where the expert had brought the robot, nobody knows how a robot would stand that had not asked before: such
    steps are left out, unless it would still be asking then. So each quantile has its own steps, and the share is met about.

    Args:
        traces: Of every attempt.
        share: Share of the steps in which the expert acts.
    """
    novelty = np.concatenate([each.novelty[each.is_own] for each in traces])
    risk = np.concatenate([each.risk[each.is_own] for each in traces])
    best, nearest = Thresholds(float(novelty.max()), float(risk.max())), share
    for quantile in 1 - 0.5 * np.linspace(1, 0, 101)[:-1] ** 2:  # finer where few steps are asked in
        limits = Thresholds(float(np.quantile(novelty, quantile)), float(np.quantile(risk, quantile)))
        asked = np.concatenate([_asked(each, limits) for each in traces])
        if abs(asked.mean() - share) < nearest:
            best, nearest = limits, float(abs(asked.mean() - share))
    return best


def _asked(trace: Trace, limits: Thresholds) -> np.ndarray:
    """Whether a robot would have asked, in the steps of which that can be told."""
    asks = np.logical_or.accumulate(limits.are_exceeded(trace.novelty, trace.risk) & trace.is_own)
    return asks[trace.is_own | asks]


def _fit(network: nn.Module, inputs: Tensor, targets: Tensor, loss_of: Callable[..., Tensor]) -> None:
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for _ in range(_N_UPDATES):
        batch = torch.randint(len(inputs), (_BATCH,))
        optimizer.zero_grad()
        loss_of(network(inputs[batch]), targets[batch]).backward()
        optimizer.step()
