"""What a checkpoint may have done before and after its network: it may be a stranger's, and LeRobot calls what it names."""

from inspect import signature
from pathlib import Path, PurePath

from huggingface_hub import hf_hub_download
from huggingface_hub.errors import RemoteEntryNotFoundError
from safetensors import SafetensorError, safe_open

from lerobot_playbyear.datasets.errors import InputError, first_line
from lerobot_playbyear.datasets.files import entries_below, is_special, parse_json

PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
"""LeRobot's names of the files."""

RUN_PROGRAMS = ("gaussian_actor", "groot", "pi0_fast", "wall_x")
"""LeRobot's policies that fetch programs from the Hub and run them."""


def check_type(kind: str) -> None:
    """Refuses a policy that runs programs which its checkpoint names.

    Raises:
        InputError: It does.
    """
    if kind in RUN_PROGRAMS:
        raise InputError(
            f"Policies of type {kind} run programs from the Hub; nothing was loaded. Use LeRobot's own commands."
        )


def check_steps(path: str | Path, revision: str | None = None) -> None:
    """Refuses a checkpoint whose processors name a class that is to be imported and called, as any program could be, or lack
    the numbers that they normalise with.

    Args:
        path: Its folder, or its name on the Hub.
        revision: On the Hub.

    Raises:
        InputError: One of its steps is not named as packages register them, or runs programs from the Hub; or its file is
            missing or damaged, or cannot be had now.
    """
    for file in entries_below(Path(path)) if Path(path).is_dir() else ():
        if is_special(file):
            raise InputError(f"'{file}' is a pipe or a device; nothing was loaded. Copy the checkpoint again.")
    for name in PROCESSORS:
        file = Path(path) / name
        if not Path(path).is_dir():
            try:
                file = Path(hf_hub_download(str(path), name, revision=revision))
            except RemoteEntryNotFoundError:
                continue
            except Exception as error:  # the Hub's or the network's
                told = f"{name} of '{path}' cannot be had from the Hub now ({first_line(error)}): nothing was loaded."
                raise InputError(f"{told} Try again later, or correct the name.") from error
        if not file.is_file():
            continue  # LeRobot says so
        try:
            steps = parse_json(file.read_bytes())["steps"]
            strange = [step for step in steps if "class" in step or not _is_harmless(step["registry_name"])]
            states = [step["state_file"] for step in steps if "state_file" in step]
        except (ValueError, LookupError, TypeError) as error:
            raise InputError(f"{file} is not a processor of LeRobot's: {type(error).__name__}: {error}.") from error
        if strange:
            raise InputError(
                f"{file} has the step {strange[0]}, which names a class to import or runs programs from the Hub; nothing was "
                "loaded. Ask who made the checkpoint for steps with a registry_name, and without programs."
            )
        for state in states if Path(path).is_dir() else ():
            _check_state(file, state)


def _is_harmless(name: object) -> bool:
    from lerobot.processor import ProcessorStepRegistry

    if not isinstance(name, str):
        return False
    is_known = name in ProcessorStepRegistry.list()  # of one that is not LeRobot says so
    return not is_known or "trust_remote_code" not in signature(ProcessorStepRegistry.get(name)).parameters


def _check_state(file: Path, state: object) -> None:
    """Looks at what a step keeps beside the processor that names it."""
    try:
        if not isinstance(state, str) or PurePath(state).name != state:
            raise OSError("it is not the name of a file beside it")
        with safe_open(file.with_name(state), "numpy"):
            pass
    except (OSError, SafetensorError) as error:
        raise InputError(
            f"{file} names {state!r}, which cannot be read: {error}. Copy the checkpoint again, with all its files."
        ) from error
