"""Intervention weighting: corrections, what led to them and the policy's own good frames count differently."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch

from lerobot_playbyear.dagger.batches import frames_by_expert, frames_learned_from, stretches
from lerobot_playbyear.dagger.methods.base import Learned, Method, MethodConfig
from lerobot_playbyear.datasets import EpisodeStore
from lerobot_playbyear.datasets.errors import InputError

if TYPE_CHECKING:
    from lerobot_playbyear.dagger.config import DaggerConfig

_SHARES = ("intervention", "before", "policy", "demonstrations")


@MethodConfig.register_subclass("weighted")
@dataclass
class WeightedConfig(MethodConfig):
    """HG-DAgger's attempts, all of whose frames are learned from, each kind with a share of the learned actions of its own.

    Attributes:
        paper: Whose shares are the defaults. `sirius` (Liu et al., 2023): one half interventions, nothing of what came just
            before one, demonstrations as many as there are among all frames, the policy's own good frames the rest. `iwr`
            (Mandlekar et al., 2020): one half interventions, all else as it comes.
        intervention, before, policy, demonstrations: These shares, above 0 for demonstrations; None: the paper's. They are
            divided by their sum, and a kind of which there are no frames has none.
        before_s: How long before an intervention frames count as just before it [s]; Sirius: 15 frames at 20 Hz.
    """

    chooses_frames: ClassVar[bool] = True

    paper: str = "sirius"
    intervention: float | None = None
    before: float | None = None
    policy: float | None = None
    demonstrations: float | None = None
    before_s: float = 0.75

    def check(self) -> None:
        if self.paper not in ("sirius", "iwr"):
            raise InputError(f"--method.paper={self.paper!r}: give sirius or iwr.")
        for name in _SHARES:
            value = getattr(self, name)
            if value is not None and not 0 <= value < np.inf:
                raise InputError(f"--method.{name}={value}: give a share of 0 or more.")
        if self.demonstrations == 0:
            raise InputError(
                "--method.demonstrations=0: give a share above 0; what was learned from them is forgotten else."
            )
        if not 0 <= self.before_s < np.inf:
            raise InputError(f"--method.before_s={self.before_s}: give 0 or more seconds.")

    def make(self, cfg: "DaggerConfig") -> Method:
        return Weighted(cfg, self)


class Weighted(Method):
    """See `WeightedConfig`."""

    def __init__(self, cfg: "DaggerConfig", config: WeightedConfig) -> None:
        super().__init__(cfg)
        self._config = config

    @property
    def weighs_frames(self) -> bool:
        return True

    def learned(self, n_demonstrated: int, attempts: EpisodeStore) -> Learned:
        n_skipped = self.cfg.n_skipped(attempts.fps)
        kinds = kinds_of_frames(attempts, round(self._config.before_s * attempts.fps), n_skipped)  # (N,)
        counts = {name: float((kinds == number).sum()) for number, name in enumerate(_SHARES[:3])}
        counts["demonstrations"] = float(n_demonstrated)
        wanted = shares(counts, self._config)
        weights = torch.zeros(len(attempts), dtype=torch.float64)
        for number, name in enumerate(_SHARES[:3]):
            weights[torch.from_numpy(kinds == number)] = wanted[name] / max(counts[name], 1.0)
        return Learned(weights, wanted["demonstrations"])


def shares(counts: dict[str, float], config: WeightedConfig) -> dict[str, float]:
    """The share of the learned actions that each kind of frame has; they add up to 1.

    Args:
        counts: Frames of each kind.
        config: The options.
    """
    total = sum(counts.values())
    natural = {name: counts[name] / total for name in _SHARES}
    if config.paper == "iwr":
        others = 1 - natural["intervention"]
        wanted = {name: 0.5 * natural[name] / max(others, 1e-12) for name in _SHARES}
    else:
        demonstrations = min(natural["demonstrations"], 0.5)
        wanted = {"before": 0.0, "policy": 0.5 - demonstrations, "demonstrations": demonstrations}
    wanted["intervention"] = 0.5
    given = {name: getattr(config, name) for name in _SHARES}
    wanted |= {name: value for name, value in given.items() if value is not None}
    wanted = {name: value if counts[name] else 0.0 for name, value in wanted.items()}
    return {name: value / sum(wanted.values()) for name, value in wanted.items()}


def kinds_of_frames(store: EpisodeStore, n_before: int, n_skipped: int = 0) -> np.ndarray:
    """What each frame of attempts is, (N,): 0 an intervention, 1 just before one, 2 the policy's own, 3 the beginning of one.

    Args:
        store: The attempts.
        n_before: Frames of the policy before an intervention that count as just before it.
        n_skipped: Frames of an intervention that count as its beginning, see `frames_learned_from`.
    """
    by_expert = frames_by_expert(store).cpu().numpy()
    kinds = np.where(by_expert, 0, 2)
    for start, end in zip(store.starts, store.ends, strict=True):
        for first, _ in stretches(by_expert[start:end]) + start:
            before = slice(max(first - n_before, start), first)
            kinds[before] = np.where(by_expert[before], 0, 1)
    is_learned = frames_learned_from(store, n_skipped).cpu().numpy()
    return np.where(by_expert & ~is_learned, 3, kinds)
