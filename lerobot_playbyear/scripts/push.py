"""playbyear-push: uploads a dataset or a policy to the Hub, with its card.

An upload that was interrupted goes on with the same command.

    playbyear-push --dataset.repo_id=me/demos --dataset.root=outputs/demos
    playbyear-push --policy.path=outputs/train --policy.repo_id=me/policy

  --dataset.repo_id=null       the dataset's name on the Hub, user/name
  --dataset.root=null          its folder; else LeRobot's cache
  --policy.path=null           a checkpoint's folder, or the output folder of a training
  --policy.repo_id=null        the policy's name on the Hub, user/name
  --private=null               whether a new repository is private; else the account's default.
                               With true nothing goes to one that is there and public
  --tags=null                  for the card, like [franka,glass], besides its own
  --license=null               as the Hub names licences; else the policy's own, or apache-2.0
  --preview=null               an mp4 for the card; else one is made of a dataset
"""

import logging

from lerobot_playbyear.scripts.command import run_alone, run_command


def main() -> None:
    """The command."""
    again = "Interrupted. The same command goes on; what has arrived is not sent again."
    run_command("playbyear-push", __doc__, _push, again)


def _push() -> None:
    logging.basicConfig(level=logging.WARNING)
    from lerobot_playbyear.hub.push import push

    run_alone(push)


if __name__ == "__main__":
    main()
