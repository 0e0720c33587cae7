"""`playbyear-record`: episodes of an environment's scripted expert, or of a person, become a LeRobotDataset with sound."""

import dataclasses
import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.configs.video import RGBEncoderConfig
from lerobot.envs import EnvConfig
from tqdm import tqdm

from lerobot_playbyear.datasets.durable import DurableWriter, check_root
from lerobot_playbyear.datasets.errors import InputError, PlaybyearError, errors_of_input
from lerobot_playbyear.datasets.next_command import training_command
from lerobot_playbyear.datasets.reader import DatasetPlace
from lerobot_playbyear.episodes.environment import EnvFacts, env_facts, env_spec
from lerobot_playbyear.episodes.experts import ExpertConfig, ScriptedExpertConfig
from lerobot_playbyear.episodes.frames import dataset_features, next_seed, save_episode
from lerobot_playbyear.episodes.play import Episode, Observation, Verdict, play
from lerobot_playbyear.episodes.pool import RolloutPool
from lerobot_playbyear.hub.push import PushOptions, check_upload, push_dataset
from lerobot_playbyear.teleoperation.config import TeleopExpertConfig

_MIN_ATTEMPTS_PER_SUCCESS = 20  # attempts in a row without one success after which recording gives up


@dataclass
class RecordDatasetConfig(DatasetPlace):
    """The dataset that is written.

    Args:
        repo_id: Name of the dataset, `user/name`.
        root: Its folder. None: the one in LeRobot's cache.
        num_episodes: Successful episodes to record. With `resume` they are added to the recorded ones.
        video: Encode pictures as video. Otherwise each picture is stored without loss.
        rgb_encoder: Codec and quality of the video, such as `--dataset.rgb_encoder.vcodec=h264`.
        push_to_hub: Upload the dataset when it is complete.
        private: Make a new repository private. True: refuse to upload to an existing public one. None: the account's default.
        tags: Tags for the card on the Hub.
        single_task: Description of the task. None: the environment's.
        fps: Frames per second. Only the environment's own rate works. None: that rate.
    """

    num_episodes: int = 50
    video: bool = False
    rgb_encoder: RGBEncoderConfig = field(default_factory=RGBEncoderConfig)
    push_to_hub: bool = False
    private: bool | None = None
    tags: list[str] | None = None
    single_task: str | None = None
    fps: int | None = None


@dataclass
class RecordConfig:
    """Options of `playbyear-record`.

    Args:
        env: The environment, `--env.type=playbyear --env.task=OccludedGrasp-v1`.
        dataset: The dataset to write.
        seed: Seed of the first episode. Every further episode takes the next one.
        resume: Append `num_episodes` to an existing dataset, with the seeds after its largest.
        num_workers: Processes that roll out. 0: only this one. None: one per processor core, at most 8. The recorded data are
            the same.
        expert: Source of the demonstrations: `--expert.type=scripted`, the environment's script, or `teleop`, a person.
    """

    env: EnvConfig
    dataset: RecordDatasetConfig
    seed: int = 0
    resume: bool = False
    num_workers: int | None = None
    expert: ExpertConfig = field(default_factory=ScriptedExpertConfig)

    def __post_init__(self) -> None:
        if self.num_workers is None:
            self.num_workers = min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1, 8)


def record(cfg: RecordConfig) -> Path:
    """Records episodes of a script or of a person until as many are saved as asked for; only successes are kept.

    Args:
        cfg: The options.

    Returns:
        The dataset's folder.

    Raises:
        PlaybyearError: Bad options, a folder that cannot be written, an environment without an expert, a dataset that
            does not fit, a full disk, a Hub that cannot be reached; or the person's window or teleoperator cannot be had.
            Episodes saved before are safe.
    """
    root = cfg.dataset.folder
    try:
        with errors_of_input():
            _check_options(cfg)
            check_root(root, resume=cfg.resume)
        with _demonstrations(cfg) as (facts, episodes):
            with errors_of_input():
                _check_facts(facts, cfg)
                features = dataset_features(facts, cfg.dataset.video)
                how: dict[str, Any] = {"robot_type": cfg.env.type, "rgb_encoder": cfg.dataset.rgb_encoder}
                writer = DurableWriter(cfg.dataset.repo_id, root, facts.fps, features, resume=cfg.resume, **how)
            _say_what_differs(cfg.dataset)
            with writer:
                seconds = writer.longest_episode / facts.fps
                print(f"With the memory that is free an episode can last about {seconds / 60:.0f} min.")
                _record_episodes(cfg, episodes, writer)
                summary = f"{writer.num_episodes} episodes, {writer.num_frames} frames"
    except MemoryError as error:
        raise PlaybyearError(f"There is not enough memory to record to {root}. What was saved is complete.") from error
    except OSError as error:
        raise PlaybyearError(f"Cannot write to {root}: {error}") from error
    print(f"\nDataset: {root} ({summary})")
    print(f"Train on it: {training_command(cfg.dataset.repo_id, features, root)}")
    if cfg.dataset.push_to_hub:
        options = PushOptions(cfg.dataset.private, cfg.dataset.tags)
        print(f"On the Hub: {push_dataset(cfg.dataset.repo_id, cfg.dataset.root, options)}")
    return root


