"""playbyear-find-microphones: which sound cards there are, and what they hear.

Listens to each card in turn, shows how loud each of its channels is, and writes a WAV file.
docs/microphones.md says which microphones to buy and where to put them.

    playbyear-find-microphones
    playbyear-find-microphones --list=true

  --list=false                 only list them
  --seconds=3.0                for how long to listen to each [s]
  --output_dir=outputs/microphones  where the WAV files are written

Each card is printed with the entry of --robot.cameras that chooses it, for lerobot-record,
lerobot-teleoperate and lerobot-rollout.
"""

from lerobot_playbyear.scripts.command import run_alone, run_command


def main() -> None:
    """The command."""
    run_command("playbyear-find-microphones", __doc__, _find)


def _find() -> None:
    from lerobot_playbyear.datasets.errors import errors_of_input
    from lerobot_playbyear.microphones.finding import find_microphones

    with errors_of_input(OSError):
        run_alone(find_microphones)


if __name__ == "__main__":
    main()
