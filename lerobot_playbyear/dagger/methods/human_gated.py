"""Methods in which the expert decides who acts: HG-DAgger, DAgger, and corrections without a hand-back."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from lerobot.utils.constants import ACTION

from lerobot_playbyear.dagger.methods.base import Features, Method, MethodConfig, outcome_of
from lerobot_playbyear.dagger.methods.beside import Labelling, Staying
from lerobot_playbyear.episodes.episode import Episode
from lerobot_playbyear.episodes.expert import Expert
from lerobot_playbyear.episodes.frames import EXECUTED

if TYPE_CHECKING:
    from lerobot_playbyear.dagger.config import DaggerConfig


@MethodConfig.register_subclass("hg_dagger")
@dataclass
class HgDaggerConfig(MethodConfig):
    """The expert takes over and hands back as it likes (Kelly et al., 2019)."""

    def make(self, cfg: "DaggerConfig") -> Method:
        return Method(cfg)


@MethodConfig.register_subclass("no_handback")
@dataclass
class NoHandbackConfig(MethodConfig):
    """The expert takes over as it likes and acts to the end: an attempt holds one correction (as in RaC, Hu et al., 2025)."""

    def make(self, cfg: "DaggerConfig") -> Method:
        return NoHandback(cfg)


class NoHandback(Method):
    """An attempt ends with its correction."""

    def beside(self, expert: Expert) -> Expert:
        return Staying(expert)


@MethodConfig.register_subclass("dagger")
@dataclass
class PlainDaggerConfig(MethodConfig):
    """The policy acts, and the expert labels every frame with what it would have done (Ross et al., 2011)."""

    expert_decides: ClassVar[bool] = False
    chooses_frames: ClassVar[bool] = True

    def make(self, cfg: "DaggerConfig") -> Method:
        return PlainDagger(cfg)


class PlainDagger(Method):
    """Every frame is the expert's word on a state that the policy reached by itself.

    `action` holds the label, because that is what is learned from, `intervention` is true in every frame, because the expert
    chose the action in it, and `executed_action` is what the policy did. All attempts are kept, failed ones too.
    """

    def features(self, features: Features) -> Features:
        return {**features, EXECUTED: dict(features[ACTION])}

    def beside(self, expert: Expert) -> Expert:
        self._expert = Labelling(expert)
        return self._expert

    def recorded(self, episode: Episode) -> Episode:
        labels = np.stack(self._expert.labels)
        everywhere = np.ones(len(episode), bool)
        return replace(episode, actions=labels, executed=episode.actions, interventions=everywhere)

    def outcome(self, episode: Episode) -> str:
        return "discarded" if outcome_of(episode) == "discarded" else "kept"

    def control_of(self, by_expert: np.ndarray) -> np.ndarray:
        return np.zeros_like(by_expert)