Demonstrations = Callable[[Iterable[int]], Iterator[Episode]]
"""Gives one episode for each seed."""


@contextmanager
def _demonstrations(cfg: RecordConfig) -> Iterator[tuple[EnvFacts, Demonstrations]]:
    """What the environment looks like, and where episodes come from: a script in several processes, or a person."""
    if not isinstance(cfg.expert, TeleopExpertConfig):
        with closing(RolloutPool(env_spec(cfg.env), cfg.num_workers or 0)) as pool:
            with errors_of_input():
                facts = pool.facts()
            yield facts, pool.episodes
        return
    with closing(env_spec(cfg.env).make()) as env, closing(cfg.expert.make(env, demonstrates=True)) as person:

        def episodes(seeds: Iterable[int]) -> Iterator[Episode]:
            for seed in seeds:  # what the person throws away is done again
                while (episode := play(env, Nobody(), seed, expert=person)).verdict is Verdict.DISCARD:
                    pass
                yield episode

        with errors_of_input():
            facts = dataclasses.replace(env_facts(env), has_expert=True)
        yield facts, episodes


class Nobody:
    """Stands where the policy stands while a person demonstrates: an actor that never moves."""

    def reset(self, env: gym.Env) -> None:
        assert env.action_space.shape is not None
        self._action = np.zeros(env.action_space.shape, np.float32)

    def act(self, observation: Observation) -> np.ndarray:
        return self._action


def _record_episodes(cfg: RecordConfig, demonstrations: Demonstrations, writer: DurableWriter) -> None:
    wanted = cfg.dataset.num_episodes
    first_seed = next_seed(writer.root, cfg.seed)
    attempts = successes = failures_in_a_row = 0
    with tqdm(total=wanted, unit="episode", desc="Recording") as progress:
        for episode in demonstrations(itertools.count(first_seed)):
            attempts += 1
            failures_in_a_row = 0 if episode.success else failures_in_a_row + 1
            if episode.success:
                save_episode(dataclasses.replace(episode, task=cfg.dataset.single_task or episode.task), writer)
                successes += 1
                progress.update()
            progress.set_postfix_str(f"success rate {successes / attempts:.0%} of {attempts} attempts")
            if failures_in_a_row >= _MIN_ATTEMPTS_PER_SUCCESS and isinstance(cfg.expert, ScriptedExpertConfig):
                raise InputError(
                    f"The expert failed {failures_in_a_row} times in a row, up to seed {episode.seed}: something is "
                    f"wrong with the task's options. {writer.num_episodes} episodes are saved in {writer.root}."
                )
            if successes >= wanted:
                return


def _check_options(cfg: RecordConfig) -> None:
    if cfg.dataset.num_episodes < 1:
        raise InputError(f"--dataset.num_episodes={cfg.dataset.num_episodes}: give at least 1.")
    if cfg.seed < 0:
        raise InputError(f"--seed={cfg.seed}: give 0 or more.")
    if not isinstance(cfg.expert, ScriptedExpertConfig | TeleopExpertConfig):
        raise InputError(f"--expert.type={cfg.expert.type} demonstrates nothing: give scripted or teleop.")
    if not cfg.dataset.video and cfg.dataset.rgb_encoder != RGBEncoderConfig():
        raise InputError("--dataset.rgb_encoder.* encodes video: give --dataset.video=true, too, or leave it out.")
    if cfg.dataset.push_to_hub:
        check_upload("dataset.repo_id", cfg.dataset.repo_id, needs_user=True)


def _say_what_differs(dataset: RecordDatasetConfig) -> None:
    """What `lerobot-record` would do otherwise."""
    differing = [] if dataset.video else ["pictures are stored without loss (else --dataset.video=true)"]
    differing += [] if dataset.push_to_hub else ["nothing is uploaded (else --dataset.push_to_hub=true)"]
    print(f"Unlike in lerobot-record, {' and '.join([*differing, 'the name gets no date'])}.")


def _check_facts(facts: EnvFacts, cfg: RecordConfig) -> None:
    env = cfg.env
    if not facts.has_expert:
        raise InputError(
            f"--env.type={env.type} --env.task={env.task} has no scripted expert, so there is nobody to record. "
            "Record a person with --expert.type=teleop."
        )
    for option, fps in (("env", env.fps), ("dataset", cfg.dataset.fps)):
        if fps not in (None, facts.fps):
            runs = f"the environment runs at {facts.fps} steps per second"
            or_none = ", or leave it out" if option == "dataset" else ""
            raise InputError(f"--{option}.fps={fps}, but {runs}: give that{or_none}.")
