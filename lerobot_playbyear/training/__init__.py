"""Training: a dataset in memory, batches of windows, a learner and its command."""

from typing import TYPE_CHECKING

from lerobot_playbyear import lazy_names

if TYPE_CHECKING:
    from lerobot_playbyear.training.batches import RunSampler, run_weights
    from lerobot_playbyear.training.store import EpisodeStore

__all__ = ["EpisodeStore", "RunSampler", "run_weights"]

__getattr__ = lazy_names(__name__, {"store": ("EpisodeStore",), "batches": ("RunSampler", "run_weights")})
