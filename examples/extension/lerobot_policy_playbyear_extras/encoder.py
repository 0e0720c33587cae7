"""`--policy.audio_encoder=spectrogram_gru`, and `waveform_cnn`, which hears samples instead of a spectrogram."""

from torch import Tensor, nn

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.extension import register_audio_encoder


@register_audio_encoder("spectrogram_gru")
class SpectrogramGRU(nn.Module):
    """Reads a spectrogram column by column and remembers."""

    def __init__(self, config: PlaybyearConfig):
        super().__init__()
        self.embedding_size = 64
        self.gru = nn.GRU(config.n_frequency_bins, self.embedding_size, batch_first=True)

    def forward(self, spectrogram: Tensor) -> Tensor:
        """(N, n_frequency_bins, n_segments) -> (N, embedding_size)."""
        _, last = self.gru(spectrogram.transpose(1, 2))  # (1, N, embedding_size)
        return last[0]


@register_audio_encoder("waveform_cnn")
class WaveformCNN(nn.Module):
    """Convolutions over samples; `--policy.extension_options='{"waveform_cnn": {"channels": 32}}'` makes it wider."""

    hears_waveform = True

    def __init__(self, config: PlaybyearConfig, channels: int = 16):
        super().__init__()
        self.embedding_size = 8 * channels
        self.layers = nn.Sequential(
            nn.Conv1d(1, channels, kernel_size=80, stride=16),
            nn.ReLU(),
            nn.Conv1d(channels, channels, kernel_size=9, stride=4),
            nn.ReLU(),
            nn.AdaptiveAvgPool1d(8),
        )

    def forward(self, wave: Tensor) -> Tensor:
        """(N, window_samples) in [-1, 1] -> (N, embedding_size)."""
        return self.layers(wave.unsqueeze(1)).flatten(1)  # (N, channels, 8) before it is flattened
