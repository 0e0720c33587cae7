"""Recordings of rooms, radios and tools, of which training sound gets excerpts."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lerobot_playbyear.datasets.audio_files import AudioFileError, audio_pieces, resample
from lerobot_playbyear.datasets.errors import InputError

_ENDINGS = (".wav", ".flac")
_FORMATS = "wav,w64,flac"
_MOST_SECONDS = 7200
_SILENCE = 1e-5  # root mean square


class RecordedNoise:
    """The recordings of a folder and its subfolders, in memory, all equally loud.

    Args:
        folder: Of WAV and FLAC files, at most two hours in all; several channels become their mean.
        sample_rate: Of the sound that they are mixed into [Hz].

    Raises:
        InputError: There are none, or one of them cannot be used; the message says which.
    """

    def __init__(self, folder: str | Path, sample_rate: int):
        option, folder = f"--policy.audio_noise_files={folder}", Path(folder)
        if not folder.is_dir():
            raise InputError(f"{option}: there is no such folder; wanted one with WAV or FLAC files, or null.")
        files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _ENDINGS and path.is_file())
        if not files:
            raise InputError(
                f"{option}: the folder holds no {' or '.join(_ENDINGS)} file: put recordings of noise into it."
            )
        self._recordings: list[Tensor] = []
        seconds = 0.0
        for path in files:
            try:
                wave, rate = _mean_of_channels(path, _MOST_SECONDS - seconds)
            except AudioFileError as error:
                raise InputError(f"{option}: {error} Mend the file, or take it out of the folder.") from error
            if wave is None:
                raise InputError(f"{option}: the files last more than {_MOST_SECONDS // 3600} hours: take some out.")
            seconds += len(wave) / rate
            wave = resample(wave, rate, sample_rate)
            level = float(np.sqrt(np.mean(np.square(wave))))
            if level < _SILENCE:
                raise InputError(f"{option}: {path} is silent: take it out of the folder.")
            self._recordings.append(torch.from_numpy(wave / level).half())

    def __len__(self) -> int:
        return len(self._recordings)

    def excerpts(self, n_items: int, n_samples: int) -> Tensor:
        """A stretch of a recording for every item, both drawn evenly; short recordings repeat.

        Returns:
            (n_items, n_samples) float32; over a whole recording the root mean square is 1.
        """
        found = torch.empty(n_items, n_samples)
        for row, index in enumerate(torch.randint(len(self), (n_items,)).tolist()):
            recording = self._recordings[index]
            start = int(torch.randint(len(recording), ()))
            repeated = torch.arange(start, start + n_samples) % len(recording)
            found[row] = (
                recording[repeated] if start + n_samples > len(recording) else recording[start : start + n_samples]
            )
        return found


def _mean_of_channels(path: Path, most_seconds: float) -> tuple[np.ndarray | None, int]:
    """A file's sound, (n,) float32, and its sample rate; None if it is longer than that."""
    parts: list[np.ndarray] = []
    n_samples, rate = 0, 1
    for piece, rate in audio_pieces(path, _FORMATS):
        n_samples += len(piece)
        if n_samples > most_seconds * rate:
            return None, rate
        parts.append(piece.mean(axis=1, dtype=np.float32) / 32768)
    return np.concatenate(parts), rate
