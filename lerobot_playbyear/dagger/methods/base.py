"""What tells the methods of interactive imitation apart: who acts when, what is recorded, what is kept and learned from.

A method of your own is a subclass of `Method` with what it does otherwise than HG-DAgger, and a configuration that makes it,
registered under a name for `--method.type`.
"""

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import draccus
import torch
from torch import Tensor

from lerobot_playbyear.datasets import EpisodeStore
from lerobot_playbyear.episodes.episode import Episode, Verdict
from lerobot_playbyear.episodes.expert import Expert
from lerobot_playbyear.episodes.play import Seconds

if TYPE_CHECKING:
    from lerobot_playbyear.dagger.attempt import Scene
    from lerobot_playbyear.dagger.config import DaggerConfig
    from lerobot_playbyear.dagger.corrections import Corrections
    from lerobot_playbyear.dagger.folder import RunFolder, RunState
    from lerobot_playbyear.episodes.environment import EnvFacts
    from lerobot_playbyear.training.parts import TrainingParts
    from lerobot_playbyear.training.windows import PolicyWindows

Features = dict[str, dict[str, Any]]


@dataclass
class Learned:
    """What is learned from how often.

    Attributes:
        weights: (N,) of every frame of the attempts, to any scale; 0 is not learned from.
        demonstrations: Share of the learned actions that come from demonstrations, above 0 and below 1.
    """

    weights: Tensor
    demonstrations: float = 0.5


@dataclass
class Tools:
    """What a run has, for methods that need more than the attempts."""

    cfg: "DaggerConfig"
    folder: "RunFolder"
    state: "RunState"
    parts: "TrainingParts"
    windows: "PolicyWindows"
    demonstrations: EpisodeStore
    corrections: "Corrections"
    facts: "EnvFacts | None"


@dataclass
class MethodConfig(draccus.ChoiceRegistry, abc.ABC):
    """Options of a method, `--method.*`. Subclasses register with `@MethodConfig.register_subclass("name")`.

    Attributes:
        expert_decides: The expert says when it takes over, so that `--takeover_delay_s` has a meaning.
        chooses_frames: The method says what is learned from, so that `--learn_from` has none, and `--skip_s` is 0 by default.
        is_watched: A person who corrects has to watch all of every attempt.
        needs_judge: The expert has to say when it takes over.
    """

    expert_decides: ClassVar[bool] = True
    chooses_frames: ClassVar[bool] = False
    is_watched: ClassVar[bool] = True
    needs_judge: ClassVar[bool] = True

    @property
    def type(self) -> str:
        return str(self.get_choice_name(self.__class__))

    @classmethod
    def default_choice_name(cls) -> str | None:
        return "hg_dagger"

    def check(self) -> None:
        """Raise an InputError if an option is out of its range."""

    @abc.abstractmethod
    def make(self, cfg: "DaggerConfig") -> "Method":
        """Makes the method for a run with these options."""


class Method:
    """HG-DAgger; others override what they do otherwise.

    Args:
        cfg: The options of the run.
    """

    def __init__(self, cfg: "DaggerConfig") -> None:
        self.cfg = cfg

    def features(self, features: Features) -> Features:
        """The features of the intervention dataset, from those of an attempt."""
        return features

    def beside(self, expert: Expert) -> Expert:
        """Who sits beside the policy: the expert, or somebody who speaks for it.

        Raises:
            ExpertError: The method cannot work with this expert.
        """
        return expert

    def begin(self, tools: Tools) -> None:
        """All is there that a run needs, and nothing was done or written yet.

        Raises:
            InputError: The method cannot work with these parts.
        """

    @property
    def is_alone(self) -> bool:
        """Whether nobody helps in the next attempt, whatever happens: such a one counts for no `--max_attempts`."""
        return False

    @property
    def owes(self) -> bool:
        """Whether the next attempt belongs to the last one, so that a run does not end before it."""
        return False

    def prepare(self) -> None:
        """An attempt follows. What is made here must depend on the state of the run alone, so that it resumes exactly."""

    def attempt(self, scene: "Scene", seed: int, random_seed: int, seconds: Seconds) -> Episode:
        """Makes an attempt; the arguments are those of `Scene.attempt`."""
        return scene.attempt(seed, random_seed, seconds)

    def recorded(self, episode: Episode) -> Episode:
        """An attempt as it is recorded, with `interventions` where the recorded action is the expert's."""
        return episode

    def outcome(self, episode: Episode) -> str:
        """What becomes of an attempt, as `RunState` counts them."""
        return outcome_of(episode)

    def note(self, episode: Episode, outcome: str) -> None:
        """An attempt was made, and saved if it is kept; it counts after this."""

    def control_of(self, by_expert: Any) -> Any:
        """(T,) who was in control, from the column `intervention` of an attempt as it was recorded."""
        return by_expert

    def close(self) -> None:
        """No attempt follows."""

    def figures(self) -> Mapping[str, float]:
        """Further figures of the last attempt, and those that are otherwise than `attempt_figures` takes them to be."""
        return {}

    def recovered_figures(self, cost: Mapping[str, Any]) -> Mapping[str, float]:
        """The same of an attempt that was written to disk just before the run was killed, as far as its cost tells.

        Args:
            cost: What `attempt_figures` says of it.
        """
        return {}

    @property
    def weighs_frames(self) -> bool:
        """Whether `learned` says what is learned from. Otherwise it is half demonstrations, and half what the expert chose."""
        return self.cfg.learn_from == "all"

    def learned(self, n_demonstrated: int, attempts: EpisodeStore) -> Learned:
        """What is learned from how often: half demonstrations, half the attempts, each frame alike.

        Args:
            n_demonstrated: Frames of the demonstrations.
            attempts: The attempts, with the column `intervention`.
        """
        return Learned(torch.ones(len(attempts)))


def outcome_of(episode: Episode) -> str:
    """What becomes of an attempt: `kept` (learned from), `unneeded`, `failed` or `discarded`, as `RunState` counts them."""
    if episode.verdict is Verdict.DISCARD:
        return "discarded"
    if not episode.success:
        return "failed"
    return "kept" if episode.intervention_share > 0 else "unneeded"
