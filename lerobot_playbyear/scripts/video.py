"""playbyear-video: films an episode with its sound, a policy's or the scripted expert's.

    playbyear-video --policy.path=outputs/train/checkpoints/last/pretrained_model \\
        --env.type=playbyear --env.task=OccludedGrasp-v1 --output=outputs/rollout.mp4

  --env.type=...               the environment, like playbyear; needed
  --env.task=...               its task, such as OccludedGrasp-v1 or TellApart-v1
  --policy.path=...            who acts, a checkpoint's folder or a name on the Hub; else a script
  --baseline=null              without a policy, the environment's blind baseline of this name acts
  --output=outputs/rollout.mp4  the film, an mp4
  --seed=1000                  of the first episode
  --attempts=1                 episodes, at most, until one succeeds; the last one is filmed

--help=all lists all of LeRobot's options.
"""

import logging

from lerobot_playbyear.scripts.command import run_command, run_with_lerobot


def main() -> None:
    """The command."""
    run_command("playbyear-video", __doc__, _film)


def _film() -> None:
    logging.basicConfig(level=logging.WARNING)
    from lerobot_playbyear.datasets.errors import errors_of_input
    from lerobot_playbyear.film.rollout_film import film

    with errors_of_input(OSError):
        run_with_lerobot(film)


if __name__ == "__main__":
    main()
