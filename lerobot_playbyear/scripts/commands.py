"""The commands: what each imports when it is called, and what it does. Their help is in `help/`."""

import sys
from collections.abc import Callable
from pkgutil import resolve_name
from typing import Any

from lerobot_playbyear.datasets.errors import InputError, printable
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
    from lerobot_playbyear.film.rollout_film import film

    run_with_lerobot(film)


@command(flag="--json")
def inspect() -> None:
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


def _work_of(where: str, **options: Any) -> Callable[[], None]:
    """A command that does the work of a function, `module:name`, and nothing else; it has the function's name."""

    def work() -> None:
        run_alone(resolve_name(f"lerobot_playbyear.{where}"))

    work.__name__ = where.rpartition(":")[2]
    return command(**options)(work)


attach_audio = _work_of("audio.attach_audio:attach_audio", is_file_work=True)
attach_spectrogram = _work_of("audio.attach_spectrogram:attach_spectrogram", is_file_work=True)
find_microphones = _work_of("microphones.finding:find_microphones", is_file_work=True)
push = _work_of("hub.push:push", interrupted="Interrupted. The same command goes on; what arrived is not sent again.")
reproduce = _work_of(
    "reproduce.run:reproduce", interrupted="Interrupted. The same command goes on.", words=("action", "folder")
)
