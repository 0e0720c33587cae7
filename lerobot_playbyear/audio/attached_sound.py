"""The files of sound that a dataset gets: decoded once, checked against its episodes, and read where they are indexed."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from tqdm import tqdm

from lerobot_playbyear.audio.attach import AttachAudioConfig, AttachError
from lerobot_playbyear.datasets.audio_files import AudioFileError, Cut, Resampled, audio_pieces
from lerobot_playbyear.datasets.parquet import PIECE_BYTES, numpy_to_column
from lerobot_playbyear.datasets.reader import DatasetReader
from lerobot_playbyear.datasets.statistics import Stats, sound_stats


class SpooledFile:
    """The samples of a sound file, (n, channels) int16, decoded to a file of their own.

    Args:
        path: That file.
        n_channels: Of the samples in it.
    """

    def __init__(self, path: Path, n_channels: int) -> None:
        self._path = path
        self.shape = (path.stat().st_size // (2 * n_channels), n_channels)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, span: slice) -> np.ndarray:
        start, stop, _ = span.indices(len(self))
        n_channels = self.shape[1]
        values = np.fromfile(self._path, np.int16, max(stop - start, 0) * n_channels, offset=2 * start * n_channels)
        return values.reshape(-1, n_channels)


@dataclass
class EpisodesSound:
    """The sound of all episodes.

    Args:
        sample_rate: [Hz].
        keys: The columns.
        samples_per_frame: S.
        episodes: For each episode (n_frames * S, columns) int16, read where it is indexed.
    """

    sample_rate: int
    keys: list[str]
    samples_per_frame: int
    episodes: Sequence[Cut | SpooledFile]

    @property
    def rows_at_once(self) -> int:
        """How many frames' sound is in memory together."""
        return max(PIECE_BYTES // (2 * self.samples_per_frame * len(self.keys)), 1)

    def blocks(self, episode: int, start: int, stop: int) -> np.ndarray:
        """Of some of an episode's frames, (n, S, columns) int16.

        Raises:
            ValueError: There are no such frames.
        """
        size = self.samples_per_frame
        n_frames = len(self.episodes[episode]) // size if 0 <= episode < len(self.episodes) else 0
        if not 0 <= start < stop <= n_frames:
            raise ValueError(
                f"it holds frames {start} to {stop - 1} of episode {episode}, for which meta/episodes counts {n_frames}"
            )
        return self.episodes[episode][start * size : stop * size].reshape(-1, size, len(self.keys))

    def columns(self, runs: Sequence[tuple[int, int, int]], schema: pa.Schema) -> list[pa.Array]:
        """For each key the blocks of some frames: of an episode, from one frame to before another. Raises as `blocks`."""
        blocks = np.concatenate([self.blocks(*run) for run in runs])
        return [numpy_to_column(blocks[..., i], schema.field(key).type) for i, key in enumerate(self.keys)]

    def stats(self, episode: int) -> Stats:
        """An episode's statistics."""
        blocks = self.blocks(episode, 0, len(self.episodes[episode]) // self.samples_per_frame)
        return {key: sound_stats(blocks[..., column]) for column, key in enumerate(self.keys)}


_MOST_ERRORS = 10  # that are listed


def read_sound(cfg: AttachAudioConfig, dataset: DatasetReader, keys: list[str], scratch: Path) -> EpisodesSound:
    """Decodes all files, so that what is wrong with them is known before anything is written."""
    offsets = offsets_of(cfg, dataset.meta.total_episodes)
    pattern = str(cfg.files)
    lengths = [int(length) for length in dataset.meta.episodes["length"]]
    errors: list[str] = []
    rates: dict[int, int] = {}
    episodes: list[Cut] = []
    for episode, length in enumerate(tqdm(lengths, desc="Reading sound", unit="episode")):
        path = Path(_format(pattern, episode))
        try:
            samples, rate = spool(cfg, path, len(keys), scratch / str(episode))
            rates[episode] = checked_rate(cfg, rate, dataset.fps)
            resampled = Resampled(samples, rate, rates[episode])
            episodes.append(Cut(resampled, rates[episode], dataset.fps, length, offsets[episode], cfg.pad))
        except (AudioFileError, ValueError) as error:
            errors.append(f"episode {episode}, {path}: {error}")
    if len(set(rates.values())) > 1:
        each = ", ".join(
            f"{rate} Hz (episode {list(rates.values()).index(rate)})" for rate in sorted(set(rates.values()))
        )
        errors.append(f"the files have different sample rates, {each}. Give --sample_rate to resample them.")
    raise_all(errors)
    return EpisodesSound(rates[0], keys, rates[0] // dataset.fps, episodes)


def checked_rate(cfg: AttachAudioConfig, own_rate: int, fps: int) -> int:
    """The rate that a file of the rate `own_rate` is to have [Hz].

    Raises:
        AudioFileError: The frame rate does not divide it.
    """
    rate = cfg.sample_rate or own_rate
    if rate % fps:
        raise AudioFileError(
            f"it has {own_rate} samples per second, which is no multiple of {fps} frames per second. "
            f"Resample it, for example with --sample_rate={max(1, round(own_rate / fps)) * fps}."
        )
    return rate


def raise_all(errors: list[str]) -> None:
    """Ends with what is wrong with sound, the first of it where it is much.

    Raises:
        AttachError: If there is anything.
    """
    if errors:
        more = f"\n  ... and {len(errors) - _MOST_ERRORS} more" if len(errors) > _MOST_ERRORS else ""
        raise AttachError("Nothing was written.\n  " + "\n  ".join(errors[:_MOST_ERRORS]) + more)


def spool(cfg: AttachAudioConfig, path: Path, n_microphones: int, target: Path) -> tuple[SpooledFile, int]:
    """Decodes the channels of a file that are wanted; the samples, and their rate [Hz]."""
    rate = 0
    with target.open("wb") as file:
        for samples, found in audio_pieces(path):
            rate = found
            file.write(np.ascontiguousarray(_choose_channels(cfg, samples, n_microphones)).tobytes())
    return SpooledFile(target, n_microphones), rate


def _format(pattern: str, episode: int) -> str:
    try:
        return pattern.format(episode=episode)
    except (KeyError, IndexError, ValueError) as error:
        raise AttachError(
            f"--files={pattern} cannot be filled in: {error}. Only {{episode}} may stand in it."
        ) from error


def offsets_of(cfg: AttachAudioConfig, n_episodes: int) -> list[float]:
    """The offset of each episode [s], from the options.

    Raises:
        AttachError: `offsets` is no list of as many numbers.
    """
    offset = cfg.offset or 0.0
    if cfg.offsets is None:
        return [offset] * n_episodes
    try:
        values = [float(value) for value in json.loads(cfg.offsets.read_text())]
    except (OSError, ValueError, TypeError) as error:
        raise AttachError(f"--offsets={cfg.offsets} is no list of numbers in JSON: {error}") from error
    if len(values) != n_episodes:
        raise AttachError(f"--offsets={cfg.offsets} has {len(values)} values; the dataset has {n_episodes} episodes.")
    return [offset + value for value in values]


def _choose_channels(cfg: AttachAudioConfig, samples: np.ndarray, n_microphones: int) -> np.ndarray:
    n_channels = samples.shape[1]
    if cfg.channel is not None:
        if not 0 <= cfg.channel < n_channels:
            raise AudioFileError(f"it has {n_channels} channels; there is no --channel={cfg.channel}.")
        return samples[:, [cfg.channel]]
    if n_channels != n_microphones:
        raise AudioFileError(
            f"it has {n_channels} channels, and --microphone names {n_microphones}. Choose one with --channel=0, or "
            "name a microphone for each, separated by commas."
        )
    return samples
