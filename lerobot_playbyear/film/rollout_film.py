"""`playbyear-video`: an episode of a policy or of a script, as a film with its sound."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig, make_env
from lerobot.envs.utils import FreezeAfterEpisodeEnd

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import check_can_be_made
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import Actor, Episode, Observation, play
from lerobot_playbyear.episodes.pool import Script
from lerobot_playbyear.film.video import compose, film_sound, inset, write_film

_AUDIO = "audio."  # how raw observations name microphones


@dataclass
class VideoConfig:
    """Options of `playbyear-video`.

    Args:
        env: The environment. Its `render()` gives the pictures.
        policy: The policy, `--policy.path`: a checkpoint's folder or its name on the Hub. Without it the environment's script
            acts.
        output: The video, an mp4.
        seed: Seed of the first episode.
        attempts: Largest number of episodes, with successive seeds, until one succeeds. The last one is filmed.
        baseline: Name of the blind baseline that acts instead of the script.
    """

    env: EnvConfig
    policy: PreTrainedConfig | None = None
    output: Path = field(default=Path("outputs/rollout.mp4"))
    seed: int = 1000
    attempts: int = 1
    baseline: str | None = None

    def __post_init__(self) -> None:
        path = parser.get_path_arg("policy")
        if path:
            overrides = parser.get_cli_overrides("policy") or []
            self.policy = PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
            self.policy.pretrained_path = Path(path)

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """The fields that a checkpoint can fill: `--policy.path`."""
        return ["policy"]


def film(cfg: VideoConfig) -> Path:
    """Plays episodes until one succeeds or the attempts are used up, and writes the last one's film.

    Returns:
        The film's path.

    Raises:
        InputError: An option is out of range, or the film cannot be written there.
        RolloutError: No policy is given and the environment has no script.
    """
    _check_options(cfg)
    env = env_spec(cfg.env).make() if cfg.policy is None else env_of_lerobot(cfg.env)
    try:
        actor: Actor = Script(cfg.baseline)
        if cfg.policy is not None:
            # A third of the time in which the command starts, which a script can do without.
            from lerobot_playbyear.episodes.policy_actor import load_policy_actor

            actor = load_policy_actor(cfg.policy, cfg.env)
        for seed in range(cfg.seed, cfg.seed + cfg.attempts):
            episode = play(env, actor, seed, watch=env.render)
            if episode.success:
                break
    finally:
        env.close()
    write_episode_film(episode, cfg.output, cfg.env.fps)
    outcome = "success" if episode.success else "failure"
    print(f"Film: {cfg.output} (seed {episode.seed}, {len(episode)} steps, {outcome})")
    return cfg.output


def _check_options(cfg: VideoConfig) -> None:
    """What would otherwise show only after the episode."""
    if cfg.attempts < 1:
        raise InputError(f"attempts={cfg.attempts}: give at least 1.")
    if cfg.seed < 0:
        raise InputError(f"seed={cfg.seed}: give 0 or more.")
    if cfg.output.suffix.lower() != ".mp4":
        raise InputError(f"--output={cfg.output}: films are mp4; give a name that ends with .mp4.")
    if cfg.output.is_dir():
        raise InputError(f"--output={cfg.output}: that is a folder; give the name of a file.")
    check_can_be_made(cfg.output.parent, f"--output={cfg.output}")
    if cfg.policy is not None and cfg.baseline is not None:
        raise InputError(f"--baseline={cfg.baseline}: it acts without a policy; leave it or --policy.path out.")


def env_of_lerobot(env_cfg: EnvConfig) -> gym.Env:
    """The first environment that LeRobot makes for a configuration, also where Gymnasium knows none of that name."""
    vec: Any = next(iter(next(iter(make_env(env_cfg).values())).values()))
    env = vec.envs[0]
    return env.env if isinstance(env, FreezeAfterEpisodeEnd) else env  # that one ends with its first episode


def write_episode_film(episode: Episode, path: Path, fps: float) -> None:
    """Writes a film with the policy's camera in a corner, the spectrogram below, and the sound as loud as it can be.

    Args:
        episode: Has watched T + 1 pictures (H, W, 3) uint8; its sound is int16. Microphones of another rate than the
            first one's are not heard.
        path: Of the film, an mp4.
        fps: Steps per second.
    """
    keys = [key for key in episode.observations[0] if key.startswith(_AUDIO)]
    heard = [np.concatenate([observation[key] for observation in episode.observations]) for key in keys]
    sound, sample_rate = film_sound(heard, len(episode.observations), fps)
    views = [_first_camera(observation) for observation in episode.observations]
    pictures = (p if v is None else inset(p, v) for p, v in zip(episode.watched, views, strict=True))
    write_film(path, compose(pictures, len(views), sound, sample_rate), fps, sound, sample_rate)


def _first_camera(observation: Observation) -> np.ndarray | None:
    pixels: Any = observation.get("pixels")
    return next(iter(pixels.values()), None) if isinstance(pixels, dict) else pixels
