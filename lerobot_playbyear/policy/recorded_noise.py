"""Recordings of rooms, radios and tools, of which training sound gets excerpts."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lerobot_playbyear.datasets.audio_files import AudioFileError, audio_pieces, resample
from lerobot_playbyear.datasets.errors import InputError

_ENDINGS = (".wav", ".flac")
_FORMATS = "wav,w64,flac"
_MOST_SECONDS = 7200
_SILENCE = 1e-5  # root mean square
_OCTAVES = 1.0  # up or down, of the speed at which a recording is played


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
            raise InputError(f"{option}: there is no such folder; wanted one with WAV or FLAC files.")
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
        """A stretch of a recording for every item, both drawn evenly, and played at another speed; short recordings repeat.

        A policy must not learn to tell the recordings by their pitch: speeds are drawn from half to twice the recorded one,
        evenly in octaves.

        Returns:
            (n_items, n_samples) float32; over a whole recording the root mean square is 1.
        """
        found = torch.empty(n_items, n_samples)
        lengths = (n_samples * 2 ** (_OCTAVES * (2 * torch.rand(n_items) - 1))).ceil().int().tolist()
        for row, index in enumerate(torch.randint(len(self), (n_items,)).tolist()):
            recording, length = self._recordings[index], lengths[row]
            start = int(torch.randint(len(recording), ()))
            if start + length <= len(recording):
                stretch = recording[start : start + length]
            else:
                stretch = recording[torch.arange(start, start + length) % len(recording)]
            found[row] = functional.interpolate(stretch.float()[None, None], size=n_samples, mode="linear")
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
