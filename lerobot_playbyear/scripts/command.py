"""What every command does around its work: answer at once what needs no imports, read its options, say what went wrong."""

import contextlib
import difflib
import functools
import inspect
import io
import json
import logging
import os
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from lerobot_playbyear.datasets.errors import InputError, PlaybyearError, errors_of_input, printable
from lerobot_playbyear.training.command_line import given_options

HELP = Path(__file__).with_name("help")
"""The folder of what `--help` prints, a file for each command."""

OPTIONS_FILE = Path(__file__).with_name("options.json")
"""The names of all options of each command; `python tools/list_options.py` writes it."""


def command(
    interrupted: int | str = 130, flag: str = "", is_file_work: bool = False, words: tuple[str, ...] = ()
) -> Callable[[Callable[[], object]], Callable[[], None]]:
    """Decorates a function that imports what it needs and does a command's work, and has the command's name.

    What needs no imports is answered at once, and what cannot be done is said in one line.

    Args:
        interrupted: What Ctrl-C ends it with: an exit status, or what is to be said.
        flag: An option that needs no value.
        is_file_work: Whether all that it does is to read and write files: what these raise is then said in one line, too.
        words: The options that its first words stand for, `playbyear-reproduce merge FOLDER`.
    """

    def decorate(work: Callable[[], object]) -> Callable[[], None]:
        @functools.wraps(work)
        def run() -> None:
            _prepare_console()
            sys.argv[1:] = [f"{option}=true" if option == flag else option for option in sys.argv[1:]]
            for i, name in enumerate(words[: len(sys.argv) - 1], 1):
                if sys.argv[i].startswith("-"):
                    break
                sys.argv[i] = f"--{name}={sys.argv[i]}"
            answer_at_once(f"playbyear-{work.__name__.replace('_', '-')}")
            from draccus.utils import ParsingError

            said = (OSError, ValueError) if is_file_work else ()
            try:
                with own_temporary_folder():
                    work()
            except ParsingError as error:
                sys.exit(f"error: {printable(_reason(error))}")
            except (PlaybyearError, MemoryError, *said) as error:
                sys.exit(f"error: {printable(error) or 'there is not enough memory'}")
            except KeyboardInterrupt:
                sys.exit(interrupted)

        return run

    return decorate


def _prepare_console() -> None:
    """A letter that the terminal lacks, and in the log what would command it, are shown as escapes."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    logging.setLogRecordFactory(_PrintableRecord)
    os.environ.setdefault("NO_COLOR", "1")  # LeRobot's colours are such commands, too


class _PrintableRecord(logging.LogRecord):
    """A line of the log; what it says may be a stranger's."""

    def getMessage(self) -> str:  # noqa: N802  (as logging has it)
        return printable(super().getMessage())


@contextlib.contextmanager
def own_temporary_folder() -> Iterator[None]:
    """What a command writes into the system's temporary folder goes with it: LeRobot leaves a file there of each policy's
    configuration that it reads. What torch compiles stays where it looks for it again.

    Raises:
        InputError: Nothing can be written there.
    """
    before = tempfile.tempdir
    try:
        system = tempfile.gettempdir()
        own = tempfile.TemporaryDirectory(prefix="playbyear-", ignore_cleanup_errors=True)
    except OSError as error:
        raise InputError(
            f"The system's temporary folder cannot be written: {error}. Make room there, or name another: TMPDIR=..."
        ) from error
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", f"{system}/torchinductor_{getattr(os, 'getuid', int)()}")
    with own as folder:
        tempfile.tempdir = folder
        try:
            yield
        finally:
            tempfile.tempdir = before


def _reason(error: BaseException) -> BaseException:
    """Why draccus refuses options: where their own class refuses them, it names the class, and hides what that says."""
    causes = [error]
    while causes[-1].__cause__ is not None:
        causes.append(causes[-1].__cause__)
    refusals = (cause for cause in causes if str(cause).startswith("Couldn't instantiate class"))
    return next((refusal.__cause__ for refusal in refusals if refusal.__cause__), error)


def short_help(command: str) -> str:
    """What `playbyear-... --help` prints."""
    return (HELP / f"{command}.txt").read_text()


