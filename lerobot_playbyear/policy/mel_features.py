"""Other ears than the paper's: log-mel bands, and bands whose energy is normalised by its own recent past (PCEN)."""

import torch
from torch import Tensor
from torchaudio.functional import melscale_fbanks

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.spectrogram import POWER_FLOOR, LogSpectrogram

_PCM_STEP_POWER = (
    32768.0**2
)  # full scale squared, in squared steps of 16-bit PCM, for which PCEN's numbers were published
_GAIN, _BIAS, _ROOT, _EPSILON = 0.98, 2.0, 0.5, 1e-6  # alpha, delta, r and epsilon of Wang et al., table 1
_SMOOTHER_S = 0.4  # their smoother keeps 0.975 per step of 10 ms: a time constant of 0.4 s


class LogMel(LogSpectrogram):
    """Log power of mel bands over the kept bins of the spectrogram, normalised as that is.

    Bands are the triangles of O'Shaughnessy's scale (HTK), equally wide on it from 0 Hz to the last bin, each with the mean
    power of its bins.
    """

    mel: Tensor

    def __init__(self, sample_rate: int, segment_s: float, hop_s: float, n_bins: int, momentum: float, n_mels: int):
        super().__init__(sample_rate, segment_s, hop_s, n_bins, momentum, n_mels)
        # n_bins as torchaudio counts them: of the whole spectrum of a sound that ends with the last bin.
        mel = melscale_fbanks(n_bins, 0.0, (n_bins - 1) / segment_s, n_mels, round(2 * (n_bins - 1) / segment_s))
        if bool((mel.sum(dim=0) == 0).any()):
            raise ValueError(
                f"--policy.n_mels={n_mels}: some bands are narrower than the {1 / segment_s:g} Hz of a bin: "
                "give fewer, or a longer --policy.segment_s."
            )
        self.register_buffer("mel", mel / mel.sum(dim=0), persistent=False)  # (n_bins, n_mels)

    def levels(self, wave: Tensor, real: Tensor, colour: Tensor | None) -> Tensor:
        """(..., samples) -> (all of them, n_mels, n_segments), in units of 10 dB re full scale."""
        return torch.log10(self.energies(wave, colour) + POWER_FLOOR)

    def energies(self, wave: Tensor, colour: Tensor | None) -> Tensor:
        """(..., samples) -> mean power in every band (all, n_mels, n_segments), in which a full-scale sine's bin has 1."""
        power = self.power(wave) * self.scale  # (B, n_bins, n_segments)
        if colour is not None:
            power = power * 10 ** colour.unsqueeze(2)
        with torch.autocast(wave.device.type, enabled=False):  # power spans more than bfloat16 can tell apart
            return self.mel.T @ power


class Pcen(LogMel):
    """Per-channel energy normalisation: a band's energy over its own average of the last 0.4 s, and a root.

    Wang et al., "Trainable Frontend For Robust and Far-Field Keyword Spotting" (ICASSP 2017), with the numbers published
    there. Steady noise, however loud, becomes nearly the same small number; what begins stands out. The average begins anew
    with every window of sound, its weights those of theirs brought to a sum of 1, and leaves out what precedes the episode: so
    a window looks the same whether the policy learns or acts, which an average over all of the past would not give.
    """

    is_per_window = True

    def levels(self, wave: Tensor, real: Tensor, colour: Tensor | None) -> Tensor:
        """One window each, (..., samples) -> (all of them, n_mels, n_segments)."""
        energies = _PCM_STEP_POWER * self.energies(wave, colour)
        smooth = self._average(energies, real.to(energies.dtype))
        return (energies / (_EPSILON + smooth) ** _GAIN + _BIAS) ** _ROOT - _BIAS**_ROOT

    def _average(self, energies: Tensor, real: Tensor) -> Tensor:
        """Of every column and those before it, (B, n_mels, n_segments); `real` is 0 for columns that do not count."""
        column = torch.arange(energies.shape[2], device=energies.device)
        age = column.unsqueeze(0) - column.unsqueeze(1)  # (from, to)
        keep = torch.exp(-age.clamp(min=0) * (self.hop / self.sample_rate / _SMOOTHER_S)) * (age >= 0)
        with torch.autocast(energies.device.type, enabled=False):
            return (energies * real) @ keep / (real @ keep).clamp(min=1e-6)


def make_ear(config: PlaybyearConfig) -> LogSpectrogram:
    """One microphone's front end, the one that `--policy.audio_features` names."""
    assert config.sample_rate is not None
    numbers = (
        config.sample_rate,
        config.segment_s,
        config.hop_s,
        config.n_frequency_bins,
        config.spectrogram_momentum,
    )
    if config.audio_features == "spectrogram":
        return LogSpectrogram(*numbers)
    return {"log_mel": LogMel, "pcen": Pcen}[config.audio_features](*numbers, config.n_mels)
