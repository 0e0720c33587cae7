"""Training: a dataset in memory, batches of windows, a learner and its command."""

from lerobot_playbyear import lazy_names

__all__ = ["EpisodeStore", "RunSampler", "run_weights"]

__getattr__ = lazy_names(__name__, {"store": ("EpisodeStore",), "batches": ("RunSampler", "run_weights")})
