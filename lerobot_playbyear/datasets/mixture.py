"""Several stores as one: their frames are numbered on, and a batch is put together from all of them."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from lerobot_playbyear.datasets.episode_store import EpisodeStore
from lerobot_playbyear.datasets.rows import sent_to

type Windowed = EpisodeStore | StoreMixture
"""What batches are cut out of."""


class StoreMixture:
    """Several `EpisodeStore`s, each with what windows need of all.

    Frame i of the second store has the number N + i, with N the frames of the first, and so on.

    Args:
        stores: At least one.

    Attributes:
        stores: The stores.
        fps: Frames per second [Hz].
        device: Where batches lie: that of the stores, or the CPU where they lie on several.
    """

    def __init__(self, stores: Sequence[EpisodeStore]) -> None:
        self.stores = list(stores)
        self.fps = self.stores[0].fps
        devices = {store.device for store in self.stores}
        self.device = devices.pop() if len(devices) == 1 else torch.device("cpu")
        lengths = torch.tensor([len(store) for store in self.stores])
        self._ends = lengths.cumsum(0)
        self._offsets = (self._ends - lengths).tolist()
        self._uneven = {key for store in self.stores for key in store.keys if not self._is_common(key)}

    def __len__(self) -> int:
        """The number of frames of all stores."""
        return int(self._ends[-1])

    @property
    def n_episodes(self) -> int:
        """The number of episodes of all stores."""
        return sum(store.n_episodes for store in self.stores)

    def windows(
        self, last_frames: Tensor | Sequence[int], deltas: Mapping[str, Sequence[int]], as_lerobot: bool = False
    ) -> dict[str, Any]:
        """A batch of B windows in the order of `last_frames`; arguments and errors as for `EpisodeStore.windows`.

        What not all stores hold in the same shape and dtype is left out; index columns count within each store.
        """
        if uneven := self._uneven & set(deltas):
            raise ValueError(
                f"{sorted(uneven)} cannot be put together: not all stores hold them in the same shape and dtype."
            )
        last = torch.as_tensor(last_frames, dtype=torch.long).cpu()  # (B,)
        if last.numel() and not (int(last.min()) >= 0 and int(last.max()) < len(self)):
            raise IndexError(f"Frames {int(last.min())} to {int(last.max())} wanted, but there are {len(self)}.")
        owner = torch.searchsorted(self._ends, last, right=True)  # (B,)
        numbers = owner.unique().tolist() or [0]
        places = [(owner == number).nonzero().squeeze(1) for number in numbers]
        parts = [
            self.stores[number].windows(last[place] - self._offsets[number], deltas, as_lerobot)
            for number, place in zip(numbers, places, strict=True)
        ]
        keys = [key for key in parts[0] if key not in self._uneven]
        return {key: _in_order([part[key] for part in parts], places, self.device) for key in keys}

    def _is_common(self, key: str) -> bool:
        forms = {
            (store.column(key).shape[1:], store.column(key).dtype) if key in store.keys else None
            for store in self.stores
        }
        return len(forms) == 1


def _in_order(parts: list[Any], places: list[Tensor], device: torch.device) -> Any:
    """Parts of a batch, tensors or lists, each item put at its place."""
    if isinstance(parts[0], list):
        items = dict(zip(torch.cat(places).tolist(), itertools.chain.from_iterable(parts), strict=True))
        return [items[place] for place in range(len(items))]
    if len(parts) == 1:
        return parts[0].to(device)
    n = sum(map(len, places))
    whole = parts[0].new_empty((n, *parts[0].shape[1:]), device=device)
    for part, place in zip(parts, places, strict=True):
        whole.index_copy_(0, sent_to(device, place), part.to(device))
    return whole
