"""Robot-gated queries: the robot asks for help where it is new or risky to it (ThriftyDAgger, Hoque et al., 2021)."""

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import torch

from lerobot_playbyear.dagger.methods.base import Method, MethodConfig, Tools
from lerobot_playbyear.dagger.methods.beside import Demonstrating
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.episode import Episode, Observation
from lerobot_playbyear.episodes.expert import Expert, ExpertError
from lerobot_playbyear.episodes.play import Seconds

if TYPE_CHECKING:
    from lerobot_playbyear.dagger.attempt import Scene
    from lerobot_playbyear.dagger.config import DaggerConfig
    from lerobot_playbyear.dagger.methods.gate_model import Asking, Played
    from lerobot_playbyear.dagger.methods.remembering import Remembering

FAILED, SHOWN = "failed_seed", "shown_seeds"
"""In the state of a run: the attempt that the expert makes good next, and those of which it has shown the scene."""
_OF_A_DEMONSTRATION = {"n_asked_steps": 0, "n_calls": 0, "n_switches": 1}


@MethodConfig.register_subclass("robot_gated")
@dataclass
class RobotGatedConfig(MethodConfig):
    """The robot asks. A script then acts until the robot is calm again, or to the end; a person is called, and may take over.

    Attributes:
        intervention_share: Of the steps in which it shall ask; the thresholds follow from it, anew in every round.
        rollouts: First attempts, in which the policy is alone: from them it learns what failing looks like.
        calm_share: It asks until novelty and risk both lie among this share of the smallest; larger means earlier hand-backs.
        least_s: For how long it asks at least [s].
        hands_back: Whether the expert hands back once the robot is calm; otherwise it acts to the end, as in RaC. None: only
            an expert that decides for itself, as a person, hands back.
        n_heads: Whose disagreement is novelty; ThriftyDAgger: 5 policies.
        gate_updates: Of each head and of each success value, in every round.
        discount: Of a success, per step; ThriftyDAgger: 0.9999.
        memory: Last attempts from which thresholds are set.
        redo_failed: Where an attempt fails all the same, the scene is set up again, and the expert demonstrates the task in it
            from the first step on, as with `--method.type=redo`. None: where the expert acts to the end.
    """

    expert_decides: ClassVar[bool] = False
    is_watched: ClassVar[bool] = False

    intervention_share: float = 0.2
    rollouts: int = 10
    calm_share: float = 0.5
    least_s: float = 0.5
    hands_back: bool | None = None
    n_heads: int = 5
    gate_updates: int = 400
    discount: float = 0.9999
    memory: int = 20
    redo_failed: bool | None = None

    def check(self) -> None:
        if not 0 < self.intervention_share < 1:
            raise InputError(
                f"--method.intervention_share={self.intervention_share}: give a share above 0 and below 1."
            )
        if not 0 < self.calm_share < 1:
            raise InputError(f"--method.calm_share={self.calm_share}: give a share above 0 and below 1.")
        for name, least in (("rollouts", 1), ("n_heads", 2), ("gate_updates", 1), ("memory", 1), ("least_s", 0)):
            if not getattr(self, name) >= least:
                raise InputError(f"--method.{name}={getattr(self, name)}: give at least {least}.")
        if not 0 < self.discount <= 1:
            raise InputError(f"--method.discount={self.discount}: give a number above 0 and at most 1.")

    def make(self, cfg: "DaggerConfig") -> Method:
        return RobotGated(cfg, self)


