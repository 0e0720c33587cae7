"""What the policy remembers at every frame of demonstrations and attempts, for a gate that learns from it."""

from collections.abc import Container
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION, SUCCESS
from torch import Tensor

from lerobot_playbyear.dagger.batches import frames_by_expert
from lerobot_playbyear.dagger.config import DatasetSource
from lerobot_playbyear.dagger.corrections import Corrections
from lerobot_playbyear.dagger.methods.base import Tools
from lerobot_playbyear.dagger.methods.gate_model import Played
from lerobot_playbyear.datasets import EpisodeStore
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.episode import Episode
from lerobot_playbyear.episodes.frames import SEED, dataset_features

ATTEMPTS = "attempts"
"""Folder in the output folder with the attempts that are not corrections: those that failed, and those that needed no help."""

_RUNS = 16  # that are looked at together


def check_memory(tools: Tools) -> None:
    """Refuse a policy that has no memory to look into.

    Raises:
        InputError: It is one.
    """
    policy: Any = tools.parts.accelerator.unwrap_model(tools.parts.policy)
    if not hasattr(policy, "memory_run"):
        raise InputError(
            f"--method.type=robot_gated looks into the memory of the policy, and '{policy.config.type}' shows none: take a "
            "policy of --policy.type=playbyear, or another method."
        )


class Remembering:
    """Keeps attempts that are no corrections, and encodes everything by the policy as it is now.

    Args:
        tools: What the run has.
    """

    def __init__(self, tools: Tools) -> None:
        assert tools.facts is not None
        assert tools.cfg.env is not None
        self._tools = tools
        self._policy: Any = tools.parts.accelerator.unwrap_model(tools.parts.policy)
        source = DatasetSource(f"{tools.cfg.interventions.repo_id}_{ATTEMPTS}", str(tools.folder.path / ATTEMPTS))
        self._others = Corrections(source)
        self._others.open_for_writing(tools.facts.fps, dataset_features(tools.facts), tools.cfg.env.type)
        self._others.read(tools.windows.keys, tools.demonstrations.device, tools.demonstrations.image_size)

    def close(self) -> None:
        """Nothing is kept any more."""
        self._others.close()

    def keep(self, episode: Episode) -> None:
        """Writes an attempt to disk, unless it is there from before the run was killed."""
        store = self._others.store
        if store is None or episode.seed not in _seeds(store):
            self._others.append(episode)

    def demonstrations(self) -> list[Played]:
        """The demonstrations."""
        store = self._tools.demonstrations
        return [self._encoded(store, number, None) for number in range(store.n_episodes)]

    def attempts(self, seeds: range, shown: Container[int] = ()) -> list[Played]:
        """The attempts with these seeds, in their order, which is that of time.

        Args:
            seeds: Which.
            shown: Of corrections that are demonstrations of a scene. They come first, as demonstrations: they show no state
                that the policy brings the robot to.
        """
        attempts = []
        for store in (self._tools.corrections.store, self._others.store):
            for number, seed in enumerate(_seeds(store) if store is not None else ()):
                if store is not None and seed in seeds:
                    is_shown = store is self._tools.corrections.store and seed in shown
                    attempts.append(self._encoded(store, number, None if is_shown else seed))
        return sorted(attempts, key=lambda each: each.seed)

    def now(self) -> Tensor:
        """(1, D) what the policy remembers of the attempt that goes on."""
        return self._policy.memory.cpu()

    @torch.no_grad()
    def _encoded(self, store: EpisodeStore, number: int, seed: int | None) -> Played:
        """An episode of a store: an attempt with its seed, or a demonstration."""
        start, end = store.starts[number], store.ends[number]
        self._policy.eval()
        self._policy.reset()  # prepared as for acting, whatever was encoded before
        memories = self._memories(store, start, end)
        everywhere = np.ones(end - start, bool)
        return Played(
            memories=memories.cpu(),
            actions=store.column(ACTION)[start:end].cpu(),
            policy_actions=self._tools.parts.postprocessor(self._policy.act_from(memories)).cpu(),
            by_expert=everywhere if seed is None else frames_by_expert(store)[start:end].cpu().numpy(),
            success=seed is None or SUCCESS not in store.keys or bool(store.column(SUCCESS)[end - 1].any()),
            is_visited=seed is not None,
            seed=-1 if seed is None else seed,
        )

    def _memories(self, store: EpisodeStore, start: int, end: int) -> Tensor:
        """(T, D) of an episode's frames."""
        windows, parts = self._tools.windows, self._tools.parts
        n = windows.n_windows
        lasts = torch.arange(end - 1, start - 1, -n)
        runs = []
        for last in lasts.split(_RUNS):
            batch = parts.preprocessor(windows.batch(store, last))
            runs.append(self._policy.memory_run(batch, n))
        memories = torch.cat(runs).flip(0).flatten(0, 1)  # (runs * K, D): what lies before the episode comes first
        return memories[-(end - start) :]


def _seeds(store: EpisodeStore) -> list[int]:
    """Of every episode."""
    return [int(store.column(SEED)[end - 1]) for end in store.ends]
