"""One attempt: the policy acts, the expert sits beside it."""

from dataclasses import dataclass

import gymnasium as gym
from lerobot.utils.random_utils import set_seed

from lerobot_playbyear.dagger.methods.beside import Early
from lerobot_playbyear.episodes.episode import Episode
from lerobot_playbyear.episodes.expert import Expert
from lerobot_playbyear.episodes.play import Seconds, play
from lerobot_playbyear.episodes.policy_actor import PolicyActor


@dataclass
class Scene:
    """Where attempts happen.

    Args:
        env: The environment.
        actor: The policy in it.
        expert: Who corrects it, as the method has it.
        early: The expert that takes over before it would by itself, if it does: it speaks for the one that does not.
    """

    env: gym.Env
    actor: PolicyActor
    expert: Expert
    early: Early | None = None

    def attempt(self, seed: int, random_seed: int, seconds: Seconds) -> Episode:
        """Plays one attempt; one with an early expert is played once before, until it would have taken over.

        Args:
            seed: Of the environment.
            random_seed: Of all other random numbers; the same ones in a rehearsal.
            seconds: Count where time goes.
        """
        if self.early is not None:
            self.early.is_rehearsal = True
            set_seed(random_seed)
            play(self.env, self.actor, seed, expert=self.early, seconds=seconds)
            self.early.is_rehearsal = False
        set_seed(random_seed)
        return play(self.env, self.actor, seed, expert=self.expert, seconds=seconds)
