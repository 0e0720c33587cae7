"""Episodes as one tensor per feature, read from a dataset once, and windows of them by indexing.

The tensors are in memory, or in files that are mapped into it (`frame_cache.py`).
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.language import LANGUAGE_COLUMNS
from torch import Tensor
from tqdm import tqdm

from lerobot_playbyear.audio.audio_files import resample
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.features import IS_FIRST, check_audio_features, samples_per_frame, to_pcm_s16
from lerobot_playbyear.datasets.free_memory import available_memory
from lerobot_playbyear.datasets.info import INDEX_COLUMNS
from lerobot_playbyear.datasets.parquet import episode_bounds
from lerobot_playbyear.datasets.pictures import kept_shape, shrink
from lerobot_playbyear.datasets.reader import DatasetReader, check_finite
from lerobot_playbyear.datasets.remedies import repair_command
from lerobot_playbyear.training.frame_cache import cached_columns, dataset_identity

PLACES = ("memory", "disk", "auto")
"""Where a dataset's frames are kept."""

_NUMBERING = ("episode_index", "frame_index", "task_index")  # read for what follows from it, and not kept
_CAMERA_DTYPES = ("image", "video")
_GPU_SHARE = 0.5  # of the free memory: the network and its gradients need the rest
_MEMORY_SHARE = 0.5  # of what is free; what is on the disk is as fast as memory where it fits into it
_PCM_S16_FULL_SCALE = 32768
_PICTURES_AT_ONCE = 32
_EDGE = 128  # samples of the lower rate: twice what the resampler's filter reaches
_GROWTH = 1.5  # of a tensor that has no room for another episode


