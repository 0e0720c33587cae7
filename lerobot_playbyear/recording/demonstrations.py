"""`playbyear-record --expert.type=teleop`: a person's demonstrations, with the controls of the person who corrects."""

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import gymnasium as gym
import numpy as np

from lerobot_playbyear.episodes.environment import EnvFacts, env_facts, env_spec
from lerobot_playbyear.episodes.episode import Episode, Observation, Verdict
from lerobot_playbyear.episodes.expert import ExpertConfig, ScriptedExpertConfig
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.recording.record import RecordConfig, RecordError, record
from lerobot_playbyear.teleoperation.config import TeleopExpertConfig


@dataclass
class DemonstrationConfig(RecordConfig):
    """Options of `playbyear-record`, with who demonstrates.

    Args:
        expert: `--expert.type=scripted`, the environment's own script, or `teleop`, a person.
    """

    expert: ExpertConfig = field(default_factory=ScriptedExpertConfig)


class PersonRollouts:
    """Episodes of a person, with the interface of `RolloutPool`.

    Args:
        env: The environment; it is closed at the end.
        expert: The person's options.

    Raises:
        ExpertError: Environment, teleoperator or screen do not do.
    """

    def __init__(self, env: gym.Env, expert: TeleopExpertConfig) -> None:
        self._env = env
        try:
            self._expert = expert.make(env, demonstrates=True)
        except BaseException:
            env.close()
            raise

    def facts(self) -> EnvFacts:
        """What the environment looks like; a person needs no script."""
        return dataclasses.replace(env_facts(self._env), has_expert=True)

    def episodes(self, seeds: Iterable[int]) -> Iterator[Episode]:
        """One episode per seed; those that the person throws away are done again."""
        for seed in seeds:
            while (episode := play(self._env, Nobody(), seed, expert=self._expert)).verdict is Verdict.DISCARD:
                pass
            yield episode

    def close(self) -> None:
        self._expert.close()
        self._env.close()

    def __enter__(self) -> "PersonRollouts":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Nobody:
    """Stands where the policy stands while a person demonstrates: an actor that never moves."""

    def reset(self, env: gym.Env) -> None:
        assert env.action_space.shape is not None
        self._action = np.zeros(env.action_space.shape, np.float32)

    def act(self, observation: Observation) -> np.ndarray:
        return self._action


def record_demonstrations(cfg: DemonstrationConfig) -> Path:
    """Record a script, or a person.

    Args:
        cfg: The options.

    Returns:
        The dataset's folder.

    Raises:
        RecordError: As `record`; or the person's window or teleoperator cannot be had.
    """
    if isinstance(cfg.expert, ScriptedExpertConfig):
        return record(cfg)
    expert = cfg.expert
    if not isinstance(expert, TeleopExpertConfig):
        raise RecordError(
            f"--expert.type={expert.type} corrects a policy and does not demonstrate: give scripted or teleop."
        )
    return record(cfg, lambda: PersonRollouts(env_spec(cfg.env).make(), expert))
