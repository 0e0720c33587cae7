"""The policy's ear: waveform in, normalised log-power spectrogram out."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_playbyear.policy.configuration_playbyear import segment_and_hop
from lerobot_playbyear.policy.shared_statistics import mean_over_processes

_POWER_FLOOR = 1e-10  # below 16-bit quantisation noise: -100 dB re full scale
_NOISE_TILT = (0.0, 1.2)  # exponent of 1 / frequency: from white to a little steeper than pink
_NOISE_LOWEST_HZ = 20.0  # below it noise grows no further
_HUM_HZ = (45.0, 75.0)
_HUM_HARMONICS = 4
_HUM_DB = (-20.0, 0.0)  # relative to the broadband noise


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
            "Where an environment's int16 sound was made floats of, let its configuration's get_env_processors name "
            "Pcm16ToFloatProcessorStep (docs/dataset.md)."
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
        """(B, samples) -> (B * n_stretches, samples of a stretch); zeros, or False, where one reaches past the end."""
        stretch = self.length + (self.windows_per_stretch - 1) * self.period * self.step
        start = sound.shape[1] - self.length - (self.n_windows - 1) * self.step
        end = start + (self.n_stretches - 1) * self.step + stretch
        padded = functional.pad(sound[:, start:], (0, end - sound.shape[1]))
        return padded.unfold(1, stretch, self.step).flatten(0, 1)

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
        """(B, samples) in [-1, 1] -> (B, n_bins, n_segments), in units of 10 dB re full scale."""
        spectrum = torch.stft(wave, self.segment, self.hop, window=self.window, center=False, return_complex=True)
        spectrum = torch.view_as_real(spectrum[:, : self.n_bins])
        power = spectrum.square().sum(dim=-1)  # of the bins kept alone, and without a root
        return torch.log10(power * self.scale + _POWER_FLOOR)

    def forward(self, wave: Tensor, begun: Tensor) -> Tensor:
        """Spectrograms in which what precedes the episode is the average sound: zero.

        Args:
            wave: (B, samples), in [-1, 1].
            begun: (B, samples) bool, False where the episode had not begun.

        Returns:
            (B, n_bins, n_segments).
        """
        levels = self.log_power(wave)
        # A segment counts if its first sample does: the episode, once begun, goes on.
        real = begun[:, : wave.shape[1] - self.segment + 1 : self.hop].unsqueeze(1)  # (B, 1, n_segments)
        if self.training and not self.keeps_statistics:
            self._update(levels.detach(), real)
        levels = (levels - self.mean[:, None]) * torch.rsqrt(self.variance + 1e-5)[:, None]
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


def mix_in_noise(wave: Tensor, max_db: float, sample_rate: int) -> Tensor:
    """Adds a room's noise to training sound: broadband, of another colour and level in every item, with a mains-like hum.

    White noise alone teaches nothing about rooms, whose noise is louder the lower it is. Drawn per item, uniformly: the
    level, between 20 dB below the item's own noise floor and `max_db` above it; the tilt, power falling as frequency to the
    power 0 to 1.2; the hum's pitch, 45 to 75 Hz with three overtones; and its level, from 20 dB below the broadband noise to
    as loud.

    Args:
        wave: (B, samples), in [-1, 1].
        max_db: Loudest broadband noise relative to the floor [dB].
        sample_rate: Of the waveform [Hz].

    Returns:
        (B, samples).
    """
    n_items, n_samples = wave.shape
    draws = torch.rand(4, n_items, 1, device=wave.device)
    level, tilt, pitch, hum = (
        low + (high - low) * draw
        for (low, high), draw in zip(((-20.0, max_db), _NOISE_TILT, _HUM_HZ, _HUM_DB), draws, strict=True)
    )
    resolution = sample_rate / n_samples  # [Hz] of a bin
    frequency = resolution * torch.arange(1, n_samples // 2 + 1, device=wave.device)  # without the constant part
    power = frequency.clamp(min=_NOISE_LOWEST_HZ) ** -tilt  # (B, bins)
    power = power / power.sum(dim=1, keepdim=True)
    overtones = torch.arange(1, _HUM_HARMONICS + 1, device=wave.device)
    bins = (pitch * overtones / resolution).round().long().clamp(1, n_samples // 2) - 1  # (B, harmonics)
    power = power.scatter_add(1, bins, (10 ** (hum / 10) / _HUM_HARMONICS).expand(-1, _HUM_HARMONICS))
    spectrum = torch.randn(n_items, n_samples // 2, 2, device=wave.device) * power.sqrt().unsqueeze(2)
    spectrum = functional.pad(spectrum, (0, 0, 1, 0))  # (B, bins + 1, 2)
    noise = torch.fft.irfft(torch.view_as_complex(spectrum), n=n_samples) * (n_samples / 2)  # broadband power 1
    blocks = wave[:, : n_samples // 16 * 16].unflatten(1, (16, -1))
    levels = blocks.square().mean(dim=2).sqrt().sort(dim=1).values  # (B, 16)
    floor = levels[:, 3:4].lerp(levels[:, 4:5], 0.75)  # (B, 1), the first quartile; torch's own asks the host
    return wave + floor * 10 ** (level / 20) * noise
