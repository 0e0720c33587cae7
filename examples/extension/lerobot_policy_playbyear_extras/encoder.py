"""`--policy.audio_encoder=spectrogram_gru`"""

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
