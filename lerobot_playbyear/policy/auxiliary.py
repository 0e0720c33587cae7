"""What training predicts beside the action, so that encodings hold more than this action needs. Nothing of it acts.

In comments: B items, K supervised windows of each, M microphones, D numbers in a joint encoding, A in an action, C actions in
a chunk.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.history import newest
from lerobot_playbyear.policy.spectrogram import POWER_FLOOR, LogSpectrogram, to_float_wave

KINDS = ("onset", "balance", "way", "next_sound", "inverse_dynamics", "chunk")
_HEARD = ("onset", "balance", "way", "next_sound")  # a deaf policy is trained without
_HIDDEN = 128
_ONSET = 1.2  # [10 dB] above the item's median frame, as in `datasets.samplers.loud_frames`, and above the frame before
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
        n_actions: Numbers in an action, A.
    """

    def __init__(self, config: PlaybyearConfig, n_actions: int):
        super().__init__()
        self.config = config
        self.factors = weights_of(config)
        size, n_later = config.embedding_size, config.auxiliary_chunk_size - 1
        if self.factors["next_sound"]:
            # Ears of their own, whatever features the policy hears; their statistics are those of single columns.
            self.ears = nn.ModuleList(_ear(config) for _ in config.audio_keys)
        n_heard = config.n_frequency_bins * len(config.audio_keys)
        n_felt = sum(math.prod(config.feature_shape(key)) for key in config.low_dimensional_keys)
        sizes = {
            "onset": (size, config.onset_frames),
            "balance": (size, len(config.audio_keys)),
            "way": (size, n_felt),
            "next_sound": (size + n_actions, n_heard),
            "inverse_dynamics": (2 * size, n_actions),
            "chunk": (size, n_later * n_actions),
        }
        self.heads = nn.ModuleDict({kind: _head(*sizes[kind]) for kind in KINDS if self.factors[kind]})

    def forward(
        self, batch: dict[str, Tensor], encodings: Tensor, outputs: Tensor, actions: Tensor, weight: Tensor
    ) -> Iterator[AuxiliaryLoss]:
        """The losses of a batch.

        Args:
            batch: As `PlaybyearPolicy.forward` gets it.
            encodings: (B, K, D) joint encodings of the frames that the windows end at.
            outputs: (B, K, D) the memory's outputs after the windows.
            actions: (B, K, A) the actions that were taken there.
            weight: (B, K), 0 for windows that are not learned from.
        """
        both = weight[:, :-1] * weight[:, 1:]  # (B, K - 1): of a frame and the next one
        levels = self._levels(batch) if {"onset", "balance", "way"} & set(self.heads) else None
        for kind in self.heads:
            if kind == "onset":
                assert levels is not None
                logits = self._predict(kind, encodings)  # (B, K, n), of the newest frame and the n - 1 before it
                n_frames = logits.shape[2]
                begins = self._onsets(levels, encodings.shape[1] + n_frames - 1).unfold(1, n_frames, 1).flip(2)
                error = functional.binary_cross_entropy_with_logits(logits, begins, reduction="none").mean(dim=2)
                counts = weight
            elif kind == "balance":
                assert levels is not None
                counts = weight * self._onsets(levels, encodings.shape[1])
                shares = (levels[:, -encodings.shape[1] :] * math.log(10)).softmax(dim=2)  # of the power, (B, K, M)
                logits = self._predict(kind, encodings).log_softmax(dim=2)
                error = functional.kl_div(logits, shares, reduction="none").sum(dim=2)
            elif kind == "way":
                assert levels is not None
                ways, is_known = self._ways(batch, levels, encodings.shape[1])
                predicted, counts = self._predict(kind, outputs), weight * is_known
                error = functional.smooth_l1_loss(predicted, ways, beta=_NEAR, reduction="none").mean(dim=2)
            elif kind == "next_sound":
                heard, counts = self._next_columns(batch, both), both  # (B, K - 1, bins)
                error = _squared(self._predict(kind, outputs[:, :-1], actions[:, :-1]), heard)
            elif kind == "inverse_dynamics":
                error = _squared(self._predict(kind, encodings[:, :-1], encodings[:, 1:]), actions[:, :-1])
                counts = both
            else:
                later = actions[:, 1:].unfold(1, self.config.auxiliary_chunk_size - 1, 1)  # (B, K - C + 1, A, C - 1)
                counts = weight.unfold(1, self.config.auxiliary_chunk_size, 1).prod(dim=2)  # (B, K - C + 1)
                error = _squared(self._predict(kind, outputs[:, : later.shape[1]]), later.flatten(2))
            yield AuxiliaryLoss(kind, self.factors[kind], error, counts)

    def _predict(self, kind: str, *inputs: Tensor) -> Tensor:
        return self.heads[kind](torch.cat(inputs, dim=2)).float()  # whatever autocast computed in

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

    def _next_columns(self, batch: dict[str, Tensor], weight: Tensor) -> Tensor:
        """The last spectrogram column of every frame after the first of K, without augmentation, (B, K - 1, bins)."""
        columns = []
        for ear, key in zip(self.ears, self.config.audio_keys, strict=True):
            assert isinstance(ear, LogSpectrogram)
            n_samples = self.config.feature_shape(key)[0]
            n_frames = weight.shape[1] - 1 + math.ceil(ear.segment / n_samples)
            wave = self._sound(batch, key, n_frames).flatten(1)
            wave = wave[:, wave.shape[1] - ear.segment - (weight.shape[1] - 1) * n_samples :]
            ends = wave.unfold(1, ear.segment, n_samples).flatten(0, 1)  # (B * (K - 1), segment)
            begun = (weight.flatten() > 0).unsqueeze(1).expand_as(ends)
            columns.append(ear(ends, begun).squeeze(2).unflatten(0, weight.shape))
        return torch.cat(columns, dim=2).detach()

    def _sound(self, batch: dict[str, Tensor], key: str, n_frames: int) -> Tensor:
        """The newest sound of a microphone, (B, n_frames, S)."""
        return to_float_wave(newest(batch, key, n_frames, self.config.feature_shape(key)), key)


def make_auxiliary(config: PlaybyearConfig, n_actions: int) -> AuxiliaryHeads | None:
    """The heads that a configuration asks for; None where it asks for none."""
    return AuxiliaryHeads(config, n_actions) if any(weights_of(config).values()) else None


def weights_of(config: PlaybyearConfig) -> dict[str, float]:
    """The weight of each of `KINDS`; a policy leaves out what needs more ears than it has, so that all take the same preset."""
    n_ears = len(config.audio_keys) if config.use_audio else 0
    needs = {kind: 2 if kind == "balance" else int(kind in _HEARD) for kind in KINDS}
    return {kind: getattr(config, f"auxiliary_{kind}") if n_ears >= needs[kind] else 0.0 for kind in KINDS}


def _squared(predicted: Tensor, target: Tensor) -> Tensor:
    """(B, n, numbers) -> (B, n)."""
    return (predicted - target).square().mean(dim=2)


def _head(n_in: int, n_out: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(n_in, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, n_out))


def _ear(config: PlaybyearConfig) -> LogSpectrogram:
    assert config.sample_rate is not None
    return LogSpectrogram(
        config.sample_rate, config.segment_s, config.hop_s, config.n_frequency_bins, config.spectrogram_momentum
    )
