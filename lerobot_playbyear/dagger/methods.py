"""The methods of interactive imitation, `--method.type`: who acts when, and what is kept and learned from.

A method of your own is a subclass of `Method` with what it does otherwise than HG-DAgger, registered under a name for
`--method.type`; its options are fields of a dataclass.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import draccus
import gymnasium as gym
import numpy as np

from lerobot_playbyear.dagger.batches import BalancedBatches, JoinedBatches
from lerobot_playbyear.episodes.experts import Expert
from lerobot_playbyear.episodes.play import Episode, Observation, Verdict
from lerobot_playbyear.training.store import EpisodeStore

if TYPE_CHECKING:
    from lerobot_playbyear.dagger.config import DaggerConfig
    from lerobot_playbyear.dagger.loop import Loop
    from lerobot_playbyear.training.batches import PolicyWindows


@dataclass
class Method(draccus.ChoiceRegistry):
    """HG-DAgger. Other methods override what differs, and register with `@Method.register_subclass("name")`.

    Attributes:
        is_watched: A person who corrects has to watch all of every attempt.
        needs_judge: The expert has to say when it takes over.
        skips_beginnings: Corrections have a beginning that is not learned from by default, `--skip_s`.
        shows_failures: Where an attempt fails, the scene is set up again with the same seed, and the expert demonstrates the
            task in it from the first step on.
    """

    is_watched: ClassVar[bool] = True
    needs_judge: ClassVar[bool] = True
    skips_beginnings: ClassVar[bool] = True
    shows_failures: ClassVar[bool] = False

    @property
    def type(self) -> str:
        return str(self.get_choice_name(self.__class__))

    @classmethod
    def default_choice_name(cls) -> str | None:
        return "hg_dagger"

    def check(self) -> None:
        """Raise an InputError if an option is out of its range."""

    def wrap(self, expert: Expert) -> Expert:
        """The expert as this method lets it act: itself, or with its takeovers changed."""
        return expert

    def begin(self, loop: "Loop") -> None:
        """The run begins, or goes on; `loop` has all of it. Not called where nobody acts."""

    @property
    def is_alone(self) -> bool:
        """Whether nobody helps in the next attempt, whatever happens: such a one counts for no `--max_attempts`."""
        return False

    def prepare(self, demonstrates: bool) -> None:
        """An attempt follows. What is made here must depend on the state of the run alone, so that it resumes exactly.

        Args:
            demonstrates: Whether the expert acts in it from the first step on, because the attempt before failed.
        """

    def outcome(self, episode: Episode) -> str:
        """What becomes of an attempt: `kept` (learned from), `unneeded`, `failed` or `discarded`."""
        if episode.verdict is Verdict.DISCARD:
            return "discarded"
        if not episode.success:
            return "failed"
        return "kept" if episode.intervention_share > 0 else "unneeded"

    def note(self, episode: Episode, outcome: str) -> None:
        """An attempt was made, and saved if it is kept; it counts after this."""

    def note_recovered(self) -> None:
        """The same of an attempt that was saved just before the run was killed, and counts after this."""

    def close(self) -> None:
        """No attempt follows."""

    def batches(
        self, cfg: "DaggerConfig", windows: "PolicyWindows", demonstrations: EpisodeStore, attempts: EpisodeStore | None
    ) -> BalancedBatches:
        """What is learned from: half demonstrations, half of what the expert chose in corrections."""
        n_skipped = cfg.n_skipped(demonstrations.fps)
        return BalancedBatches(windows, demonstrations, attempts, cfg.batch_size, cfg.seed, n_skipped)


@Method.register_subclass("hg_dagger")
@dataclass
class HgDagger(Method):
    """The expert takes over and hands back at any time (HG-DAgger, Kelly et al., 2019)."""


@Method.register_subclass("no_handback")
@dataclass
class NoHandback(Method):
    """The expert takes over at any time and finishes the episode: one correction per rollout (as in RaC, Hu et al., 2025)."""

    def wrap(self, expert: Expert) -> Expert:
        return Staying(expert)


@Method.register_subclass("redo")
@dataclass
class Redo(Method):
    """The expert demonstrates the scenes in which the policy fails. Every frame weighs as much as one of the demonstrations.

    The policy acts first, until the expert would take over or the episode ends. If it fails, the scene is set up again, and the
    expert demonstrates the task in it from the first step.
    """

    needs_judge: ClassVar[bool] = False
    skips_beginnings: ClassVar[bool] = False
    shows_failures: ClassVar[bool] = True

    def wrap(self, expert: Expert) -> Expert:
        self._expert = Showing(expert)
        return self._expert

    def prepare(self, demonstrates: bool) -> None:
        self._expert.demonstrates = demonstrates

    def batches(
        self, cfg: "DaggerConfig", windows: "PolicyWindows", demonstrations: EpisodeStore, attempts: EpisodeStore | None
    ) -> BalancedBatches:
        return JoinedBatches(windows, demonstrations, attempts, cfg.batch_size, cfg.seed)


# Experts that speak for another


class Beside(Expert):
    """Passes everything on to an expert.

    Args:
        expert: The expert.
    """

    def __init__(self, expert: Expert) -> None:
        self.expert = expert
        self.clock_fps, self.decides = expert.clock_fps, expert.decides  # type: ignore[misc]

    def reset(self, env: gym.Env) -> None:
        self.expert.reset(env)

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        return self.expert.wants_control(observation, policy_action)

    def act(self) -> np.ndarray:
        return self.expert.act()

    def verdict(self) -> Verdict | None:
        return self.expert.verdict()

    def close(self) -> None:
        self.expert.close()


class Staying(Beside):
    """Once the expert has taken over, it acts until the attempt ends."""

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        self._stays = False

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        wants = super().wants_control(observation, policy_action)
        if wants and not self._stays:
            self._stays = True
            self.expert.take_over()
        # A person who ended the attempt has no action for its last step.
        has_left = self.decides and not wants and super().verdict() is not None
        return self._stays and not has_left


class Showing(Beside):
    """In a try the policy acts, and the expert's wish to take over ends it; in a demonstration the expert acts all the time.

    Attributes:
        demonstrates: Set it before the attempt.
    """

    def __init__(self, expert: Expert) -> None:
        super().__init__(expert)
        self.demonstrates = False

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        self._is_over = False
        if self.demonstrates:
            self.expert.take_over()

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        wants = super().wants_control(observation, policy_action)
        self._is_over = wants and not self.demonstrates
        return self.demonstrates

    def verdict(self) -> Verdict | None:
        verdict = super().verdict()
        return Verdict.FAILURE if verdict is None and self._is_over else verdict
