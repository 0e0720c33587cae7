"""Episodes as one tensor per feature, read from a dataset once, and windows of them by indexing."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from torch import Tensor

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.pictures import shrink
from lerobot_playbyear.datasets.reader import DatasetReader
from lerobot_playbyear.training.columns import INDEX_KEYS, read_columns

_GROWTH = 1.5


class EpisodeStore:
    """A LeRobotDataset read once: uint8 frames (N, C, H, W), int16 sound (N, S), float32 numbers (N, D).

    Frames are numbered as `LeRobotDataset[i]` numbers them, and a window is named by its last frame. Episodes can be
    appended while training goes on.

    Args:
        columns: Every feature, as a tensor of N rows.
        starts: First frame of each episode, (E,).
        ends: Frame after the last of each episode, (E,).
        fps: Frames per second [Hz].
        tasks: The task texts that the column `task_index` counts.
        device: Where the tensors are kept.
        image_size: The size that pictures were shrunk to, if they were [pixels]. Appended ones will be, too.

    Attributes:
        fps, tasks, device, image_size: As given.
        starts, ends: As given, and of episodes that were appended.
    """

    def __init__(
        self,
        columns: Mapping[str, Tensor],
        starts: Sequence[int],
        ends: Sequence[int],
        fps: int,
        tasks: Sequence[str] = ("",),
        device: str | torch.device = "cpu",
        image_size: int | None = None,
    ) -> None:
        self.fps, self.image_size = fps, image_size
        self.tasks = list(tasks)
        self.device = torch.device(device)
        self.starts, self.ends = list(starts), list(ends)
        # Column by column, so that the copy on the other device never doubles the whole store.
        self._columns = {key: values.to(self.device) for key, values in columns.items()}
        # Where windows lie is reckoned on the host, which then never waits for a GPU.
        lengths = torch.tensor(self.ends) - torch.tensor(self.starts)
        edges = (self.starts, [end - 1 for end in self.ends])
        self._bounds = torch.stack([torch.tensor(edge).repeat_interleave(lengths) for edge in edges], dim=1)
        # (N, 2): first frame, and last one, of the episode of each frame
        task_index = columns.get("task_index")
        self._task_index = torch.zeros(len(self), dtype=torch.long) if task_index is None else task_index.cpu()

    @classmethod
    def from_dataset(
        cls,
        dataset: LeRobotDataset | DatasetReader,
        keys: Iterable[str] | None = None,
        device: str | torch.device | None = None,
        progress: bool = False,
        place: str = "memory",
        image_size: int | None = None,
        cache: Path | None = None,
        sample_rates: Mapping[str, int] | None = None,
    ) -> "EpisodeStore":
        """Read a dataset, local or from the Hub; the episodes it was opened with.

        Args:
            dataset: An opened dataset; its `delta_timestamps` do not matter.
            keys: The features to read besides the index columns; None reads all but depth, text and language.
            device: Where to keep the tensors; None takes the GPU when at most half of its free memory is needed,
                and the CPU otherwise.
            progress: Show a progress bar for the cameras.
            place: "memory", or "disk" for files that are mapped into memory, which the next run finds again.
            image_size: Keep pictures no larger than this, shrunk as the policy `playbyear` does [pixels].
            cache: Folder of the files; None takes one beside LeRobot's cache.
            sample_rates: Keep these microphones at these rates, resampled where they were recorded at others [Hz].

        Raises:
            ValueError: If a key is missing or cannot be kept, sound breaks the contract, a value is NaN or infinite,
                there are no frames, or the disk has no room.
            MemoryError: If the tensors do not fit into the memory.
        """
        reader = dataset if isinstance(dataset, DatasetReader) else DatasetReader.of(dataset)
        columns, starts, ends = read_columns(reader, keys, device, progress, place, image_size, cache, sample_rates)
        tasks, device = list(reader.meta.tasks.index), columns["index"].device
        return cls(columns, starts, ends, reader.fps, tasks, device, image_size)

    @classmethod
    def load(
        cls, repo_id: str, root: str | None = None, episodes: list[int] | None = None, **kwargs: Any
    ) -> "EpisodeStore":
        """Open a dataset and read it; `kwargs` as for `from_dataset`.

        Raises:
            ValueError: Also if a file of the dataset is truncated.
        """
        return cls.from_dataset(DatasetReader(repo_id, root, episodes), **kwargs)

    def __len__(self) -> int:
        """The number of frames, N."""
        return self.ends[-1] if self.ends else 0

    @property
    def n_episodes(self) -> int:
        """The number of episodes, E."""
        return len(self.starts)

    @property
    def keys(self) -> list[str]:
        """The features kept."""
        return list(self._columns)

    @property
    def nbytes(self) -> int:
        """Bytes that the frames occupy."""
        return sum(self.column(key).nbytes for key in self._columns)

    def column(self, key: str) -> Tensor:
        """All values of one feature, (N, ...), without a copy.

        Raises:
            ValueError: If the store does not hold it.
        """
        if key not in self._columns:
            raise ValueError(f"The store holds no '{key}'; it holds {self.keys}.")
        return self._columns[key][: len(self)]

    def windows(
        self, last_frames: Tensor | Sequence[int], deltas: Mapping[str, Sequence[int]], as_lerobot: bool = False
    ) -> dict[str, Any]:
        """A batch of B windows.

        Args:
            last_frames: (B,) the frame that delta 0 means.
            deltas: For every key wanted the T frame offsets, as in LeRobot's delta indices. T may differ per key.
            as_lerobot: Return exactly what LeRobot's data loader returns for these frames: all other columns at
                delta 0 as well, images as floats in [0, 1], integers as int64.

        Returns:
            `<key>` (B, T, ...) and `<key>_is_pad` (B, T) bool for every key in `deltas`, and the list `task`. Before
            the first and after the last frame of the episode that frame repeats, and is flagged as padding. Without
            `as_lerobot` images are uint8 and sound is as stored.

        Raises:
            ValueError: If a key is not in the store.
            IndexError: If a frame is not in the store.
        """
        last = torch.as_tensor(last_frames, dtype=torch.long).cpu()  # (B,)
        if last.numel() and not (int(last.min()) >= 0 and int(last.max()) < len(self)):
            raise IndexError(f"Frames {int(last.min())} to {int(last.max())} wanted, but the store has {len(self)}.")
        first_valid, last_valid = self._bounds[last].unsqueeze(1).unbind(-1)  # (B, 1) each
        placed: dict[tuple[int, ...], tuple[Tensor, Tensor]] = {}  # keys with equal deltas share their indices
        batch: dict[str, Any] = {}
        for key, offsets in deltas.items():
            offsets = tuple(offsets)
            if offsets not in placed:
                wanted = last.unsqueeze(1) + torch.tensor(offsets)  # (B, T)
                inside = torch.minimum(torch.maximum(wanted, first_valid), last_valid)
                placed[offsets] = (_sent_to(self.device, inside), _sent_to(self.device, inside != wanted))
            index, is_pad = placed[offsets]
            batch[key] = self._gather(key, index, as_lerobot)
            batch[f"{key}_is_pad"] = is_pad.clone()
        if as_lerobot:
            others = [key for key in self._columns if key not in deltas]
            index = _sent_to(self.device, last)
            batch.update({key: self._gather(key, index, as_lerobot) for key in others})
        batch["task"] = [self.tasks[i] for i in self._task_index[last].tolist()]
        return batch

    def append_episode(self, frames: Sequence[Mapping[str, Any]]) -> None:
        """Add an episode at the end.

        Args:
            frames: The episode's frames, as `LeRobotDataset.add_frame` takes them: a value for every feature of the
                store, images (H, W, C) or (C, H, W) uint8, and optionally `task`. Index columns are filled in.

        Raises:
            InputError: If there are no frames, a feature is missing or has another shape or dtype, or a value is NaN
                or infinite. The store is then unchanged.
        """
        if len(frames) == 0:
            raise InputError("An episode without frames cannot be appended.")
        start, end = len(self), len(self) + len(frames)
        tasks = list(self.tasks)
        columns = {key: self._stacked(key, frames) for key in self._columns if key not in INDEX_KEYS}
        columns.update(self._index_columns(frames, start, tasks))
        for key, values in columns.items():
            self._columns[key] = _with_rows(self._columns[key], start, values.to(self.device))
        self._bounds = _with_rows(self._bounds, start, torch.tensor([[start, end - 1]]).expand(len(frames), 2))
        task_index = columns.get("task_index", torch.zeros(len(frames), dtype=torch.long))
        self._task_index = _with_rows(self._task_index, start, task_index)
        self.tasks = tasks
        self.starts.append(start)
        self.ends.append(end)

    def _gather(self, key: str, index: Tensor, as_lerobot: bool) -> Tensor:
        """The rows `index` (B,) or (B, T) of one column."""
        values = self.column(key)
        # On the CPU NumPy copies whole rows without waking threads, which costs more than the copy of a batch.
        on_cpu = values.device.type == "cpu"
        rows = torch.from_numpy(values.numpy().take(index.numpy(), axis=0)) if on_cpu else values[index]
        return _as_lerobot_has(rows) if as_lerobot else rows

    def _stacked(self, key: str, frames: Sequence[Mapping[str, Any]]) -> Tensor:
        """One feature of new frames, (n, ...), in the store's shape and dtype."""
        missing = [i for i, frame in enumerate(frames) if key not in frame]
        if missing:
            raise InputError(
                f"'{key}' is missing in frame {missing[0]} of the new episode; the store holds {self.keys}."
            )
        shape, dtype = self._columns[key].shape[1:], self._columns[key].dtype
        values = torch.from_numpy(np.stack([np.asarray(frame[key]) for frame in frames]))
        if _kind(values.dtype) != _kind(dtype):
            raise InputError(f"'{key}' has dtype {values.dtype} in the new episode, and {dtype} in the store.")
        if len(shape) == 3 and values.dim() == 4:  # pictures
            if values.shape[1] != shape[0]:
                values = values.movedim(-1, 1)  # (n, H, W, C) -> (n, C, H, W)
            if self.image_size is not None:
                values = torch.from_numpy(shrink(values.numpy(), self.image_size))
        if not shape and values.shape[1:] == (1,):
            values = values.squeeze(1)
        if values.shape[1:] != shape:
            raise InputError(
                f"'{key}' has shape {tuple(values.shape[1:])} in the new episode, and {tuple(shape)} in the store."
            )
        if values.dtype.is_floating_point and not values.isfinite().all():
            raise InputError(f"'{key}' holds NaN or infinite values in the new episode; wanted finite numbers.")
        return values.to(dtype)

    def _index_columns(self, frames: Sequence[Mapping[str, Any]], start: int, tasks: list[str]) -> dict[str, Tensor]:
        """The index columns of new frames; unknown task texts are added to `tasks`."""
        texts = [str(frame.get("task", tasks[0])) for frame in frames]
        tasks.extend(text for text in dict.fromkeys(texts) if text not in tasks)
        frame_index = torch.arange(len(frames))
        columns = {
            "index": start + frame_index,
            "episode_index": torch.full((len(frames),), self.n_episodes),
            "frame_index": frame_index,
            "task_index": torch.tensor([tasks.index(text) for text in texts]),
            "timestamp": frame_index.to(torch.float32) / self.fps,
        }
        return {key: values for key, values in columns.items() if key in self._columns}


