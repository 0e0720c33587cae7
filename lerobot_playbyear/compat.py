"""Everything borrowed from the inside of LeRobot, torch and their kin: what no release promises to keep.

Where a version changes, look here first. `BORROWED` says of each thing where it is, the version that it was seen in, and what
no longer works without it. Functions are imported from here by their name, and found when they are:

    from lerobot_playbyear.compat import update_policy

What lives on other people's objects has a function of its own at the end. Ordinary imports of documented names stay where they
are used. This module imports neither LeRobot nor torch.
"""

import inspect
from dataclasses import dataclass
from importlib import import_module, metadata
from operator import attrgetter
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata
    from lerobot.datasets.dataset_writer import DatasetWriter
    from lerobot.teleoperators.gamepad import GamepadTeleop
    from lerobot.teleoperators.keyboard import KeyboardTeleop
    from torch import Tensor


class CompatError(ImportError):
    """Something borrowed is gone; the message says what, from where, and what does not work without it."""


@dataclass(frozen=True)
class Borrowed:
    """A thing that another distribution never promised.

    Args:
        where: `module:name`.
        seen_in: The distribution and the version that it was seen in.
        breaks: What does not work without it.
        says: Words in its source. Of a method that we override: that it is called; of an attribute: that there is one.
    """

    where: str
    seen_in: str
    breaks: str
    says: str = ""

    def load(self) -> Any:
        """The thing itself.

        Raises:
            CompatError: It is not there, or no longer does what we hold on to.
        """
        module, _, name = self.where.partition(":")
        try:
            found = attrgetter(name)(import_module(module))
        except (ImportError, AttributeError) as error:
            raise CompatError(self._complaint(f"there is no {self.where} ({error})")) from error
        if self.says and self.says not in inspect.getsource(found):
            raise CompatError(self._complaint(f"{self.where} does nothing with `{self.says}`"))
        return found

    def _complaint(self, what: str) -> str:
        distribution = self.seen_in.split()[0]
        return (
            f"In {distribution} {metadata.version(distribution)} {what}, as there was in {self.seen_in}. Without it: "
            f"{self.breaks}. Install the versions of constraints.txt, or adapt lerobot_playbyear/compat.py."
        )


def _lerobot(where: str, breaks: str, says: str = "") -> Borrowed:
    return Borrowed(f"lerobot.{where}", "lerobot 0.6.1", breaks, says)


def _torch(where: str, breaks: str) -> Borrowed:
    return Borrowed(f"torch:{where}", "torch 2.11.0", breaks)


_TRAINS = "playbyear-train and playbyear-dagger cannot"
_PAD = "a gamepad that is not plugged in is not noticed"

