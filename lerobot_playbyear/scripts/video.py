"""Films an episode with its sound: a policy's, or without one the scripted expert's.

    playbyear-video --policy.path=outputs/train/checkpoints/last/pretrained_model \
        --env.type=playbyear --env.task=OccludedGrasp-v0 --seed=1000 --output=outputs/rollout.mp4
"""

import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig, close_envs, make_env
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_playbyear.episodes.acting import load_for_rollout
from lerobot_playbyear.episodes.rollouts import RolloutError
from lerobot_playbyear.film.takes import policy_takes, script_takes, write_take
from lerobot_playbyear.hub.client import patient_hub
from lerobot_playbyear.recording.record import env_spec


@dataclass
class VideoConfig:
    """Options of `playbyear-video`.

    Args:
        env: The environment; its `render()` gives the pictures.
        policy: `--policy.path=`, a checkpoint's folder or its name on the Hub. Without it a script acts.
        output: The film, an mp4.
        seed: Of the first episode.
        attempts: How many episodes, with the seeds after it, may be played until one succeeds; the last one played
            is filmed.
        baseline: Without a policy, the name of the environment's blind baseline that acts in the expert's stead.
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
        ValueError: An option is out of range.
        RolloutError: No policy is given and the environment has no script.
    """
    if cfg.attempts < 1:
        raise ValueError(f"attempts={cfg.attempts}: give at least 1.")
    seeds = range(cfg.seed, cfg.seed + cfg.attempts)
    close: Callable[[], None]
    if cfg.policy is not None:
        envs = make_env(cfg.env, n_envs=1)
        vec = next(iter(next(iter(envs.values())).values()))
        play, close = policy_takes(vec, load_for_rollout(cfg.policy, cfg.env), seeds), partial(close_envs, envs)
    else:
        env = env_spec(cfg.env).make()
        play, close = script_takes(env, seeds, cfg.baseline), env.close
    try:
        for take in play:
            if take.success:
                break
    finally:
        close()
    write_take(take, cfg.output, cfg.env.fps)
    outcome = "success" if take.success else "failure"
    print(f"Film: {cfg.output} (seed {take.seed}, {len(take.pictures) - 1} steps, {outcome})")
    return cfg.output


@parser.wrap()
def _run(cfg: VideoConfig) -> None:
    film(cfg)


def main() -> None:
    logging.basicConfig(level=logging.WARNING)
    register_third_party_plugins()
    try:
        with patient_hub():
            _run()
    except (RolloutError, ValueError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
