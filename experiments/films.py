"""Films with sound, one each: a success, a deaf policy's failure, and a contact that is played where there is none.

    python -m experiments.films --output=docs/media

takes the first training seed's policies of `experiments.ablations` on Occluded Grasp and the first evaluation seeds.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.import_utils import register_third_party_plugins

from experiments.ablations import STUDY
from experiments.protocol import DONOR_SEEDS, EVALUATION_SEEDS, N_DEMONSTRATIONS, STEPS, TRAINING_SEEDS
from experiments.sound_probe import SoundProbe, make_donors
from experiments.training import Job
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.policy_actor import load_policy_actor
from lerobot_playbyear.film.episode_film import write_episode_film

TASK = "OccludedGrasp-v0"


def film(condition: str, env: gym.Env, wanted: Callable[[bool], bool], path: Path) -> None:
    """Films the first episode of the evaluation seeds that is as wanted."""
    env_cfg = PlaybyearEnvConfig(task=TASK)
    checkpoint = Job(STUDY, TASK, condition, TRAINING_SEEDS[0], N_DEMONSTRATIONS, STEPS[TASK]).checkpoint
    policy_cfg = PreTrainedConfig.from_pretrained(checkpoint)
    policy_cfg.pretrained_path = checkpoint
    actor = load_policy_actor(policy_cfg, env_cfg)
    for seed in EVALUATION_SEEDS:
        episode = play(env, actor, seed, watch=env.render)
        if wanted(episode.success):
            write_episode_film(episode, path, env_cfg.fps)
            print(f"{path}: seed {seed}, {'success' if episode.success else 'failure'}")
            return
    raise RuntimeError(f"No episode for {path.name} in {len(EVALUATION_SEEDS)} seeds.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/media"))
    output = parser.parse_args().output
    register_third_party_plugins()

    env = env_spec(PlaybyearEnvConfig(task=TASK)).make()
    probe = SoundProbe(env, "false", make_donors(env, DONOR_SEEDS))
    film("full", env, lambda success: success, output / "success.mp4")
    film("deaf", env, lambda success: not success, output / "deaf.mp4")
    film("full", probe, lambda success: probe.trial.closed_there, output / "false_contact.mp4")
    env.close()


if __name__ == "__main__":
    main()
