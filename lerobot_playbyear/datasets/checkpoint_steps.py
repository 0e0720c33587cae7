"""What a checkpoint may have done before and after its network: it may be a stranger's, and LeRobot calls what it names."""

import contextlib
from pathlib import Path, PurePath

from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError
from safetensors import SafetensorError, safe_open

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import entries_below, is_special, parse_json

PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
"""LeRobot's names of the files."""


def check_steps(path: str | Path, revision: str | None = None) -> None:
    """Refuses a checkpoint whose processors name a class that is to be imported and called, as any program could be, or lack
    the numbers that they normalise with.

    Args:
        path: Its folder, or its name on the Hub.
        revision: On the Hub.

    Raises:
        InputError: One of its steps is not named as packages register them, or its file is missing or damaged.
    """
    for file in entries_below(Path(path)) if Path(path).is_dir() else ():
        if is_special(file):
            raise InputError(
                f"'{file}' is a pipe or a device; nothing was loaded. Copy the checkpoint again, with its files."
            )
    for name in PROCESSORS:
        file = Path(path) / name
        if not Path(path).is_dir():
            with contextlib.suppress(EntryNotFoundError):
                file = Path(hf_hub_download(str(path), name, revision=revision))
        if not file.is_file():
            continue  # LeRobot says so
        try:
            steps = parse_json(file.read_bytes())["steps"]
            strange = [step for step in steps if "class" in step or not isinstance(step["registry_name"], str)]
            states = [step["state_file"] for step in steps if "state_file" in step]
        except (ValueError, LookupError, TypeError) as error:
            raise InputError(f"{file} is not a processor of LeRobot's: {type(error).__name__}: {error}.") from error
        if strange:
            raise InputError(
                f"{file} has the step {strange[0]}, which is not registered by any package but names a class to import; "
                "nothing was loaded. Ask who made the checkpoint for steps with a registry_name."
            )
        for state in states if Path(path).is_dir() else ():
            _check_state(file, state)


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
