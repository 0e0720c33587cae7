"""The figures of updates, between two lines of the log."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from lerobot.utils.logging_utils import AverageMeter
from torch import Tensor

from lerobot_playbyear.compat import metrics_tracker
from lerobot_playbyear.datasets.episode_store import EpisodeStore

if TYPE_CHECKING:
    from accelerate import Accelerator

_MOST_WAITING = 1000  # updates


class Figures:
    """Averages over updates. Numbers stay on the GPU until somebody reads them, so that no update waits for one.

    Args:
        batch_size: Items per update and process.
        store: What they are drawn from.
        step: Updates done before.
        accelerator: Of the processes whose figures are averaged; None: of this one alone.
    """

    def __init__(
        self, batch_size: int, store: EpisodeStore, step: int = 0, accelerator: "Accelerator | None" = None
    ) -> None:
        meters = {
            "loss": AverageMeter("loss", ":.3f", reduction="mean"),
            "grad_norm": AverageMeter("grdn", ":.3f"),
            "lr": AverageMeter("lr", ":0.1e"),
            "update_s": AverageMeter("updt_s", ":.3f", reduction="max"),
            "dataloading_s": AverageMeter("data_s", ":.3f", reduction="max"),
        }
        if torch.cuda.is_available():
            meters["gpu_mem_gb"] = AverageMeter("mem_gb", ":.2f")
        self._accelerator = accelerator
        self._tracker = metrics_tracker(
            accelerator, batch_size, len(store), store.n_episodes, meters, initial_step=step
        )
        self._waiting: list[Mapping[str, Any]] = []

    def add(self, figures: Mapping[str, Any]) -> None:
        """Those of one more update: numbers, or tensors of one number."""
        self._waiting.append(figures)
        self._tracker.step()
        if len(self._waiting) >= _MOST_WAITING:
            self._take_in()

    def read(self) -> tuple[dict[str, float], str]:
        """The averages since the last time, by name and as a line. Every process has to call it."""
        self._take_in()
        if self._accelerator is not None:
            self._tracker.reduce_across_ranks()
        figures, line = self._tracker.to_dict(), str(self._tracker)
        self._tracker.reset_averages()
        return figures, line

    def _take_in(self) -> None:
        tensors = [v.detach().float() for each in self._waiting for v in each.values() if isinstance(v, Tensor)]
        numbers = iter(torch.stack(tensors).tolist() if tensors else [])
        for each in self._waiting:
            values = {name: next(numbers) if isinstance(v, Tensor) else v for name, v in each.items()}
            for name in values.keys() & self._tracker.metrics.keys():
                self._tracker.metrics[name].update(values[name])
            self._tracker.update_metrics({name: v for name, v in values.items() if name not in self._tracker.metrics})
        self._waiting.clear()
