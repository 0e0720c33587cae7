"""What training predicts beside the action, so that encodings hold more than this action needs. Nothing of it acts.

In comments: B items, n frames of each, K supervised windows, M microphones, D numbers in a joint encoding.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.spectrogram import POWER_FLOOR

_HIDDEN = 128
_ONSET = 1.2  # [10 dB] above the item's median frame, and above the frame before
_NEAR = 0.1  # [normalised units] errors of a way count squared up to here, and then as they are
_FAR = 1.0  # [normalised units] what is farther away is told as that far: carrying takes it to several, and nothing hangs on it


def weights_of(config: PlaybyearConfig) -> dict[str, float]:
    """The weight of each kind of loss. A policy leaves out what it has not ears, or a body, enough for: all take one preset."""
    n_ears = len(config.heard_keys) if config.use_audio else 0
    can = {"onset": n_ears >= 1, "balance": n_ears >= 2, "way": n_ears >= 1 and bool(config.low_dimensional_keys)}
    return {kind: getattr(config, f"auxiliary_{kind}") if is_able else 0.0 for kind, is_able in can.items()}


class AuxiliaryHeads(nn.Module):
    """A small head with one hidden layer for every kind of loss that has a weight: onset, balance, way.

    Args:
        config: The policy's configuration.

    Attributes:
        weights: By kind, beside the action's loss.
    """

    def __init__(self, config: PlaybyearConfig):
        super().__init__()
        self.weights, self.memory_steps = weights_of(config), config.memory_steps
        n_felt = sum(math.prod(config.feature_shape(key)) for key in config.low_dimensional_keys)
        sizes = {"onset": 1, "balance": len(config.heard_keys), "way": n_felt}
        self.heads = nn.ModuleDict()
        for kind in (kind for kind in sizes if self.weights[kind]):
            layers = (nn.Linear(config.embedding_size, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, sizes[kind]))
            self.heads[kind] = nn.Sequential(*layers)

    def forward(
        self, waves: list[Tensor], felt: list[Tensor], encodings: Tensor, outputs: Tensor
    ) -> dict[str, tuple[Tensor, Tensor]]:
        """The losses of a batch.

        Args:
            waves: Of every microphone that is encoded (B, n_audio_frames, S), in [-1, 1], without augmentation.
            felt: Every low-dimensional observation (B, n_run_frames, its numbers), without noise.
            encodings: (B, K, D) joint encodings of the frames that the windows end at.
            outputs: (B, K, D) the memory's outputs after the windows.

        Returns:
            By kind the errors (B, K), and their weights (B, K): 0 where there was nothing to predict.
        """
        # How loud each frame is at each microphone, (B, n_audio_frames, M) [10 dB]
        sounds = [wave - wave.mean(dim=(1, 2), keepdim=True) for wave in waves]  # what is constant is not loud
        levels = torch.stack([torch.log10(sound.square().mean(dim=2) + POWER_FLOOR) for sound in sounds], dim=2)
        losses = {"onset": self._onset, "balance": self._balance, "way": self._way}
        return {kind: losses[kind](levels, felt, encodings, outputs) for kind in self.heads}

    def _onset(self, levels: Tensor, felt: list[Tensor], encodings: Tensor, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Whether a sudden sound begins in a window's last frame."""
        logits = self._predict("onset", encodings).squeeze(2)  # (B, K)
        begins = onsets(levels, logits.shape[1])
        return functional.binary_cross_entropy_with_logits(logits, begins, reduction="none"), torch.ones_like(begins)

    def _balance(self, levels: Tensor, felt: list[Tensor], encodings: Tensor, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Each microphone's share of the power, where a sudden sound begins."""
        n_windows = encodings.shape[1]
        shares = (levels[:, -n_windows:] * math.log(10)).softmax(dim=2)  # (B, K, M)
        logits = self._predict("balance", encodings).log_softmax(dim=2)
        return functional.kl_div(logits, shares, reduction="none").sum(dim=2), onsets(levels, n_windows)

    def _way(self, levels: Tensor, felt: list[Tensor], encodings: Tensor, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """How far the arm was, at the last sudden sound that the memory holds, from where it is now."""
        ways, is_known = ways_from_onsets(levels, torch.cat(felt, dim=2), self.memory_steps)
        error = functional.smooth_l1_loss(self._predict("way", outputs), ways, beta=_NEAR, reduction="none")
        return error.mean(dim=2), is_known

    def _predict(self, kind: str, inputs: Tensor) -> Tensor:
        return self.heads[kind](inputs).float()  # whatever autocast computed in


def onsets(levels: Tensor, n_frames: int) -> Tensor:
    """Whether a sudden sound begins, at any microphone, in each of the last frames: 0 or 1, (B, n_frames).

    What swells, as the rubbing of a thing that is carried, crosses the first threshold up and down by chance: it has to be
    a jump, too, or nobody could learn to tell it.

    Args:
        levels: (B, more than n_frames, M) [10 dB].
        n_frames: How many frames are asked for.
    """
    louder = levels - levels.sort(dim=1).values[:, (levels.shape[1] - 1) // 2, None]
    loud, sudden = ((rise > _ONSET).any(dim=2) for rise in (louder, levels.diff(dim=1)))
    return (loud[:, 1:] & ~loud[:, :-1] & sudden)[:, -n_frames:].float()


def ways_from_onsets(levels: Tensor, felt: Tensor, memory_steps: int) -> tuple[Tensor, Tensor]:
    """Where the arm was at the last sudden sound that a window remembers, from where it is at the window's end.

    Args:
        levels: (B, more than n, M) [10 dB].
        felt: (B, n, numbers).
        memory_steps: Frames of a window, H.

    Returns:
        (B, K, numbers) with K = n - H + 1, `_FAR` at most; and whether there was such a sound, 0 or 1, (B, K).
    """
    frames = torch.arange(felt.shape[1], device=felt.device)
    last = torch.where(onsets(levels, len(frames)) > 0, frames, -1).cummax(dim=1).values[:, memory_steps - 1 :]
    is_known = last > frames[memory_steps - 1 :] - memory_steps  # (B, K)
    at_sound = last.clamp(min=0).unsqueeze(2).expand(-1, -1, felt.shape[2])
    ways = felt.gather(1, at_sound) - felt[:, memory_steps - 1 :]
    return ways.clamp(-_FAR, _FAR), is_known.to(felt.dtype)
