"""Everything borrowed from the inside of LeRobot, torch and their kin: what no release promises to keep.

Where a version changes, look here first. `BORROWED` says of each thing where it is and what no longer works without it.
Functions are imported from here by their name, and found when they are:

    from lerobot_playbyear.compat import save_checkpoint

What lives on other people's objects has a function of its own at the end; what LeRobot has to do with ours stands in
`tests/test_compat.py`. Ordinary imports of documented names stay where they are used. This module imports neither LeRobot nor
torch.
"""

from collections.abc import Callable
from contextlib import suppress
from copy import copy
from importlib import import_module, metadata
from inspect import signature
from pkgutil import iter_modules, resolve_name
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from types import ModuleType

    from accelerate import Accelerator
    from huggingface_hub import ModelCard
    from lerobot.configs import PreTrainedConfig
    from lerobot.teleoperators.gamepad import GamepadTeleop
    from lerobot.utils.logging_utils import MetricsTracker
    from torch import Tensor


class CompatError(ImportError):
    """Something borrowed is gone; the message says what, from where, and what does not work without it."""


_TRAINS = "playbyear-train and playbyear-dagger cannot"
_ACTS = "no policy acts on a CPU"

BORROWED = {
    "eval_policy_all": ("lerobot.scripts.lerobot_eval:eval_policy_all", f"{_TRAINS} evaluate"),
    "get_step_checkpoint_dir": ("lerobot.common.train_utils:get_step_checkpoint_dir", f"{_TRAINS} name a checkpoint"),
    "get_step_identifier": ("lerobot.common.train_utils:get_step_identifier", f"{_TRAINS} name a film"),
    "save_checkpoint": ("lerobot.common.train_utils:save_checkpoint", f"{_TRAINS} save"),
    "WandBLogger": ("lerobot.common.wandb_utils:WandBLogger", f"{_TRAINS} report to W&B"),
    "reorder_convolution_weight": ("torch:ops.mkldnn._reorder_convolution_weight", _ACTS),
    "convolution_pointwise": ("torch:ops.mkldnn._convolution_pointwise", _ACTS),
    "convolution_pointwise_binary": ("torch:ops.mkldnn._convolution_pointwise.binary", _ACTS),
    "BasicBlock": ("torchvision.models.resnet:BasicBlock", "the vision encoder cannot be built"),
    "encode_choice": ("draccus.parsers.encoding:encode_choice", "a policy's configuration cannot be saved"),
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
            f"In {distribution} {metadata.version(distribution)} there is no {where} ({error}). Without it: {breaks}. Install "
            "the versions of constraints.txt, or adapt lerobot_playbyear/compat.py."
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


def save_checkpoint(accelerator: "Accelerator", cfg: Any, **what: Any) -> None:
    """LeRobot's. It notes how many processes learned, each from how many windows, which lerobot-train resumes from.

    Args:
        accelerator: Of the processes. LeRobot does not get it: it would wait for all of them, and one saves.
        cfg: The options of the run.
        what: Further arguments, which every version takes.
    """
    save = __getattr__("save_checkpoint")
    if "num_processes" in signature(save).parameters:  # LeRobot 0.6.1
        what |= {"num_processes": accelerator.num_processes, "batch_size": cfg.batch_size}
    else:  # it reads them in the options
        cfg.parallelism.dp_replicate = accelerator.num_processes
    save(cfg=cfg, **what)


def metrics_tracker(accelerator: "Accelerator | None", *figures: Any, initial_step: int) -> "MetricsTracker":
    """LeRobot's `MetricsTracker`, of an accelerator's processes; None: of this one."""
    from lerobot.utils.logging_utils import MetricsTracker

    processes: dict[str, Any] = {"accelerator": accelerator}
    if "accelerator" not in signature(MetricsTracker).parameters:  # it has them in LeRobot 0.6.1
        processes = {"dp_world_size": 1 if accelerator is None else accelerator.num_processes}
    return MetricsTracker(*figures, initial_step=initial_step, **processes)


def card_writer(policy: Any, config: "PreTrainedConfig") -> "Callable[..., ModelCard]":
    """What writes LeRobot's card of a policy: its method, or where policies have none, a function that takes the same.

    Args:
        policy: The policy; `super()` in a method of its own of that name.
        config: Its configuration.
    """
    method: Callable[..., ModelCard] | None = getattr(policy, "generate_model_card", None)  # LeRobot 0.6.1
    if method is not None:
        return method
    generate = load("lerobot.common.train_utils:generate_model_card", "no policy gets a card")

    def write(
        dataset_repo_id: str | None, model_type: str, license: Any, tags: Any, cfg: Any = None, dataset_meta: Any = None
    ) -> "ModelCard":
        described: Any = copy(config)
        described.license, described.tags = license, tags
        card: ModelCard = generate(described, cfg=cfg, dataset_meta=dataset_meta)
        card.data["datasets"] = dataset_repo_id
        return card

    return write


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
