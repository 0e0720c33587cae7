"""playbyear-push: uploads a dataset or a policy to the Hub, with its card.

An upload that was interrupted goes on with the same command.

    playbyear-push --dataset.repo_id=me/demos --dataset.root=outputs/demos
    playbyear-push --policy.path=outputs/train --policy.repo_id=me/policy

  --dataset.repo_id=null       the dataset's name on the Hub, user/name
  --dataset.root=null          its folder; else LeRobot's cache
  --policy.path=null           a checkpoint's folder, or the output folder of a training
  --policy.repo_id=null        the policy's name on the Hub, user/name
  --private=null               whether a new repository is private; else the account's default
  --tags=null                  for the card, like [franka,glass], besides its own
  --license=null               as the Hub names licences; else the policy's own, or apache-2.0
  --preview=null               an mp4 for the card; else one is made of a dataset
"""

import logging
import sys

from lerobot_playbyear.scripts.command import answer_at_once, read_options


def main() -> None:
    """The command."""
    answer_at_once("playbyear-push", __doc__)
    logging.basicConfig(level=logging.WARNING)
    from lerobot_playbyear.hub.uploads import HubError, PushConfig, push

    try:
        push(read_options(PushConfig))
    except HubError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("Interrupted. The same command goes on; what has arrived is not sent again.")


if __name__ == "__main__":
    main()