class RobotGated(Method):
    """See `RobotGatedConfig`."""

    def __init__(self, cfg: "DaggerConfig", config: RobotGatedConfig) -> None:
        super().__init__(cfg)
        self._config = config
        self._expert: Asked | None = None
        self._redoes = False
        self._fitted_round = -1
        self._seconds = 0.0  # that the gate took to learn
        self._remembered: Remembering | None = None

    def beside(self, expert: Expert) -> Expert:
        if expert.decides and self._config.hands_back is False:
            raise ExpertError(
                "--method.hands_back=false is for experts that the robot can call and keep, and this one hands back as it "
                "likes: leave the option out, and act to the end once you have taken over, or give --expert.type=scripted."
            )
        if expert.decides and self._config.redo_failed:
            raise ExpertError(
                "--method.redo_failed=true is for experts that can be told to act from the first step on, and this one acts as "
                "it likes: leave the option out, give --expert.type=scripted, or demonstrate failures with --method.type=redo."
            )
        self._expert = Asked(expert, self)
        return self._expert

    def begin(self, tools: Tools) -> None:
        if self._expert is None or tools.facts is None:
            return  # nobody acts
        from lerobot_playbyear.dagger.methods.gate_model import FOR_GOOD
        from lerobot_playbyear.dagger.methods.remembering import check_memory

        check_memory(tools)
        self._tools = tools
        hands_back = self._expert.decides if self._config.hands_back is None else self._config.hands_back
        self._n_least = round(self._config.least_s * tools.facts.fps) if hands_back else FOR_GOOD
        self._redoes = not hands_back if self._config.redo_failed is None else self._config.redo_failed

    @property
    def _remembering(self) -> "Remembering":
        from lerobot_playbyear.dagger.methods.remembering import Remembering

        self._remembered = self._remembered or Remembering(self._tools)
        return self._remembered

    def close(self) -> None:
        if self._remembered is not None:
            self._remembered.close()

    def attempt(self, scene: "Scene", seed: int, random_seed: int, seconds: Seconds) -> Episode:
        assert self._expert is not None
        failed = self._tools.state.method.get(FAILED)
        self._expert.demonstrates = failed is not None
        return scene.attempt(seed if failed is None else failed, random_seed, seconds)

    def prepare(self) -> None:
        """Learns what is new and what is risky to the policy of this round, from what there was when the round began.

        Thresholds are set anew before every attempt, with what was met in those of this round too.
        """
        state = self._tools.state
        if self.is_alone or self.owes:
            return
        from lerobot_playbyear.dagger.methods.gate_model import thresholds_for

        if state.method.get("round") != state.round:
            state.method |= {"round": state.round, "next_seed": state.next_seed}
            self._tools.folder.commit(state)
        start = time.perf_counter()
        begun = state.method["next_seed"]
        if self._fitted_round != state.round:
            self._fit(begun)
        for each in self._attempts(range(max([begun - 1, *self._traces]) + 1, state.next_seed)):
            if each.is_visited:
                self._traces[each.seed] = self._model.trace(each)
        latest = [self._traces[seed] for seed in sorted(self._traces)[-self._config.memory :]]
        share, calm_share = self._config.intervention_share, self._config.calm_share
        self._thresholds = thresholds_for(latest, share, self._n_least, calm_share)
        self._seconds = time.perf_counter() - start
        logging.getLogger(__name__).debug("Round %d: the robot asks beyond %s", state.round, self._thresholds)

    def _fit(self, before_seed: int) -> None:
        """Learns from all attempts with smaller seeds."""
        from lerobot_playbyear.dagger.methods.gate_model import GateModel

        config, state = self._config, self._tools.state
        attempts = self._attempts(range(before_seed))
        seed = int(np.random.SeedSequence([self.cfg.seed, 2, state.round]).generate_state(1)[0])
        played = self._remembering.demonstrations() + attempts
        self._model = GateModel(played, config.n_heads, config.gate_updates, config.discount, seed)
        visited = [each for each in attempts if each.is_visited]
        self._traces = {each.seed: self._model.trace(each) for each in visited[-config.memory :]}
        self._fitted_round = state.round

    def _attempts(self, seeds: range) -> "list[Played]":
        return self._remembering.attempts(seeds, self._tools.state.method.get(SHOWN, ()))

    @property
    def is_alone(self) -> bool:
        state = self._tools.state
        n_shown = len(state.method.get(SHOWN, ()))
        return not self.owes and state.attempts - state.discarded - n_shown < self._config.rollouts

    @property
    def owes(self) -> bool:
        return FAILED in self._tools.state.method

    def asking(self) -> "Asking | None":
        """A fresh gate for an attempt; None while the policy is alone."""
        if self.is_alone:
            return None
        from lerobot_playbyear.dagger.methods.gate_model import Asking

        return Asking(self._thresholds, self._n_least)

    def state_of_mind(self, policy_action: np.ndarray) -> tuple[float, float]:
        """Novelty and risk of the present step, whose action the policy has just chosen."""
        memory, action = self._remembering.now(), torch.from_numpy(np.asarray(policy_action, np.float32))[None]
        return float(self._model.novelty(memory)[0]), float(self._model.risk(memory, action)[0])

    def note(self, episode: Episode, outcome: str) -> None:
        assert self._expert is not None
        if self._expert.demonstrates:
            self._note_shown(counts=outcome != "discarded")
            return
        if outcome in ("failed", "unneeded"):
            self._remembering.keep(episode)
        if outcome == "failed" and self._redoes:
            self._tools.state.method[FAILED] = episode.seed

    def _note_shown(self, counts: bool = True) -> None:
        """The failed attempt was made good, or the expert failed at it, too: another scene follows."""
        method = self._tools.state.method
        seed = method.pop(FAILED)
        method[SHOWN] = [*method.get(SHOWN, ()), *([seed] if counts else ())]

    def figures(self) -> Mapping[str, Any]:
        assert self._expert is not None
        seconds, self._seconds = self._seconds, 0.0
        if self._expert.demonstrates:
            return _OF_A_DEMONSTRATION
        return {"n_asked_steps": self._expert.n_asked, "n_calls": self._expert.n_calls, "gate_s": round(seconds, 4)}

    def recovered_figures(self, cost: Mapping[str, Any]) -> Mapping[str, Any]:
        assert self._expert is not None
        if self.owes:
            self._note_shown()
            return _OF_A_DEMONSTRATION
        if self._expert.decides:
            return {}  # a person who is called may come or not: what was asked is lost
        return {"n_asked_steps": cost["n_expert_steps"], "n_calls": cost["n_takeovers"]}


class Asked(Demonstrating):
    """An expert that acts when the robot asks or, if it is one that decides, that is called then.

    Args:
        expert: The expert.
        method: Knows when the robot asks.

    Attributes:
        n_asked, n_calls: Steps of the attempt in which the robot asked, and how often it began to.
    """

    def __init__(self, expert: Expert, method: RobotGated) -> None:
        super().__init__(expert)
        self._method = method
        self.n_asked = self.n_calls = 0

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        self._asking, self._asks = None if self.demonstrates else self._method.asking(), False
        self.n_asked = self.n_calls = 0

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        if self.demonstrates:
            self.expert.wants_control(observation, policy_action)  # it looks
            return True
        asked_before = self._asks
        if self._asking is not None:
            self._asks = self._asking.asks(*self._method.state_of_mind(policy_action))
        self.n_asked += self._asks
        self.n_calls += self._asks and not asked_before
        if self.decides:
            self.expert.call(self._asks)
            return self.expert.wants_control(observation, policy_action)
        self.expert.wants_control(observation, policy_action)  # it looks
        if self._asks and not asked_before:
            self.expert.take_over()
        elif asked_before and not self._asks:
            self.expert.hand_back()
        return self._asks