def _print_to_a_reader(text: str) -> None:
    """Prints what may be read to its beginning only, as `head` does."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more at its end


def answer_at_once(command: str) -> None:
    """Prints the help, or which option there is not, and ends the process; otherwise does nothing.

    `--help=all` becomes `--help`, which the full parser answers.
    """
    args = sys.argv[1:]
    if "--help=all" in args:
        sys.argv[1:] = [*(argument for argument in args if argument != "--help=all"), "--help"]
        return
    if "--help" in args or "-h" in args:
        _print_to_a_reader(short_help(command).strip())
        sys.exit(0)
    if (lerobots := for_robots(command, args)) is not None:
        print(f"error: {lerobots}", file=sys.stderr)
        sys.exit(2)
    listed = json.loads(OPTIONS_FILE.read_text())
    if metadata.version("lerobot") != listed["lerobot"]:
        return  # another version may have other options
    wrong = find_mistake(args, listed[command], listed["policies"])
    if wrong is not None:
        print(f"error: {wrong}\n`{command} --help` shows the options that matter.", file=sys.stderr)
        sys.exit(2)


_DATA = "--dataset.repo_id=... --dataset.root=... --dataset.push_to_hub=false --dataset.video=false"
_ON_ROBOTS = {
    "playbyear-record": f"lerobot-record {{}} {_DATA} --dataset.single_task=... --dataset.fps=20",
    "playbyear-dagger": "lerobot-rollout --strategy.type=dagger --strategy.record_autonomous=true "
    f"--strategy.upload_every_n_episodes=1000000 {{}} --policy.path=... --fps=20 --task=... {_DATA} --dataset.fps=20",
    "playbyear-video": "lerobot-rollout {} --policy.path=... --fps=20 --duration=60",
}
"""What LeRobot's command does on a robot, by ours that does it in a simulation; the robot's options stand in braces."""

_MICROPHONE = "gripper: {type: microphone, device: USB Audio}"
_ROBOT = {
    "robot.type": "so101_follower",
    "robot.port": "/dev/ttyACM0",
    "robot.cameras": "",
    "teleop.type": "so101_leader",
    "teleop.port": "/dev/ttyACM1",
}


def for_robots(command: str, args: list[str]) -> str | None:
    """What to tell who gives a robot, or what moves one, to a command for simulations; None for all others."""
    all_given, _ = given_options(args)
    given = {name: value for name, value in all_given.items() if name.partition(".")[0] in ("robot", "teleop")}
    if command not in _ON_ROBOTS or not given:
        return None
    cameras = (given.get("robot.cameras") or "").strip().removeprefix("{").removesuffix("}")
    if "microphone" not in cameras:
        cameras = f"{cameras}, {_MICROPHONE}" if cameras else _MICROPHONE
    options = {**_ROBOT, **given, "robot.cameras": f"{{{cameras}}}"}
    robot = shlex.join(f"--{name}={value}" for name, value in options.items())
    after = {"playbyear-video": "", "playbyear-dagger": "playbyear-dagger --num_episodes=0 --steps=1000 ..."}
    learns = after.get(command, "playbyear-train --preset=cpu ...")
    then = f"\nThen: playbyear-attach-audio --dataset.repo_id=... --dataset.root=..., and {learns}" if learns else ""
    return (
        f"--{next(iter(given))}: {command} works in simulations. On a robot use LeRobot's command, with the microphone "
        f"among the cameras (docs/tutorials/so101.md):\n{_ON_ROBOTS[command].format(robot)}{then}\n"
        "A person moves a simulated arm with --expert.type=teleop --expert.teleop.type=..."
    )


def find_mistake(args: list[str], listed: Mapping[str, Any], policies: Mapping[str, Any]) -> str | None:
    """What the full parser would certainly refuse of the names of options; None where nothing is certain.

    Args:
        args: The command line.
        listed: The command's `options`, its `required` ones, and the groups that are `open`: what they hold depends on a
            type, which plugins may add.
        policies: The options of the policies that are known here, by their type.
    """
    given, strays = given_options(args)
    if strays:
        return f"'{strays[0]}' is not an option: options begin with --."
    known, opened = set(listed["options"]), set(listed["open"])
    policy_type = given.get("policy.type") or ("playbyear" if given.get("preset") else "")
    if "policy" in opened and policy_type in policies and not given.keys() & {"policy.path", "config_path"}:
        opened.remove("policy")
        known.update(f"policy.{name}" for name in ("type", "path", *policies[policy_type]))
    for name, value in given.items():
        is_open = name.partition(".")[0] in opened or name.endswith("discover_packages_path")
        if name not in known and not is_open:
            near = difflib.get_close_matches(name, sorted(known), 1)
            return f"--{name} is not an option{f'; did you mean --{near[0]}?' if near else '.'}"
        if name in known and value is None:
            return f"--{name} needs a value, --{name}=..."
    if given.keys() & {"config_path", "resume"}:
        return None
    missing = [name for name in listed["required"] if name not in given and name.partition(".")[0] not in given]
    return f"--{missing[0]} is needed." if missing else None


def run_alone[Result](work: Callable[[Any], Result], parse: Callable[[type], Any] | None = None) -> Result:
    """Does the work of a command.

    Args:
        work: Takes an instance of the configuration that its argument is annotated with.
        parse: Reads the options for such a configuration. None: without LeRobot.

    Raises:
        InputError, draccus.ParsingError: An option has no meaning.
    """
    import draccus

    from lerobot_playbyear.hub.client import be_patient

    be_patient()
    (argument,) = inspect.signature(work).parameters.values()
    with errors_of_input(OSError):
        cfg = (parse or draccus.parse)(argument.annotation)
    return work(cfg)


def run_with_lerobot[Result](work: Callable[[Any], Result]) -> Result:
    """The same with LeRobot's parser, once LeRobot knows all plugins."""
    from draccus.utils import ParsingError
    from lerobot.configs import parser
    from lerobot.utils.import_utils import register_third_party_plugins

    def parse(kind: type) -> Any:
        def options(cfg: kind) -> Any:  # type: ignore[valid-type]
            return cfg

        said = io.StringIO()
        try:
            with contextlib.redirect_stderr(said):
                return parser.wrap()(options)()
        except SystemExit as end:
            if isinstance(end.__context__, ParsingError):  # LeRobot prints it, without its reason, and ends the process
                said.truncate(0)
                raise end.__context__ from end.__context__.__cause__
            raise
        finally:
            sys.stderr.write(said.getvalue())

    register_third_party_plugins()
    _check_saved_options(sys.argv[1:])
    return run_alone(work, parse)


def _check_saved_options(args: list[str]) -> None:
    """Whether the files of options that a command line names can be read; LeRobot does not say which one cannot.

    Raises:
        InputError: One of them is damaged.
    """
    from lerobot_playbyear.datasets.files import parse_json

    given, _ = given_options(args)
    for option, name in (("config_path", ""), ("policy.path", "config.json")):
        if not given.get(option):
            continue
        path = Path(str(given[option])) / name
        if path.suffix == ".json" and path.is_file():
            try:
                if not isinstance(parse_json(path.read_bytes()), dict):
                    raise ValueError("it holds no options")
            except ValueError as error:
                raise InputError(f"{path} is damaged: {error}. Put it back from a copy.") from error
