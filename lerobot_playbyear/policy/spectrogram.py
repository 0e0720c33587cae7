"""The policy's ear: waveform in, normalised log-power spectrogram out."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_playbyear.policy.batch_norm import mean_over_processes
from lerobot_playbyear.policy.configuration_playbyear import segment_and_hop

POWER_FLOOR = 1e-10  # below 16-bit quantisation noise: -100 dB re full scale
EPSILON = 1e-5  # of a variance
_IN_CACHE = 1_000_000  # samples of overlapping segments that a processor's cache holds with what becomes of them


def to_float_wave(wave: Tensor, key: str) -> Tensor:
    """Integers are PCM at full scale, floats are already in [-1, 1].

    Raises:
        ValueError: NaN or infinite samples, or floats far outside [-1, 1].
    """
    if not wave.dtype.is_floating_point:
        return wave.float() / 32768.0
    peak = float(wave.abs().amax()) if wave.numel() else 0.0  # asked once: a GPU is waited for
    if not math.isfinite(peak):
        raise ValueError(f"{key} holds NaN or infinite samples; wanted finite ones. Check the recording.")
    if peak > 1.5:
        raise ValueError(
            f"{key} holds float samples up to {peak:.4g}; wanted floats in [-1, 1], or integers as PCM at full scale. "
            "If an environment's int16 sound was converted to floats, name Pcm16ToFloatProcessorStep in the "
            "get_env_processors of its configuration (docs/reference/dataset_format.md)."
        )
    return wave.float()


@dataclass(frozen=True)
class SharedStretches:
    """Windows of sound that end one frame apart, as a few stretches whose segments they share.

    A window's segments begin at multiples of the hop from the window's own start, so that a frame's and the next frame's
    differ. But every `period` frames they coincide: those windows are slices of one spectrogram, which is computed, and
    convolved, once.

    Attributes:
        n_windows: Windows wanted, the last one at the end of the sound.
        step: Between the windows' ends [samples].
        length: Of a window [samples].
        hop: Between the segments' starts [samples].
    """

    n_windows: int
    step: int
    length: int
    hop: int

    @property
    def period(self) -> int:
        """Frames after which windows have segments in common."""
        return self.hop // math.gcd(self.step, self.hop)

    @property
    def n_stretches(self) -> int:
        return min(self.period, self.n_windows)

    @property
    def windows_per_stretch(self) -> int:
        return math.ceil(self.n_windows / self.period)

    def stretches(self, sound: Tensor) -> Tensor:
        """(B, samples) -> (B, n_stretches, samples of a stretch), a view; zeros, or False, where one reaches past the end."""
        stretch = self.length + (self.windows_per_stretch - 1) * self.period * self.step
        start = sound.shape[1] - self.length - (self.n_windows - 1) * self.step
        end = start + (self.n_stretches - 1) * self.step + stretch
        padded = functional.pad(sound[:, start:], (0, end - sound.shape[1]))
        return padded.unfold(1, stretch, self.step)

    def windows(self, columns: Tensor, n_columns: int) -> Tensor:
        """The windows' parts of what was computed from the stretches' segments.

        Args:
            columns: (B * n_stretches, C, n), a column per segment, perhaps fewer at the edges.
            n_columns: Of one window.

        Returns:
            (B * n_windows, C, n_columns).
        """
        shift = self.period * self.step // self.hop
        parts = columns.unfold(2, n_columns, shift)  # (B * n_stretches, C, windows_per_stretch, n_columns)
        parts = parts.unflatten(0, (-1, self.n_stretches)).permute(0, 3, 1, 2, 4)
        return parts.flatten(1, 2)[:, : self.n_windows].flatten(0, 1)


class LogSpectrogram(nn.Module):
    """Log power of short segments, normalised per frequency bin with running statistics.

    Segments and steps are given in seconds and levels relative to full scale, so that 16 kHz and 48 kHz recordings of the
    same sound look the same (paper, appendix: 1,920 samples at 48 kHz, lowest 160 bins).

    Args:
        sample_rate: Of the waveform [Hz].
        segment_s, hop_s: Length and step of the segments [s].
        n_bins: Lowest frequency bins kept; bin b is at b / segment_s Hz.
        momentum: Weight of the newest batch in the running statistics.

    Attributes:
        keeps_statistics: Whether the running statistics stay as they are in training too.
    """

    window: Tensor
    mean: Tensor
    variance: Tensor
    n_batches: Tensor

    def __init__(self, sample_rate: int, segment_s: float, hop_s: float, n_bins: int, momentum: float = 0.01):
        super().__init__()
        self.segment, self.hop = segment_and_hop(sample_rate, segment_s, hop_s)
        if n_bins > self.segment // 2 + 1:
            raise ValueError(
                f"n_frequency_bins={n_bins} needs a sample rate of at least {2 * n_bins / segment_s:.0f} Hz, got {sample_rate}."
            )
        self.n_bins, self.momentum = n_bins, momentum
        self.keeps_statistics = False
        # Not part of a checkpoint, and in storage of its own: torch's is a slice, which safetensors refuses to save.
        self.register_buffer("window", torch.hann_window(self.segment).clone(), persistent=False)
        # A full-scale sine has power 1 in its bin, whatever the segment's length.
        self.scale = 4.0 / float(self.window.sum()) ** 2
        self.register_buffer("mean", torch.zeros(n_bins))
        self.register_buffer("variance", torch.ones(n_bins))
        self.register_buffer("n_batches", torch.zeros((), dtype=torch.long))

    def log_power(self, wave: Tensor) -> Tensor:
        """(..., samples) in [-1, 1] -> (all of them, n_bins, n_segments), in units of 10 dB re full scale."""
        return torch.log10(self.power(wave) * self.scale + POWER_FLOOR)

    def power(self, wave: Tensor) -> Tensor:
        """(..., samples) in [-1, 1] -> (all of them, n_bins, n_segments); times `scale` a full-scale sine has 1 in its bin."""
        if wave.device.type != "cpu" or torch.compiler.is_compiling():
            return self._power(wave.flatten(0, -2))
        together = max(1, _IN_CACHE * self.hop // (wave.shape[-1] * self.segment))
        overlaps = wave.dim() == 3 and wave.shape[1] > 1  # stretches: never copied, so one item after the other
        items = wave if overlaps else [wave.flatten(0, -2)]
        return torch.cat([self._power(part) for item in items for part in item.split(together)])

    def _power(self, wave: Tensor) -> Tensor:
        spectrum = torch.stft(wave, self.segment, self.hop, window=self.window, center=False, return_complex=True)
        spectrum = spectrum[:, : self.n_bins]  # of the bins kept alone, and without a root
        return spectrum.real.square().addcmul_(spectrum.imag, spectrum.imag)

    def forward(self, wave: Tensor, begun: Tensor, colour: Tensor | None = None) -> Tensor:
        """Spectrograms in which what precedes the episode is the average sound: zero.

        Args:
            wave: (B, samples) or (B, n, samples), in [-1, 1].
            begun: As many bool, False where the episode had not begun.
            colour: (B * n, n_bins), gains of another microphone [10 dB].

        Returns:
            (B * n, n_bins, n_segments).
        """
        # A segment counts if its first sample does: the episode, once begun, goes on.
        real = begun[..., : wave.shape[-1] - self.segment + 1 : self.hop]
        real = real.flatten(0, -2).unsqueeze(1)  # (B * n, 1, n_segments)
        levels = self.log_power(wave)
        if colour is not None:
            levels = levels + colour.unsqueeze(2)
        if self.training and not self.keeps_statistics:
            self._update(levels.detach(), real)
        levels = (levels - self.mean[:, None]) * torch.rsqrt(self.variance + EPSILON)[:, None]
        return levels * real

    def _update(self, levels: Tensor, real: Tensor) -> None:
        weights = real.to(levels.dtype)
        count = mean_over_processes(weights.sum())
        counts = count >= 2  # otherwise nothing changes; a condition in Python would wait for a GPU
        count = count.clamp(min=2)
        mean = mean_over_processes((levels * weights).sum(dim=(0, 2))) / count
        variance = mean_over_processes(((levels - mean[:, None]).square() * weights).sum(dim=(0, 2))) / count
        momentum = torch.where(self.n_batches == 0, 1.0, self.momentum) * counts
        self.mean.lerp_(mean, momentum)
        self.variance.lerp_(variance, momentum)
        self.n_batches += counts
