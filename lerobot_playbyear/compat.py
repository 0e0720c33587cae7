"""Everything borrowed from the inside of LeRobot, torch and their kin: what no release promises to keep.

Where a version changes, look here first. `BORROWED` says of each thing where it is and what no longer works without it.
Functions are imported from here by their name, and found when they are:

    from lerobot_playbyear.compat import save_checkpoint

What lives on other people's objects has a function of its own at the end; what LeRobot has to do with ours stands in
`tests/test_compat.py`. Ordinary imports of documented names stay where they are used. This module imports neither LeRobot nor
torch.
"""

from contextlib import suppress
from importlib import import_module, metadata
from pkgutil import iter_modules, resolve_name
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from types import ModuleType

    from lerobot.datasets import LeRobotDatasetMetadata
    from lerobot.teleoperators.gamepad import GamepadTeleop
    from lerobot.teleoperators.keyboard import KeyboardTeleop
    from torch import Tensor


SEEN_IN = {
    "lerobot": "0.6.1",
    "torch": "2.11.0",
    "torchvision": "0.26.0",
    "draccus": "0.11.6",
    "huggingface_hub": "1.33.0",
}
"""The versions of the distributions in which all was as it is described here."""


class CompatError(ImportError):
    """Something borrowed is gone; the message says what, from where, and what does not work without it."""


_TRAINS = "playbyear-train and playbyear-dagger cannot"
_ACTS = "no policy acts on a CPU"

BORROWED = {
    "eval_policy_all": ("lerobot.scripts.lerobot_eval:eval_policy_all", f"{_TRAINS} evaluate"),
    "get_step_checkpoint_dir": ("lerobot.common.train_utils:get_step_checkpoint_dir", f"{_TRAINS} name a checkpoint"),
    "get_step_identifier": ("lerobot.common.train_utils:get_step_identifier", f"{_TRAINS} name a film"),
    "load_training_state": ("lerobot.common.train_utils:load_training_state", f"{_TRAINS} resume"),
    "save_checkpoint": ("lerobot.common.train_utils:save_checkpoint", f"{_TRAINS} save"),
    "update_last_checkpoint": ("lerobot.common.train_utils:update_last_checkpoint", f"{_TRAINS} save"),
    "WandBLogger": ("lerobot.common.wandb_utils:WandBLogger", f"{_TRAINS} report to W&B"),
    "reorder_convolution_weight": ("torch:ops.mkldnn._reorder_convolution_weight", _ACTS),
    "convolution_pointwise": ("torch:ops.mkldnn._convolution_pointwise", _ACTS),
    "convolution_pointwise_binary": ("torch:ops.mkldnn._convolution_pointwise.binary", _ACTS),
    "BasicBlock": ("torchvision.models.resnet:BasicBlock", "the vision encoder cannot be built"),
    "encode_choice": ("draccus.parsers.encoding:encode_choice", "a policy's configuration cannot be saved"),
    "_GLOBAL_CLIENT_FACTORY": (
        "huggingface_hub.utils._http:_GLOBAL_CLIENT_FACTORY",
        "one lost request ends a download of hundreds",
    ),
}
"""By the names that they have here: where things are, `module:name`, and what does not work without them."""


def load(where: str, breaks: str) -> Any:
    """A thing that another distribution never promised.

    Args:
        where: `module:name`.
        breaks: What does not work without it.

    Raises:
        CompatError: It is not there.
    """
    try:
        return resolve_name(where)
    except (ImportError, AttributeError) as error:
        distribution = where.replace(":", ".").partition(".")[0]
        raise CompatError(
            f"In {distribution} {metadata.version(distribution)} there is no {where} ({error}), as there was in {distribution} "
            f"{SEEN_IN[distribution]}. Without it: {breaks}. Install the versions of constraints.txt, or adapt "
            "lerobot_playbyear/compat.py."
        ) from error


def __getattr__(name: str) -> Any:
    if name not in BORROWED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return load(*BORROWED[name])


def import_devices(package: "ModuleType") -> None:
    """Imports a package's own packages, such as those of `lerobot.teleoperators`, so that the types in them are registered.

    One that cannot be imported, such as for want of its maker's software, is left out.
    """
    for module in iter_modules(package.__path__):
        if module.ispkg:
            with suppress(Exception):
                import_module(f"{package.__name__}.{module.name}")


def forget_unsaved_rows(meta: "LeRobotDatasetMetadata") -> None:
    """Of episodes that LeRobot has not written yet; it would write them when it closes the dataset."""
    meta._metadata_buffer.clear()


def held_keys(teleop: "KeyboardTeleop") -> dict[Any, bool]:
    """The keyboard's keys and whether each is down; the teleoperator's own, which can be changed."""
    return teleop.current_pressed


def has_gamepad(teleop: "GamepadTeleop") -> bool:
    """Whether a gamepad is plugged in; LeRobot says that it is connected without one."""
    return getattr(teleop.gamepad, "running", True)


def n_changes(tensor: "Tensor") -> int:
    """How often a tensor was changed in place; -1 where torch does not count."""
    return -1 if tensor.is_inference() else tensor._version


def look_for_cards_again(sounddevice: "ModuleType") -> None:
    """Lets PortAudio see what was plugged in since its first look. It closes all streams."""
    sounddevice._terminate()
    sounddevice._initialize()


def stream_kind(sounddevice: "ModuleType") -> type:
    """What all streams of the package sounddevice are."""
    return sounddevice._StreamBase


def hub_client_factory() -> Any:
    """What makes the Hub's clients now; the library has a function to set it, and none to ask for it."""
    return __getattr__("_GLOBAL_CLIENT_FACTORY")
