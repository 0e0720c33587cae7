"""The loss on held-out episodes: of which frames, and what it is."""

import torch
from lerobot.datasets import LeRobotDataset
from torch import Tensor

from lerobot_playbyear.datasets.episode_store import EpisodeStore
from lerobot_playbyear.datasets.parquet import column_to_numpy
from lerobot_playbyear.training.parts import TrainingParts
from lerobot_playbyear.training.windows import PolicyWindows


def first_of_each_task(dataset: LeRobotDataset, n_samples: int) -> Tensor | None:
    """The frames that `--max_eval_samples` leaves of held-out episodes, as lerobot-train chooses them.

    Args:
        dataset: Of the held-out episodes.
        n_samples: How many frames, shared evenly by the tasks, at least one of each; 0: all.

    Returns:
        (N,) bool, the first ones of each task; None where all frames count.
    """
    if n_samples <= 0:
        return None
    tasks = torch.from_numpy(column_to_numpy(dataset.hf_dataset.data.column("task_index")))
    kinds = tasks.unique()
    chosen = torch.zeros(len(tasks), dtype=torch.bool)
    for kind in kinds:
        chosen[(tasks == kind).nonzero().squeeze(1)[: max(1, n_samples // len(kinds))]] = True
    return chosen


def validation_loss(
    parts: TrainingParts,
    windows: PolicyWindows,
    store: EpisodeStore,
    batch_size: int,
    chosen: Tensor | None = None,
) -> float:
    """The mean loss over held-out episodes.

    Args:
        parts: With the policy.
        windows: Cut its batches.
        store: The episodes.
        batch_size: Runs at once.
        chosen: (N,) bool, the frames that count; None: all.
    """
    batches = validation_runs(store, windows.n_windows, chosen).split(batch_size)
    losses = [parts.loss(windows.batch(store, last)) * len(last) for last in batches]
    return sum(losses) / sum(len(last) for last in batches)


def validation_runs(store: EpisodeStore, n_windows: int, chosen: Tensor | None = None) -> Tensor:
    """The last frames of runs in which every frame lies once; the first run of an episode may be shorter.

    Args:
        store: The episodes.
        n_windows: Windows per run, K.
        chosen: (N,) bool, the frames that count; None: all. A stretch of them that begins within an episode may have up to
            K - 1 frames before it in its first run.
    """
    ends = []
    for start, end in zip(store.starts, store.ends, strict=True):
        counts = torch.ones(end - start, dtype=torch.bool) if chosen is None else chosen[start:end]
        edges = counts.int().diff(prepend=torch.zeros(1, dtype=torch.int), append=torch.zeros(1, dtype=torch.int))
        stretches = zip((edges > 0).nonzero().squeeze(1), (edges < 0).nonzero().squeeze(1), strict=True)
        ends += [torch.arange(start + int(last) - 1, start + int(first) - 1, -n_windows) for first, last in stretches]
    return torch.cat(ends)
