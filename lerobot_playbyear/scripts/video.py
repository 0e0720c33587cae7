"""Films an episode with its sound: a policy's, or without one the scripted expert's.

    playbyear-video --policy.path=outputs/train/checkpoints/last/pretrained_model \
        --env.type=playbyear --env.task=OccludedGrasp-v0 --seed=1000 --output=outputs/rollout.mp4
"""

import logging
import sys
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig, close_envs, make_env
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.constants import OBS_IMAGE, OBS_STR
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_playbyear.acting import load_for_rollout
from lerobot_playbyear.datasets.audio_feature import audio_keys
from lerobot_playbyear.recording import env_spec
from lerobot_playbyear.rollouts import RolloutError, roll_out
from lerobot_playbyear.video import amplify, compose, episode_sound, inset, write_film

_AUDIO = "audio."


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


@dataclass
class Take:
    """One filmed episode of T steps.

    Args:
        seed: Of the episode.
        success: Whether the task was solved.
        pictures: T + 1 pictures (H, W, 3) uint8, with the policy's camera in a corner.
        blocks: (T + 1, S, n_microphones) int16, the sound of each observation.
    """

    seed: int
    success: bool
    pictures: list[np.ndarray]
    blocks: np.ndarray


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
    play = _policy_takes(cfg) if cfg.policy is not None else _script_takes(cfg)
    for take in play:
        if take.success:
            break
    play.close()
    sample_rate = take.blocks.shape[1] * cfg.env.fps or 16000
    sound = amplify(episode_sound(take.blocks))
    write_film(cfg.output, compose(take.pictures, sound, sample_rate), cfg.env.fps, sound, sample_rate)
    outcome = "success" if take.success else "failure"
    print(f"Film: {cfg.output} (seed {take.seed}, {len(take.pictures) - 1} steps, {outcome})")
    return cfg.output


def _script_takes(cfg: VideoConfig) -> Generator[Take]:
    env = env_spec(cfg.env).make()
    try:
        for seed in range(cfg.seed, cfg.seed + cfg.attempts):
            episode = roll_out(env, seed, actor=cfg.baseline, pictures=True)
            keys = [key for key in episode.observations[0] if key.startswith(_AUDIO)]
            sounds = [np.stack([observation[key] for observation in episode.observations]) for key in keys]
            views = [_first_camera(observation) for observation in episode.observations]
            pictures = _with_views(episode.pictures, views)
            yield Take(seed, episode.success, pictures, _stack(sounds, len(pictures)))
    finally:
        env.close()


def _policy_takes(cfg: VideoConfig) -> Generator[Take]:
    assert cfg.policy is not None
    envs = make_env(cfg.env, n_envs=1)
    vec = next(iter(next(iter(envs.values())).values()))
    parts = load_for_rollout(cfg.policy, cfg.env)
    try:
        for seed in range(cfg.seed, cfg.seed + cfg.attempts):
            pictures: list[np.ndarray] = []
            with torch.no_grad():
                result = rollout(
                    vec,
                    *parts.in_order(),
                    seeds=[seed],
                    return_observations=True,
                    render_callback=lambda env, kept=pictures: kept.append(env.call("render")[0]),
                )
            observations = result[OBS_STR]  # as preprocess_observation makes them: floats at PCM's full scale
            sounds = [observations[key][0].round().short().numpy() for key in audio_keys(observations)]
            cameras = [key for key in observations if key.startswith(OBS_IMAGE)]
            views = [_to_picture(view) for view in observations[cameras[0]][0]] if cameras else []
            shown = _with_views(pictures, views)
            yield Take(seed, bool(result["success"].any()), shown, _stack(sounds, len(shown)))
    finally:
        close_envs(envs)


def _first_camera(observation: dict[str, Any]) -> np.ndarray | None:
    pixels = observation.get("pixels")
    return next(iter(pixels.values()), None) if isinstance(pixels, dict) else pixels


def _to_picture(view: torch.Tensor) -> np.ndarray:
    """(3, h, w) in [0, 1] -> (h, w, 3) uint8."""
    return (view.permute(1, 2, 0) * 255).round().to(torch.uint8).cpu().numpy()


def _with_views(pictures: list[np.ndarray], views: Sequence[np.ndarray | None]) -> list[np.ndarray]:
    if not views or any(view is None for view in views):
        return pictures
    return [inset(picture, view) for picture, view in zip(pictures, views, strict=True) if view is not None]


def _stack(sounds: list[np.ndarray], n_frames: int) -> np.ndarray:
    """(T + 1, S) of each microphone -> (T + 1, S, n_microphones); without one (T + 1, 0, 0)."""
    return np.stack(sounds, axis=-1) if sounds else np.zeros((n_frames, 0, 0), np.int16)


@parser.wrap()
def _run(cfg: VideoConfig) -> None:
    film(cfg)


def main() -> None:
    logging.basicConfig(level=logging.WARNING)
    register_third_party_plugins()
    try:
        _run()
    except (RolloutError, ValueError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
