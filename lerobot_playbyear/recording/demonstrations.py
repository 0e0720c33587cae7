"""`playbyear-record --expert.type=teleop`: a person's demonstrations, with the controls of the person who corrects."""

import dataclasses
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from lerobot.envs import EnvConfig

from lerobot_playbyear.episodes.environment import EnvFacts, env_facts, env_spec
from lerobot_playbyear.episodes.episode import Episode, Observation, Verdict
from lerobot_playbyear.episodes.expert import Expert
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.teleoperation.config import TeleopExpertConfig


@dataclass
class PersonRollouts:
    """Episodes of a person, with the interface of `RolloutPool`.

    Args:
        env: The environment.
        expert: The person.
    """

    env: gym.Env
    expert: Expert

    def facts(self) -> EnvFacts:
        """What the environment looks like; a person needs no script."""
        return dataclasses.replace(env_facts(self.env), has_expert=True)

    def episodes(self, seeds: Iterable[int]) -> Iterator[Episode]:
        """One episode per seed; those that the person throws away are done again."""
        for seed in seeds:
            while (episode := play(self.env, Nobody(), seed, expert=self.expert)).verdict is Verdict.DISCARD:
                pass
            yield episode


class Nobody:
    """Stands where the policy stands while a person demonstrates: an actor that never moves."""

    def reset(self, env: gym.Env) -> None:
        assert env.action_space.shape is not None
        self._action = np.zeros(env.action_space.shape, np.float32)

    def act(self, observation: Observation) -> np.ndarray:
        return self._action


@contextmanager
def person_rollouts(env_cfg: EnvConfig, expert: TeleopExpertConfig) -> Iterator[PersonRollouts]:
    """Episodes of a person, whose window and environment are closed at the end.

    Raises:
        RolloutError: The environment cannot be made.
        ExpertError: Environment, teleoperator or screen do not do.
    """
    with closing(env_spec(env_cfg).make()) as env, closing(expert.make(env, demonstrates=True)) as person:
        yield PersonRollouts(env, person)