class EpisodeStore:
    """A LeRobotDataset read once: uint8 frames (N, C, H, W), int16 sound (N, S), float32 numbers (N, D).

    Frames are numbered as `LeRobotDataset[i]` numbers them, and a window is named by its last frame. Episodes can be
    appended while training goes on.

    Args:
        columns: Every feature, as a tensor of N rows; without index columns.
        starts: First frame of each episode, (E,).
        ends: Frame after the last of each episode, (E,).
        fps: Frames per second [Hz].
        tasks: The task texts that `task_index` counts.
        device: Where the tensors are kept.
        image_size: The size that pictures were shrunk to, if they were [pixels]. Appended ones will be, too.
        task_index: (N,) the number of each frame's task. None: the first task's.

    Attributes:
        fps, tasks, device, image_size: As given.
        starts, ends: As given, and of episodes that were appended.
        place: "memory" or "disk", where the tensors were read to.
    """

    place = "memory"

    def __init__(
        self,
        columns: Mapping[str, Tensor],
        starts: Sequence[int],
        ends: Sequence[int],
        fps: float,
        tasks: Sequence[str] = ("",),
        device: str | torch.device = "cpu",
        image_size: int | None = None,
        task_index: Tensor | None = None,
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
            keys: The features to read; None reads all but depth, text, language and the index columns.
            device: Where to keep the tensors; None takes the GPU when at most half of its free memory is needed,
                and the CPU otherwise.
            progress: Show a progress bar for the cameras.
            place: "memory", or "disk" for files that are mapped into memory, which the next run finds again. "auto" is memory
                where the frames fill at most half of what is free.
            image_size: Keep pictures no larger than this, shrunk as the policy `playbyear` does [pixels].
            cache: Folder of the files; None takes one beside LeRobot's cache.
            sample_rates: Keep these microphones at these rates, resampled where they were recorded at others [Hz].

        Raises:
            ValueError: If there is no such place, a key is missing or cannot be kept, sound breaks the contract, a value is
                NaN or infinite, there are no frames, or the disk has no room.
            MemoryError: If the tensors do not fit into the memory.
        """
        if place not in PLACES:
            raise ValueError(f"--store={place} is not known: wanted one of {', '.join(PLACES)}.")
        reader = dataset if isinstance(dataset, DatasetReader) else DatasetReader.of(dataset)
        if len(reader) == 0:
            raise ValueError(f"The dataset '{reader.repo_id}' is empty: it has no frames. Record at least one episode.")
        features = _select_features(reader, keys)
        with_rate = {key: feature for key, feature in features.items() if sample_rate_in(feature) is not None}
        check_audio_features(with_rate, reader.fps)
        kept = features_at(features, sample_rates or {}, reader.fps)
        new_rates = {key: kept[key]["info"]["sample_rate"] for key in features if kept[key] is not features[key]}
        row_bytes = {key: _row_bytes(feature, image_size) for key, feature in kept.items()}
        n_bytes = sum(row_bytes.values()) * len(reader)
        if place == "auto":
            place = "memory" if n_bytes <= _MEMORY_SHARE * available_memory() else "disk"
        device = _choose_device(device, n_bytes)
        n_cameras = sum(feature["dtype"] in _CAMERA_DTYPES for feature in features.values())
        total, is_hidden = n_cameras * len(reader), not (progress and n_cameras)
        # Delayed, for what is there already takes less.
        with tqdm(desc="Reading frames", total=total, unit="frame", delay=1, disable=is_hidden) as bar:
            pieces = partial(_pieces, reader, image_size, new_rates, bar)
            if place == "disk":
                identity = {**dataset_identity(reader, features), "image_size": image_size, "sample_rates": new_rates}
                on_disk = cached_columns(identity, row_bytes, len(reader), pieces, cache)
                columns = {key: values.to(device) for key, values in on_disk.items()}
            else:
                _check_memory(n_bytes, device)
                # One by one, so that a copy on another device never doubles the whole dataset.
                columns = {key: _gathered(pieces(key), len(reader)).to(device) for key in features}
        episode_index, frame_index, task_index = (columns.pop(key).cpu() for key in _NUMBERING)
        starts, ends = _episodes(episode_index, frame_index, columns.get(IS_FIRST), reader)
        tasks = list(reader.meta.tasks.index)
        if nameless := sorted(set(task_index.tolist()) - set(range(len(tasks)))):
            raise InputError(
                f"Frames of '{reader.repo_id}' are of task {', '.join(map(str, nameless[:8]))}, which has no text in "
                "meta/tasks.parquet. Put a table from a copy in its place, or correct the frames' task_index."
            )
        store = cls(columns, starts, ends, reader.fps, tasks, device, image_size, task_index)
        store.place = place
        return store

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

    def windows(self, last_frames: Tensor | Sequence[int], deltas: Mapping[str, Sequence[int]]) -> dict[str, Any]:
        """A batch of B windows.

        Args:
            last_frames: (B,) the frame that delta 0 means.
            deltas: For every key wanted the T frame offsets, as in LeRobot's delta indices. T may differ per key.

        Returns:
            `<key>` (B, T, ...) and `<key>_is_pad` (B, T) bool for every key in `deltas`, and the list `task`. Before
            the first and after the last frame of the episode that frame repeats, and is flagged as padding, as LeRobot's
            data loader does. Images are uint8 and sound is as stored.

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
            batch[key] = self._gather(key, index)
            batch[f"{key}_is_pad"] = is_pad.clone()
        batch["task"] = [self.tasks[i] for i in self._task_index[last].tolist()]
        return batch

    def append_episode(self, frames: Sequence[Mapping[str, Any]]) -> None:
        """Add an episode at the end.

        Args:
            frames: The episode's frames, as a `DurableWriter` of the store's features has taken them: a value for every
                feature, images (H, W, C) or (C, H, W) uint8, and optionally `task`.

        Raises:
            InputError: If there are no frames, or a value is NaN or infinite. The store is then unchanged.
        """
        if len(frames) == 0:
            raise InputError("An episode without frames cannot be appended.")
        start, end = len(self), len(self) + len(frames)
        texts = [str(frame.get("task", self.tasks[0])) for frame in frames]
        columns = {key: self._stacked(key, frames) for key in self._columns}
        self.tasks += [text for text in dict.fromkeys(texts) if text not in self.tasks]
        for key, values in columns.items():
            self._columns[key] = _with_rows(self._columns[key], start, values.to(self.device))
        self._bounds = _with_rows(self._bounds, start, torch.tensor([[start, end - 1]]).expand(len(frames), 2))
        task_index = torch.tensor([self.tasks.index(text) for text in texts])
        self._task_index = _with_rows(self._task_index, start, task_index)
        self.starts.append(start)
        self.ends.append(end)

    def _gather(self, key: str, index: Tensor) -> Tensor:
        """The rows `index` (B, T) of one column."""
        values = self.column(key)
        # On the CPU NumPy copies whole rows without waking threads, which costs more than the copy of a batch.
        on_cpu = values.device.type == "cpu"
        return torch.from_numpy(values.numpy().take(index.numpy(), axis=0)) if on_cpu else values[index]

    def _stacked(self, key: str, frames: Sequence[Mapping[str, Any]]) -> Tensor:
        """One feature of new frames, (n, ...), in the store's shape and dtype."""
        shape, dtype = self._columns[key].shape[1:], self._columns[key].dtype
        values = torch.from_numpy(np.stack([np.asarray(frame[key]) for frame in frames]))
        if len(shape) == 3 and values.dim() == 4:  # pictures
            if values.shape[1] != shape[0]:
                values = values.movedim(-1, 1)  # (n, H, W, C) -> (n, C, H, W)
            if self.image_size is not None:
                values = torch.from_numpy(shrink(values.numpy(), self.image_size))
        if not shape and values.shape[1:] == (1,):
            values = values.squeeze(1)
        if values.dtype.is_floating_point and not values.isfinite().all():
            raise InputError(f"'{key}' holds NaN or infinite values in the new episode; wanted finite numbers.")
        return values.to(dtype)


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


# What a dataset holds


def features_at(features: Mapping[str, Any], sample_rates: Mapping[str, int], fps: float) -> dict[str, Any]:
    """A dataset's features, its microphones at other sample rates.

    Args:
        features: Of the dataset.
        sample_rates: By microphone [Hz]; what is not named, or has that rate, stays as it is.
        fps: The dataset's frames per second [Hz].

    Raises:
        ValueError: If the frame rate does not divide a sample rate.
    """
    changed = {}
    for key, rate in sample_rates.items():
        if key in features and sample_rate_in(features[key]) not in (None, rate):
            info = {**features[key]["info"], "sample_rate": rate}
            changed[key] = {**features[key], "shape": (samples_per_frame(rate, fps, key),), "info": info}
    return {**features, **changed}


def sample_rate_in(feature: Mapping[str, Any]) -> int | None:
    """What a feature says of its sample rate [Hz]; None: nothing."""
    return (feature.get("info") or {}).get("sample_rate")


def _pieces(
    reader: DatasetReader, image_size: int | None, sample_rates: Mapping[str, int], bar: tqdm, key: str
) -> Iterator[np.ndarray]:
    """A column in pieces (n, ...), pictures and sound at the size and the rate at which they are kept.

    Raises:
        ValueError: A value is NaN or infinite.
    """
    if reader.features[key]["dtype"] in _CAMERA_DTYPES:
        for episode in reader.episodes:
            pictures = reader.pictures(key, episode)
            while piece := list(itertools.islice(pictures, _PICTURES_AT_ONCE)):
                stacked = np.stack(piece).transpose(0, 3, 1, 2)  # (n, C, H, W)
                yield stacked if image_size is None else shrink(stacked, image_size)
                bar.update(len(piece))
        return
    if reader.features[key]["dtype"].startswith("float"):
        check_finite(reader, key)
    for episode in reader.episodes:
        values = reader.values(key, episode)
        if key in sample_rates:
            values = _resampled(reader, key, values, sample_rates[key])
        yield values.astype(np.float32, copy=False) if np.issubdtype(values.dtype, np.floating) else values


def _resampled(reader: DatasetReader, key: str, rows: np.ndarray, sample_rate: int) -> np.ndarray:
    """An episode's sound (n, S) at another sample rate, in the stored form.

    What was heard before its first sample and after its last is not known: there the sound goes on as its mirror image, turned
    about that sample, so that its edges do not ring.
    """
    n_samples, is_pcm = samples_per_frame(sample_rate, reader.fps, key), rows.dtype == np.int16
    n_edge = math.ceil(_EDGE / min(n_samples, rows.shape[1]))  # frames
    sound = rows.reshape(-1).astype(np.float32) / (_PCM_S16_FULL_SCALE if is_pcm else 1)
    padded = np.pad(sound, n_edge * rows.shape[1], mode="reflect", reflect_type="odd")
    old_rate = int(reader.features[key]["info"]["sample_rate"])
    new = resample(padded, old_rate, sample_rate).reshape(-1, n_samples)[n_edge : n_edge + len(rows)]
    return to_pcm_s16(new) if is_pcm else new


def _gathered(pieces: Iterator[np.ndarray], n_rows: int) -> Tensor:
    """All pieces of a column as one tensor, (N, ...)."""
    values: np.ndarray | None = None
    position = 0
    for piece in pieces:
        if values is None:
            values = np.empty((n_rows, *piece.shape[1:]), piece.dtype)
        values[position : position + len(piece)] = piece
        position += len(piece)
    assert values is not None
    assert position == n_rows
    return torch.from_numpy(values)


def _select_features(reader: DatasetReader, keys: Iterable[str] | None) -> dict[str, Any]:
    features, others = reader.features, {*LANGUAGE_COLUMNS, *reader.meta.depth_keys}
    others |= {key for key, feature in features.items() if feature["dtype"] == "string"}
    if keys is None:
        keys = [key for key in features if key not in others and key not in INDEX_COLUMNS]
    is_first = features.get(IS_FIRST)
    has_is_first = is_first is not None and is_first["dtype"] == "bool" and math.prod(is_first["shape"]) == 1
    keys = list(dict.fromkeys([*keys, *_NUMBERING, *([IS_FIRST] if has_is_first else [])]))
    for key in keys:
        if key not in features:
            raise ValueError(f"The dataset '{reader.repo_id}' has no '{key}'; it has {sorted(features)}.")
        if key in others:
            raise ValueError(f"'{key}' ({features[key]['dtype']}) cannot be kept in memory: leave it out of the keys.")
    return {key: features[key] for key in keys}


def _row_bytes(feature: Mapping[str, Any], image_size: int | None) -> int:
    """Of a camera kept at `image_size`, at most."""
    dtype, shape = feature["dtype"], tuple(feature["shape"])
    if dtype in _CAMERA_DTYPES:
        return math.prod(kept_shape(shape, image_size))
    return math.prod(shape) * (4 if dtype.startswith("float") else np.dtype(dtype).itemsize)


def _choose_device(device: str | torch.device | None, n_bytes: int) -> torch.device:
    if device is None:
        fits = torch.cuda.is_available() and n_bytes <= _GPU_SHARE * torch.cuda.mem_get_info()[0]
        device = "cuda" if fits else "cpu"
    return torch.device(device)


def _check_memory(n_bytes: int, device: torch.device) -> None:
    free = available_memory()
    if device.type == "cpu" and n_bytes > free:
        raise MemoryError(
            f"The dataset needs {n_bytes / 2**30:.1f} GiB in memory, and {free / 2**30:.1f} GiB are free. Keep it on the "
            "disk (--store=disk), choose fewer episodes (--dataset.episodes), or end other programs."
        )


def _episodes(
    episode_index: Tensor, frame_index: Tensor, is_first: Tensor | None, reader: DatasetReader
) -> tuple[list[int], list[int]]:
    starts, ends = episode_bounds(episode_index.numpy())
    for start, end in zip(starts, ends, strict=True):
        if not torch.equal(frame_index[start:end], torch.arange(end - start)):
            raise ValueError(
                f"Episode {int(episode_index[start])} of '{reader.repo_id}' is incomplete: its {end - start} rows "
                f"are not frames 0 to {end - start - 1}. Copy what is whole: {repair_command(reader.root)}"
            )
    if is_first is not None and is_first.dtype == torch.bool:
        # LeRobot's rollout resets the policy after a pause: no window reaches back beyond it.
        starts = sorted({*starts, *is_first.reshape(-1).cpu().nonzero().reshape(-1).tolist()})
        ends = [*starts[1:], *ends[-1:]]
    return starts, ends
