"""playbyear-repair: checks a local LeRobotDataset v3.0 for damage, and writes a repaired copy.

Every complete episode is kept bit for bit in the copy; the dataset itself stays as it is. The exit
status is 1 where damage is left.

    playbyear-repair --root=outputs/demos                  # after a recording that was killed
    playbyear-repair --root=outputs/demos --dry_run=true   # only looks

  --root=...                   the dataset's folder; needed
  --output=null                the copy's; else the dataset's with _repaired behind it
  --dry_run=false              only say what is wrong
  --like=null                  a dataset recorded with the same settings; needed only where
                               meta/info.json is lost
"""

import sys

from lerobot_playbyear.scripts.command import run_alone, run_command


def main() -> None:
    """The command; it fails where damage is left."""
    run_command("playbyear-repair", __doc__, _repair)


def _repair() -> None:
    from lerobot_playbyear.datasets.errors import errors_of_input
    from lerobot_playbyear.repair.repair import repair

    with errors_of_input():
        try:
            report = run_alone(repair)
        except (OSError, MemoryError) as error:
            sys.exit(
                f"error: {str(error) or 'there is not enough memory'}\n"
                "Nothing was changed: that something cannot be read or written now is no damage. Try again when it can."
            )
    sys.exit(0 if report.is_done else 1)


if __name__ == "__main__":
    main()
