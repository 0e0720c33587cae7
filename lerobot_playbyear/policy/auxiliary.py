"""What training predicts beside the action, so that encodings hold more than this action needs. Nothing of it acts.

In comments: B items, K supervised windows of each, M microphones, D numbers in a joint encoding.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.history import newest
from lerobot_playbyear.policy.spectrogram import POWER_FLOOR, to_float_wave

KINDS = ("onset", "balance", "way")
_HIDDEN = 128
_ONSET = 1.2  # [10 dB] above the item's median frame, and above the frame before
_NEAR = 0.1  # [normalised units] errors of a way count squared up to here, and then as they are
_FAR = 1.0  # [normalised units] what is farther away is told as that far: carrying takes it to several, and nothing hangs on it


@dataclass(frozen=True)
class AuxiliaryLoss:
    """One of `KINDS` in one batch.

    Attributes:
        kind: Its name.
        factor: Its weight beside the action's loss.
        error: (B, n) of n predictions per item.
        weight: (B, n), 0 where there was nothing to predict.
    """

    kind: str
    factor: float
    error: Tensor
    weight: Tensor


class AuxiliaryHeads(nn.Module):
    """A small head with one hidden layer for every kind that has a weight.

    Args:
        config: The policy's configuration.
    """

    def __init__(self, config: PlaybyearConfig):
        super().__init__()
        self.config = config
        self.factors = weights_of(config)
        n_felt = sum(math.prod(config.feature_shape(key)) for key in config.low_dimensional_keys)
        sizes = {"onset": 1, "balance": len(config.audio_keys), "way": n_felt}
        heads = {kind: _head(config.embedding_size, sizes[kind]) for kind in KINDS if self.factors[kind]}
        self.heads = nn.ModuleDict(heads)

    def forward(
        self, batch: dict[str, Tensor], encodings: Tensor, outputs: Tensor, weight: Tensor
    ) -> Iterator[AuxiliaryLoss]:
        """The losses of a batch.

        Args:
            batch: As `PlaybyearPolicy.forward` gets it.
            encodings: (B, K, D) joint encodings of the frames that the windows end at.
            outputs: (B, K, D) the memory's outputs after the windows.
            weight: (B, K), 0 for windows that are not learned from.
        """
        levels, n_windows = self._levels(batch), encodings.shape[1]
        for kind in self.heads:
            if kind == "onset":
                logits, begins = self._predict(kind, encodings).squeeze(2), self._onsets(levels, n_windows)  # (B, K)
                error = functional.binary_cross_entropy_with_logits(logits, begins, reduction="none")
                counts = weight
            elif kind == "balance":
                counts = weight * self._onsets(levels, n_windows)
                shares = (levels[:, -n_windows:] * math.log(10)).softmax(dim=2)  # of the power, (B, K, M)
                logits = self._predict(kind, encodings).log_softmax(dim=2)
                error = functional.kl_div(logits, shares, reduction="none").sum(dim=2)
            else:
                ways, is_known = self._ways(batch, levels, n_windows)
                predicted, counts = self._predict(kind, outputs), weight * is_known
                error = functional.smooth_l1_loss(predicted, ways, beta=_NEAR, reduction="none").mean(dim=2)
            yield AuxiliaryLoss(kind, self.factors[kind], error, counts)

    def _predict(self, kind: str, inputs: Tensor) -> Tensor:
        return self.heads[kind](inputs).float()  # whatever autocast computed in

    def _levels(self, batch: dict[str, Tensor]) -> Tensor:
        """How loud each frame is at each of M microphones, without augmentation, (B, frames, M) [10 dB]."""
        sounds = (self._sound(batch, key, self.config.n_audio_frames) for key in self.config.audio_keys)
        return torch.stack([torch.log10(sound.square().mean(dim=2) + POWER_FLOOR) for sound in sounds], dim=2)

    @staticmethod
    def _onsets(levels: Tensor, n_windows: int) -> Tensor:
        """Whether a sudden sound begins, at any microphone, in each of the last frames: 0 or 1, (B, n_windows).

        What swells, as the rubbing of a thing that is carried, crosses the first threshold up and down by chance: it has to be
        a jump, too, or nobody could learn to tell it.
        """
        louder = levels - levels.sort(dim=1).values[:, (levels.shape[1] - 1) // 2, None]
        loud, sudden = ((rise > _ONSET).any(dim=2) for rise in (louder, levels.diff(dim=1)))
        return (loud[:, 1:] & ~loud[:, :-1] & sudden)[:, -n_windows:].float()

    def _ways(self, batch: dict[str, Tensor], levels: Tensor, n_windows: int) -> tuple[Tensor, Tensor]:
        """Where the arm was at the last sudden sound that a window remembers, from where it is at the window's end.

        Returns:
            (B, n_windows, numbers that are felt) without noise, `_FAR` at most; and whether there was such a sound, 0 or 1,
            (B, n_windows).
        """
        config = self.config
        n_steps = config.memory_steps
        n_frames = n_windows + n_steps - 1
        shapes = {key: config.feature_shape(key) for key in config.low_dimensional_keys}
        felt = [newest(batch, key, n_frames, shape).flatten(2) for key, shape in shapes.items()]
        places = torch.cat(felt, dim=2)  # (B, n_frames, numbers)
        frames = torch.arange(n_frames, device=places.device)
        last = torch.where(self._onsets(levels, n_frames) > 0, frames, -1).cummax(dim=1).values[:, n_steps - 1 :]
        is_known = last > frames[n_steps - 1 :] - n_steps  # (B, n_windows)
        at_sound = last.clamp(min=0).unsqueeze(2).expand(-1, -1, places.shape[2])
        ways = places.gather(1, at_sound) - places[:, n_steps - 1 :]
        return ways.clamp(-_FAR, _FAR), is_known.to(places.dtype)

    def _sound(self, batch: dict[str, Tensor], key: str, n_frames: int) -> Tensor:
        """The newest sound of a microphone, (B, n_frames, S)."""
        return to_float_wave(newest(batch, key, n_frames, self.config.feature_shape(key)), key)


def make_auxiliary(config: PlaybyearConfig) -> AuxiliaryHeads | None:
    """The heads that a configuration asks for; None where it asks for none."""
    return AuxiliaryHeads(config) if any(weights_of(config).values()) else None


def weights_of(config: PlaybyearConfig) -> dict[str, float]:
    """The weight of each of `KINDS`; a policy leaves out what needs more ears than it has, so that all take the same preset."""
    n_ears = len(config.audio_keys) if config.use_audio else 0
    needs = {"onset": 1, "balance": 2, "way": 1}
    return {kind: getattr(config, f"auxiliary_{kind}") if n_ears >= needs[kind] else 0.0 for kind in KINDS}


def _head(n_in: int, n_out: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(n_in, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, n_out))