BORROWED = {
    # Functions of LeRobot's commands
    "update_policy": _lerobot("scripts.lerobot_train:update_policy", f"{_TRAINS} learn"),
    "eval_policy_all": _lerobot("scripts.lerobot_eval:eval_policy_all", f"{_TRAINS} evaluate"),
    "get_step_checkpoint_dir": _lerobot("common.train_utils:get_step_checkpoint_dir", f"{_TRAINS} name a checkpoint"),
    "get_step_identifier": _lerobot("common.train_utils:get_step_identifier", f"{_TRAINS} name a film"),
    "load_training_state": _lerobot("common.train_utils:load_training_state", f"{_TRAINS} resume"),
    "save_checkpoint": _lerobot("common.train_utils:save_checkpoint", f"{_TRAINS} save"),
    "update_last_checkpoint": _lerobot("common.train_utils:update_last_checkpoint", f"{_TRAINS} save"),
    "WandBLogger": _lerobot("common.wandb_utils:WandBLogger", f"{_TRAINS} report to W&B"),
    # Methods and arguments of ours that LeRobot has to call and to give
    "_save_pretrained": _lerobot(
        "policies.pretrained:PreTrainedPolicy.save_pretrained",
        "policies on a GPU cannot be saved: their LSTM's weights are views of one buffer",
        says="self._save_pretrained(",
    ),
    "_load_as_safetensor": _lerobot(
        "policies.pretrained:PreTrainedPolicy.from_pretrained",
        "weights that a checkpoint lacks stay at random without a word",
        says="cls._load_as_safetensor(",
    ),
    "generate_model_card": _lerobot(
        "policies.pretrained:PreTrainedPolicy.push_model_to_hub",
        "a policy's card does not say what it hears",
        says="self.generate_model_card(",
    ),
    "set_dataset_feature_metadata": _lerobot(
        "policies.factory:make_policy",
        "the policy does not take its sample rate from the dataset",
        says="set_dataset_feature_metadata(ds_meta.features)",
    ),
    "dataset_meta": _lerobot(
        "policies.factory:make_policy",
        "lerobot-train takes a dataset of another frame rate without a word",
        says='kwargs["dataset_meta"] = ds_meta',
    ),
    "__get_path_fields__": _lerobot(
        "configs.parser:wrap",
        "playbyear-dagger and playbyear-video do not take --policy.path",
        says="argtype.__get_path_fields__()",
    ),
    # Attributes of LeRobot's objects
    "_metadata_buffer": _lerobot(
        "datasets.dataset_metadata:LeRobotDatasetMetadata",
        "an episode that could not be saved leaves a row in the dataset",
        says="self._metadata_buffer.clear()",
    ),
    "_streaming_encoder": _lerobot(
        "datasets.dataset_writer:DatasetWriter",
        "an episode that was filmed while it came in is lost when its saving fails",
        says="self._streaming_encoder.finish_episode()",
    ),
    "current_pressed": _lerobot(
        "teleoperators.keyboard:KeyboardTeleop", "held keys are forgotten at every step", says="self.current_pressed["
    ),
    "gamepad": _lerobot("teleoperators.gamepad:GamepadTeleop", _PAD, says="self.gamepad = "),
    "running": _lerobot("teleoperators.gamepad.gamepad_utils:GamepadController", _PAD, says="self.running = False"),
    # torch
    "reorder_convolution_weight": _torch("ops.mkldnn._reorder_convolution_weight", "no policy acts on a CPU"),
    "convolution_pointwise": _torch("ops.mkldnn._convolution_pointwise", "no policy acts on a CPU"),
    "convolution_pointwise_binary": _torch("ops.mkldnn._convolution_pointwise.binary", "no policy acts on a CPU"),
    "_version": _torch("Tensor._version", "a policy goes on acting by weights from before an update"),
    # Others
    "BasicBlock": Borrowed(
        "torchvision.models.resnet:BasicBlock", "torchvision 0.26.0", "the vision encoder cannot be built"
    ),
    "encode_choice": Borrowed(
        "draccus.parsers.encoding:encode_choice", "draccus 0.11.6", "a policy's configuration cannot be saved"
    ),
    "_GLOBAL_CLIENT_FACTORY": Borrowed(
        "huggingface_hub.utils._http:_GLOBAL_CLIENT_FACTORY",
        "huggingface_hub 1.33.0",
        "one lost request ends a download of hundreds",
    ),
}


def __getattr__(name: str) -> Any:
    if name not in BORROWED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return BORROWED[name].load()


def forget_unsaved_rows(meta: "LeRobotDatasetMetadata") -> None:
    """Of episodes that LeRobot has not written yet; it would write them when it closes the dataset."""
    meta._metadata_buffer.clear()


def streaming_encoder(writer: "DatasetWriter") -> Any:
    """What makes the films while an episode comes in, or None."""
    return writer._streaming_encoder


def set_streaming_encoder(writer: "DatasetWriter", encoder: Any) -> None:
    """Lets another take its place, which finishes, cancels and closes as LeRobot's does."""
    writer._streaming_encoder = encoder


def held_keys(teleop: "KeyboardTeleop") -> dict[Any, bool]:
    """The keyboard's keys and whether each is down; the teleoperator's own, which can be changed."""
    return teleop.current_pressed


def has_gamepad(teleop: "GamepadTeleop") -> bool:
    """Whether a gamepad is plugged in; LeRobot says that it is connected without one."""
    return getattr(teleop.gamepad, "running", True)


def n_changes(tensor: "Tensor") -> int:
    """How often a tensor was changed in place; -1 where torch does not count."""
    return -1 if tensor.is_inference() else tensor._version


def hub_client_factory() -> Any:
    """What makes the Hub's clients now; the library has a function to set it, and none to ask for it."""
    return __getattr__("_GLOBAL_CLIENT_FACTORY")
