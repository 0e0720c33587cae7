"""The commands: what each imports when it is called, and what it does. Their help is in `help/`."""

import logging
import sys

from lerobot_playbyear.datasets.errors import printable
from lerobot_playbyear.scripts.command import command, run_alone, run_with_lerobot


@command("Interrupted. The saved episodes are safe; --resume=true --dataset.num_episodes=N records N more.")
def record() -> None:
    # Here, because the processes that roll out import this module, and start in 2 seconds without LeRobot.
    from lerobot_playbyear.recording.record import record

    run_with_lerobot(record)


@command("Interrupted. Go on from the last checkpoint with --resume=true --config_path=<its train_config.json>.")
def train() -> None:
    from lerobot_playbyear.training.command_line import apply_preset, with_long_store

    sys.argv[1:] = apply_preset(with_long_store(sys.argv[1:]))
    from lerobot_playbyear.training.train import train

    run_with_lerobot(train)


@command("Interrupted. Go on with --resume=true and the same --output_dir.")
def dagger() -> None:
    from lerobot_playbyear.dagger.config import with_saved_options
    from lerobot_playbyear.dagger.run import run_dagger
    from lerobot_playbyear.teleoperation import config as _teleop  # noqa: F401  (registers --expert.type=teleop)
    from lerobot_playbyear.training.command_line import with_long_store

    sys.argv[1:] = with_saved_options(with_long_store(sys.argv[1:]))
    run_with_lerobot(run_dagger)


@command(is_file_work=True)
def video() -> None:
    logging.basicConfig(level=logging.WARNING)
    from lerobot_playbyear.film.rollout_film import film

    run_with_lerobot(film)


@command(flag="--json")
def inspect() -> None:
    logging.basicConfig(level=logging.WARNING)
    from lerobot_playbyear.datasets.errors import InputError
    from lerobot_playbyear.datasets.findings import worst
    from lerobot_playbyear.inspection.inspect import inspect

    try:
        findings = run_alone(inspect)
    except InputError as error:
        print(f"error: {printable(error)}", file=sys.stderr)
        sys.exit(2)
    sys.exit(worst(findings) == "error")


@command(is_file_work=True)
def repair() -> None:
    from lerobot_playbyear.repair.repair import repair

    try:
        report = run_alone(repair)
    except (OSError, MemoryError) as error:
        sys.exit(
            f"error: {printable(error) or 'there is not enough memory'}\n"
            "Nothing was changed. A file cannot be read or written now, which is not damage. Try again later."
        )
    sys.exit(0 if report.is_done else 1)


@command("Interrupted. The same command goes on.", words=("action", "folder"))
def reproduce() -> None:
    from lerobot_playbyear.reproduce.run import reproduce

    run_alone(reproduce)


@command(is_file_work=True)
def attach_audio() -> None:
    from lerobot_playbyear.audio.attach_audio import attach_audio

    run_alone(attach_audio)


@command(is_file_work=True)
def attach_spectrogram() -> None:
    from lerobot_playbyear.audio.attach_spectrogram import attach_spectrogram

    run_alone(attach_spectrogram)


@command(is_file_work=True)
def find_microphones() -> None:
    from lerobot_playbyear.microphones.finding import find_microphones

    run_alone(find_microphones)


@command("Interrupted. The same command goes on; what has arrived is not sent again.")
def push() -> None:
    logging.basicConfig(level=logging.WARNING)
    from lerobot_playbyear.hub.push import push

    run_alone(push)
