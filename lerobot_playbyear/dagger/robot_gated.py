"""Robot-gated queries: the robot asks for help where it is new or risky to it (ThriftyDAgger, Hoque et al., 2021)."""

from collections.abc import Container
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import torch
from lerobot.utils.constants import ACTION, SUCCESS
from torch import Tensor

from lerobot_playbyear.dagger.batches import frames_by_expert
from lerobot_playbyear.dagger.corrections import Corrections
from lerobot_playbyear.dagger.gate_model import GateModel, Played, Thresholds, thresholds_for
from lerobot_playbyear.dagger.methods import Method, Showing
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.experts import Expert
from lerobot_playbyear.episodes.frames import SEED
from lerobot_playbyear.episodes.play import Episode, Observation
from lerobot_playbyear.training.store import EpisodeStore

if TYPE_CHECKING:
    from lerobot_playbyear.dagger.loop import Loop

ATTEMPTS = "attempts"
"""Folder in the output folder with the attempts that are not corrections: those that failed, and those that needed no help."""

_N_LATEST = 20  # attempts from which thresholds are set
_RUNS = 16  # that are encoded together


@Method.register_subclass("robot_gated")
@dataclass
class RobotGated(Method):
    """The robot asks for help. A script then finishes the episode; a person is called, takes over and hands back at any time.

    In `state.method` it keeps how the round began, and the seeds of the scenes that were shown.

    Attributes:
        intervention_share: Share of the control steps in which the robot asks for help. The thresholds are fitted to it in
            every round.
        rollouts: First rollouts without an expert. The robot learns from them to recognise failure.
        redo_failed: If a rollout fails, set up its scene again and let a script demonstrate it, as with `--method.type=redo`. A
            person is not asked to.
    """

    is_watched: ClassVar[bool] = False

    intervention_share: float = 0.2
    rollouts: int = 10
    redo_failed: bool = True

    def check(self) -> None:
        if not 0 < self.intervention_share < 1:
            raise InputError(f"--method.intervention_share={self.intervention_share}: give a share above 0, below 1.")
        if self.rollouts < 1:
            raise InputError(f"--method.rollouts={self.rollouts}: give at least 1.")

    def __post_init__(self) -> None:
        self._others: Corrections | None = None
        self._fitted_round = -1

    def wrap(self, expert: Expert) -> Expert:
        self.shows_failures = self.redo_failed and not expert.decides  # type: ignore[misc]
        self._expert = Asked(expert, self)
        return self._expert

    def begin(self, loop: "Loop") -> None:
        self._loop, self._state = loop, loop.state
        self._policy: Any = loop.learner.unwrapped
        self._shown: list[int] = loop.state.method.setdefault("shown_seeds", [])
        own = loop.cfg.interventions
        source = replace(own, repo_id=f"{own.repo_id}_{ATTEMPTS}", root=str(loop.folder.path / ATTEMPTS))
        self._others = loop.corrections.another(source)

    def close(self) -> None:
        if self._others is not None:
            self._others.close()

    @property
    def is_alone(self) -> bool:
        state = self._state
        return state.to_show is None and state.attempts - state.discarded - len(self._shown) < self.rollouts

    def prepare(self, demonstrates: bool) -> None:
        """Learns what is new and what is risky to the policy of this round, from what there was when the round began.

        Thresholds are set before every attempt, with what was met in those of this round too.
        """
        self._expert.demonstrates = demonstrates
        self._thresholds: Thresholds | None = None
        if self.is_alone or demonstrates:
            return
        state = self._state
        if state.method.get("round") != state.round:
            state.method |= {"round": state.round, "next_seed": state.next_seed}
            self._loop.folder.commit(state)
        begun = state.method["next_seed"]
        if self._fitted_round != state.round:
            self._fit(begun)
        for each in self._attempts(range(max([begun - 1, *self._traces]) + 1, state.next_seed)):
            if each.is_visited:
                self._traces[each.seed] = self._model.trace(each)
        latest = [self._traces[seed] for seed in sorted(self._traces)[-_N_LATEST:]]
        self._thresholds = thresholds_for(latest, self.intervention_share)

    def _fit(self, before_seed: int) -> None:
        """Learns from all attempts with smaller seeds."""
        demonstrations, attempts = self._loop.demonstrations, self._attempts(range(before_seed))
        seed = int(np.random.SeedSequence([self._loop.cfg.seed, 2, self._state.round]).generate_state(1)[0])
        played = [self._encoded(demonstrations, number) for number in range(demonstrations.n_episodes)] + attempts
        self._model = GateModel(played, seed)
        visited = [each for each in attempts if each.is_visited]
        self._traces = {each.seed: self._model.trace(each) for each in visited[-_N_LATEST:]}
        self._fitted_round = self._state.round

    def asks(self, policy_action: np.ndarray) -> bool:
        """Whether the robot begins to ask in the present step, whose action the policy has just chosen."""
        if self._thresholds is None:
            return False
        memory, action = self._policy.memory.cpu(), torch.from_numpy(np.asarray(policy_action, np.float32))[None]
        novelty, risk = self._model.novelty(memory), self._model.risk(memory, action)  # (1,) each
        return bool(self._thresholds.are_exceeded(float(novelty), float(risk)))

    def note(self, episode: Episode, outcome: str) -> None:
        if self._expert.demonstrates:
            self._shown.extend([episode.seed] if outcome != "discarded" else [])
        elif outcome in ("failed", "unneeded"):
            assert self._others is not None
            if episode.seed not in _seeds(self._others.store):  # not saved before the run was killed
                self._others.append(episode)

    def note_recovered(self) -> None:
        if self._state.to_show is not None:
            self._shown.append(self._state.to_show)

    # What the policy remembers at every frame

    def _attempts(self, seeds: Container[int]) -> list[Played]:
        """The attempts with these seeds, in their order, which is that of time.

        Those in which a scene was shown come first, as demonstrations: they show no state that the policy brings the robot to.
        """
        assert self._others is not None
        attempts = []
        for store, shown in ((self._loop.corrections.store, self._shown), (self._others.store, [])):
            for number, seed in enumerate(_seeds(store)):
                if store is not None and seed in seeds:
                    attempts.append(self._encoded(store, number, None if seed in shown else seed))
        return sorted(attempts, key=lambda each: each.seed)

    @torch.no_grad()
    def _encoded(self, store: EpisodeStore, number: int, seed: int | None = None) -> Played:
        """An episode of a store: an attempt with its seed, or a demonstration."""
        start, end = store.starts[number], store.ends[number]
        self._policy.eval()
        self._policy.reset()  # prepared as for acting, whatever was encoded before
        memories = self._memories(store, start, end)
        everywhere = np.ones(end - start, bool)
        return Played(
            memories=memories.cpu(),
            actions=store.column(ACTION)[start:end].cpu(),
            policy_actions=self._loop.learner.postprocessor(self._policy.act_from(memories)).cpu(),
            by_expert=everywhere if seed is None else frames_by_expert(store)[start:end].numpy(),
            success=seed is None or SUCCESS not in store.keys or bool(store.column(SUCCESS)[end - 1].any()),
            is_visited=seed is not None,
            seed=-1 if seed is None else seed,
        )

    def _memories(self, store: EpisodeStore, start: int, end: int) -> Tensor:
        """(T, D) of an episode's frames."""
        windows, preprocessor = self._loop.windows, self._loop.learner.preprocessor
        n = windows.n_windows
        parts = torch.arange(end - 1, start - 1, -n).split(_RUNS)
        runs = [self._policy.memory_run(preprocessor(windows.batch(store, last)), n) for last in parts]
        memories = torch.cat(runs).flip(0).flatten(0, 1)  # (runs * K, D): what lies before the episode comes first
        return memories[-(end - start) :]


class Asked(Showing):
    """An expert that acts when the robot asks or, if it is one that decides, that is called then.

    Args:
        expert: The expert.
        method: Knows when the robot asks.
    """

    def __init__(self, expert: Expert, method: RobotGated) -> None:
        super().__init__(expert)
        self._method = method

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        self._asks = self._acts = False

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        if self.demonstrates:
            return super().wants_control(observation, policy_action)
        begins = not self._asks and self._method.asks(policy_action)
        self._asks |= begins
        if self.decides:
            self.expert.call(self._asks)
        wants = self.expert.wants_control(observation, policy_action)  # a script looks
        if not self.decides:
            if begins:
                self.expert.take_over()
            return self._asks
        if self._acts and not wants:  # a person who has helped hands back
            self._asks = False
            self.expert.call(False)
        self._acts = wants
        return wants


def _seeds(store: EpisodeStore | None) -> list[int]:
    """Of every episode."""
    return [] if store is None else [int(store.column(SEED)[end - 1]) for end in store.ends]
