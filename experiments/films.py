"""Films with sound, one each: a success, a deaf policy's failure, and a contact that is played where there is none.

    python -m experiments.films --output=docs/media

takes the first training seed's policies of `experiments.ablations` on Occluded Grasp and the first evaluation seeds.
"""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import gymnasium as gym
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.import_utils import register_third_party_plugins

from experiments.ablations import STUDY
from experiments.protocol import DONOR_SEEDS, EVALUATION_SEEDS, N_DEMONSTRATIONS, STEPS, TRAINING_SEEDS
from experiments.sound_probe import SoundProbe, make_donors
from experiments.training import Job
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.episodes.acting import load_for_rollout
from lerobot_playbyear.film.takes import policy_takes, write_take
from lerobot_playbyear.recording.record import env_spec

TASK = "OccludedGrasp-v0"


def film(condition: str, make: Callable[[], gym.Env], wanted: Callable[[bool, gym.Env], bool], path: Path) -> None:
    """Films the first episode of the evaluation seeds that is as wanted."""
    env_cfg = PlaybyearEnvConfig(task=TASK)
    checkpoint = Job(STUDY, TASK, condition, TRAINING_SEEDS[0], N_DEMONSTRATIONS, STEPS[TASK]).checkpoint
    policy_cfg = PreTrainedConfig.from_pretrained(checkpoint)
    policy_cfg.pretrained_path = checkpoint
    envs = SyncVectorEnv([freeze_after_episode_end(make)], autoreset_mode=AutoresetMode.SAME_STEP)
    try:
        for take in policy_takes(envs, load_for_rollout(policy_cfg, env_cfg), EVALUATION_SEEDS):
            if wanted(take.success, envs.envs[0]):
                write_take(take, path, env_cfg.fps)
                print(f"{path}: seed {take.seed}, {'success' if take.success else 'failure'}")
                return
    finally:
        envs.close()
    raise RuntimeError(f"No episode for {path.name} in {len(EVALUATION_SEEDS)} seeds.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/media"))
    output = parser.parse_args().output
    register_third_party_plugins()

    spec = env_spec(PlaybyearEnvConfig(task=TASK))
    make = partial(gym.make, spec.id, disable_env_checker=True, **spec.kwargs)
    env = make()
    donors = make_donors(env, DONOR_SEEDS)
    env.close()
    film("full", make, lambda success, env: success, output / "success.mp4")
    film("deaf", make, lambda success, env: not success, output / "deaf.mp4")
    film(
        "full",
        lambda: SoundProbe(make(), "false", donors),
        lambda success, env: env.get_wrapper_attr("trial").closed_there,
        output / "false_contact.mp4",
    )


if __name__ == "__main__":
    main()
