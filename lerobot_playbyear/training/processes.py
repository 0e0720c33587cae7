"""Several processes that learn together, as `accelerate launch` starts them: what each does of the work."""

from collections.abc import Mapping
from datetime import timedelta
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs, InitProcessGroupKwargs
from lerobot.configs import PreTrainedConfig
from torch import Tensor, distributed

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig

_DTYPES = {"bfloat16": "bf16", "float16": "fp16", "float32": "no"}
_PATIENCE = timedelta(days=7)  # others wait while one evaluates, decodes a dataset, or a person corrects


def make_accelerator(policy: PreTrainedConfig) -> Accelerator:
    """The Accelerator that lerobot-train makes for a policy: its device, its precision, and the processes launched."""
    mixed_precision = _DTYPES.get(getattr(policy, "dtype", ""))
    if not hasattr(policy, "dtype") and policy.use_amp:
        dtype = torch.get_autocast_dtype(torch.device(str(policy.device)).type)
        mixed_precision = {torch.bfloat16: "bf16", torch.float16: "fp16"}[dtype]
    handlers = [
        # Every parameter of ours is part of every update; of other policies, who knows.
        DistributedDataParallelKwargs(find_unused_parameters=not isinstance(policy, PlaybyearConfig)),
        InitProcessGroupKwargs(timeout=_PATIENCE),
    ]
    return Accelerator(
        step_scheduler_with_optimizer=False,
        mixed_precision=mixed_precision,
        cpu=policy.device == "cpu",
        kwargs_handlers=handlers,
    )


def share_of(accelerator: Accelerator, n: int) -> slice:
    """Which of the n items that all processes draw alike are this one's: every W-th of W processes.

    Raises:
        ValueError: They cannot be shared out evenly.
    """
    n_processes = accelerator.num_processes
    if n % n_processes:
        raise ValueError(
            f"{n} runs per update cannot be shared by {n_processes} processes: give a multiple of {n_processes}."
        )
    return slice(accelerator.process_index, None, n_processes)


def noise_seed(seed: int, process_index: int, step: int) -> int:
    """The seed of what a process of several draws by itself, such as augmentation, from an update on.

    Args:
        seed: Of the run.
        process_index: Of the process.
        step: Updates done before; a run that goes on draws other noise than at its begin.
    """
    if step == 0:
        return seed + process_index
    return int(np.random.SeedSequence([seed, process_index, step]).generate_state(1)[0])


class Orders:
    """What the first process tells the others: it alone has the data, and gives each its share of every batch.

    Args:
        accelerator: Of all processes.
    """

    def __init__(self, accelerator: Accelerator) -> None:
        self._accelerator = accelerator
        self._group = (
            distributed.new_group(backend="gloo", timeout=_PATIENCE) if accelerator.num_processes > 1 else None
        )

    def give(self, batch: Mapping[str, Any], **more: Any) -> dict[str, Any]:
        """Shares a batch out, of the first process, and whatever else the others need. Returns its own share."""
        if self._group is None:
            return dict(batch)
        n_processes = self._accelerator.num_processes
        shares = [{**more, "batch": _part(batch, slice(rank, None, n_processes))} for rank in range(n_processes)]
        self._scatter(shares)
        own: dict[str, Any] = shares[0]["batch"]
        return own

    def take(self) -> dict[str, Any] | None:
        """Waits for the next order, in another process; None when there are no more."""
        order: dict[str, Any] | None = self._scatter(None)
        if order is None:
            self._leave()
        return order

    def end(self) -> None:
        """There are no more."""
        if self._group is not None:
            self._scatter([None] * self._accelerator.num_processes)
            self._leave()

    def _leave(self) -> None:
        """All at once: gloo may hang where a group ends while another process still speaks."""
        distributed.barrier(self._group)
        self._accelerator.end_training()

    def _scatter(self, orders: list[Any] | None) -> Any:
        received: list[Any] = [None]
        distributed.scatter_object_list(received, orders, src=0, group=self._group)
        return received[0]


def _part(batch: Mapping[str, Any], share: slice) -> dict[str, Any]:
    """Some items of a batch, on the host; what is no tensor or list is the same for all."""
    own: dict[str, Any] = {}
    for key, value in batch.items():
        if isinstance(value, Tensor):
            own[key] = value[share].cpu().clone()
        else:
            own[key] = value[share] if isinstance(value, list) else value
    return own
