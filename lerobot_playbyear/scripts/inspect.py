"""playbyear-inspect: checks of a LeRobotDataset, and a page to see and hear every episode.

The exit status is 0, 1 if a check found an error, and 2 if there is no dataset to look at.

    playbyear-inspect --dataset.repo_id=me/demos --dataset.root=outputs/demos
    playbyear-inspect --dataset.repo_id=me/demos --html=outputs/demos.html
    playbyear-inspect --dataset.repo_id=me/demos --json > demos.json

  --dataset.repo_id=...        name of the dataset, user/name; needed
  --dataset.root=null          its folder; else LeRobot's cache, or the Hub
  --dataset.episodes=null      only these, like [0,1,2]
  --dataset.video_backend=pyav  LeRobot's video decoder, pyav or torchcodec
  --html=null                  also write a page to this file
  --picture_height=240         of the page's films [pixels], at most; less makes a smaller file
  --action_range=null          lowest and highest action allowed, like [-1,1]
  --json=false                 print the findings as JSON, and nothing else
"""

import logging
import sys

from lerobot_playbyear.scripts.command import run_alone, run_command


def main() -> None:
    """The command."""
    sys.argv[1:] = ["--json=true" if argument == "--json" else argument for argument in sys.argv[1:]]
    run_command("playbyear-inspect", __doc__, _inspect)


def _inspect() -> None:
    logging.basicConfig(level=logging.WARNING)
    from lerobot_playbyear.datasets.findings import worst
    from lerobot_playbyear.inspection.inspect import inspect
    from lerobot_playbyear.inspection.source import InspectionError

    try:
        findings = run_alone(inspect)
    except InspectionError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    sys.exit(worst(findings) == "error")


if __name__ == "__main__":
    main()
