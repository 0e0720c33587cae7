"""The spectrogram of a microphone's last two seconds, drawn a few columns at a time; drawn as the pictures of datasets are."""

from collections.abc import Callable

import numpy as np

from lerobot_playbyear.audio.sound_picture import PICTURE_PREFIX, SoundPicture
from lerobot_playbyear.datasets.features import AUDIO_PREFIX

_SECONDS = 2.0


class RollingSpectrogram:
    """Columns at fixed moments of a recording: what is drawn once moves to the left and never changes.

    Args:
        sample_rate: [Hz].
        height, width: Of the picture [pixels].
        low_db, high_db: Levels that are black and white [dB].

    Raises:
        InputError: The picture is too large, or the levels are in another order.
    """

    def __init__(self, sample_rate: int, height: int, width: int, low_db: float, high_db: float) -> None:
        wanted = width / _SECONDS
        per_second = min((n for n in range(1, 4 * width) if sample_rate % n == 0), key=lambda n: abs(n - wanted))
        self._hop = sample_rate // per_second
        names = (AUDIO_PREFIX + "microphone", PICTURE_PREFIX + "microphone")
        self._look = SoundPicture(
            *names, sample_rate, per_second, height, width, 1, low_db, high_db, before_episode=(0,) * height
        )
        self._grey = np.zeros((height, width), np.uint8)
        self._n_drawn = 0

    def draw(self, counter: int, samples: Callable[[int, int], np.ndarray]) -> np.ndarray:
        """The picture when `counter` samples had come.

        Args:
            samples: Gives those from one number to before another, (n,) int16.

        Returns:
            (height, width) uint8, low frequencies at the bottom, the newest sound at the right; it is drawn on later.
        """
        n, (_, width) = counter // self._hop, self._grey.shape
        n_new = min(n - self._n_drawn, width)
        if n_new > 0:
            segment = self._look.segment
            sound = samples((n - n_new + 1) * self._hop - segment, n * self._hop)
            segments = np.lib.stride_tricks.sliding_window_view(sound, segment)[:: self._hop]  # (n_new, segment)
            self._grey[:, : width - n_new] = self._grey[:, n_new:]
            self._grey[:, width - n_new :] = self._look.pixels_of(self._look.levels_of(segments)).T[::-1]
            self._n_drawn = n
        return self._grey
