"""`playbyear-record --expert.type=teleop`: a person's demonstrations, with the controls of the person who corrects."""

import dataclasses
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np
from lerobot.envs import EnvConfig

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.episodes.environment import EnvFacts, env_facts, env_spec, task_description
from lerobot_playbyear.episodes.episode import Episode, Observation, Verdict
from lerobot_playbyear.episodes.expert import Expert
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.saving import check_room
from lerobot_playbyear.episodes.streaming import FrameStream
from lerobot_playbyear.teleoperation.config import TeleopExpertConfig


@dataclass
class PersonRollouts:
    """Episodes of a person, with the interface of `RolloutPool`.

    Args:
        env: The environment.
        expert: The person.
        writer: Where a robot's episodes go while they are played; None: they stay in memory until they are saved.
    """

    env: gym.Env
    expert: Expert
    writer: DurableWriter | None = None
    _most_bytes: int | None = field(default=None, init=False)

    def facts(self) -> EnvFacts:
        """What the environment looks like; a person needs no script."""
        return dataclasses.replace(env_facts(self.env), has_expert=True)

    def episodes(self, seeds: Iterable[int]) -> Iterator[Episode]:
        """One episode per seed; those that the person throws away are done again."""
        for seed in seeds:
            while (episode := self._play(seed)).verdict is Verdict.DISCARD:
                pass
            yield episode

    def _play(self, seed: int) -> Episode:
        if self.writer is None or not getattr(self.env.unwrapped, "is_real_time", False):
            return play(self.env, Nobody(), seed, expert=self.expert)
        check_room(self.writer, self._most_bytes)
        stream = FrameStream(self.writer, seed, task_description(self.env))
        try:
            episode = play(self.env, Nobody(), seed, expert=self.expert, sink=stream)
            stream.finish()
            self._most_bytes = max(self._most_bytes or 0, self.writer.episode_bytes())
        except BaseException:
            with suppress(Exception):  # the first error says more
                stream.abandon()
            raise
        if not episode.success:
            stream.abandon()
        return episode


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
