"""Films with sound, one each: a success, a deaf policy's failure, and a contact that is played where there is none.

    python -m experiments.films --output=docs/media

takes the first training seed's policies of `experiments.ablations` on Occluded Grasp and the first evaluation seeds.
"""

from collections.abc import Callable
from pathlib import Path

import gymnasium as gym

from experiments.ablations import STUDY
from experiments.listening import ENV, TASK, actor_of
from experiments.protocol import DONOR_SEEDS, EVALUATION_SEEDS, TRAINING_SEEDS, command_line
from experiments.sound_probe import SoundProbe, make_donors
from experiments.training import Job
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.film.rollout_film import write_episode_film


def film(condition: str, env: gym.Env, wanted: Callable[[bool], bool], path: Path) -> None:
    """Films the first episode of the evaluation seeds that is as wanted."""
    actor = actor_of(Job(STUDY, TASK, condition, TRAINING_SEEDS[0]).checkpoint)
    for seed in EVALUATION_SEEDS:
        episode = play(env, actor, seed, watch=env.render)
        if wanted(episode.success):
            write_episode_film(episode, path, ENV.fps)
            print(f"{path}: seed {seed}, {'success' if episode.success else 'failure'}")
            return
    raise RuntimeError(f"No episode for {path.name} in {len(EVALUATION_SEEDS)} seeds.")


def main() -> None:
    output = command_line(__doc__, "output").parse_args().output
    env = env_spec(ENV).make()
    probe = SoundProbe(env, "false", make_donors(env, DONOR_SEEDS))
    film("full", env, lambda success: success, output / "success.mp4")
    film("deaf", env, lambda success: not success, output / "deaf.mp4")
    film("full", probe, lambda success: probe.trial.closed_there, output / "false_contact.mp4")
    env.close()


if __name__ == "__main__":
    main()