def _kind(dtype: torch.dtype) -> str:
    return "bool" if dtype == torch.bool else "float" if dtype.is_floating_point else "int"


def _as_lerobot_has(rows: Tensor) -> Tensor:
    """Stored values in the dtypes of LeRobot's loader: images as floats in [0, 1], integers as int64."""
    if rows.dtype in (torch.bool, torch.float32, torch.int64):
        return rows
    if rows.device.type != "cpu":
        return rows.float() / 255 if rows.dtype == torch.uint8 else rows.long()
    # NumPy converts in one pass and into huge pages: four times faster than PyTorch for a batch of images.
    values = rows.numpy()
    if rows.dtype == torch.uint8:
        return torch.from_numpy(np.divide(values, np.float32(255), dtype=np.float32))
    return torch.from_numpy(values.astype(np.int64))


def _sent_to(device: torch.device, values: Tensor) -> Tensor:
    """Small numbers of the host, on a device; nothing waits for them."""
    if device.type == "cuda":
        return values.pin_memory().to(device, non_blocking=True)
    return values.to(device)


def _with_rows(values: Tensor, position: int, new: Tensor) -> Tensor:
    """`values` with `new` at `position`; where there is no room the tensor is copied into one with room to spare."""
    end = position + len(new)
    if end > len(values):
        roomy = values.new_empty((max(end, int(len(values) * _GROWTH)), *values.shape[1:]))
        roomy[:position] = values[:position]
        values = roomy
    values[position:end] = new
    return values
