"""Sound that is read where it is indexed: an episode of hours has gigabytes of it."""

from collections.abc import Iterable, Iterator

import numpy as np
import pyarrow as pa

from lerobot_playbyear.datasets.parquet import column_to_numpy

FULL_SCALE = 32768.0
"""Of 16-bit PCM, in its steps."""

PIECE = 2**20
"""Samples that are looked at together."""

_POWER_FLOOR = 1e-12


class EpisodeSound:
    """What one microphone heard in an episode, (n * S,) float32 in steps of 16-bit PCM.

    Args:
        column: The microphone's rows of the episode, n lists of S samples.
        samples_per_frame: S.
    """

    def __init__(self, column: pa.ChunkedArray, samples_per_frame: int) -> None:
        self.samples_per_frame = samples_per_frame
        self._column = column

    def __len__(self) -> int:
        return len(self._column) * self.samples_per_frame

    def __getitem__(self, span: slice) -> np.ndarray:
        start, stop, _ = span.indices(len(self))
        first, last = start // self.samples_per_frame, -(-max(stop, start) // self.samples_per_frame)
        if first == last:
            return np.empty(0, np.float32)
        samples = column_to_numpy(self._column.slice(first, last - first)).reshape(-1)
        before = first * self.samples_per_frame
        return steps(samples[start - before : stop - before])


Samples = np.ndarray | EpisodeSound
"""Sound (n,) in steps of 16-bit PCM, in memory or not."""


class Runs:
    """Spans of True in a mask that comes in pieces.

    Args:
        shortest: Shorter ones are left out.

    Attributes:
        found: First index, and index after the last, of every span that has ended.
    """

    def __init__(self, shortest: int = 1) -> None:
        self.found: list[tuple[int, int]] = []
        self._shortest = shortest
        self._at = 0
        self._begun: int | None = None  # where the span began that reaches up to the next piece

    def add(self, mask: np.ndarray) -> None:
        """The next piece, (k,) bool."""
        before = np.concatenate([[self._begun is not None], mask[:-1]])
        edges = self._at + np.flatnonzero(mask != before)
        if self._begun is not None:
            edges = np.concatenate([[self._begun], edges])
        self._begun = int(edges[-1]) if len(edges) % 2 else None
        starts, stops = edges[: len(edges) // 2 * 2].reshape(-1, 2).T
        long = stops - starts >= self._shortest
        self.found.extend(zip(starts[long].tolist(), stops[long].tolist(), strict=True))
        self._at += len(mask)

    def finish(self) -> list[tuple[int, int]]:
        """All spans, when there is no further piece."""
        if self._begun is not None and self._at - self._begun >= self._shortest:
            self.found.append((self._begun, self._at))
        self._begun = None
        return self.found


def steps(sound: np.ndarray) -> np.ndarray:
    """Any sound in steps of 16-bit PCM, as float32; NaN and infinite samples, a finding of their own, become 0."""
    if np.issubdtype(sound.dtype, np.floating):
        return np.nan_to_num(sound * FULL_SCALE, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)
    return sound.astype(np.float32)


def pieces(samples: Samples, start: int = 0, stop: int | None = None, size: int = PIECE) -> Iterator[np.ndarray]:
    """A span of sound in parts of `size` samples, the last of them shorter."""
    stop = len(samples) if stop is None else stop
    for first in range(start, stop, size):
        yield samples[first : min(first + size, stop)]


def runs(masks: Iterable[np.ndarray], shortest: int = 1) -> list[tuple[int, int]]:
    """First index, and index after the last, of every span of at least `shortest` True in these pieces of a mask."""
    found = Runs(shortest)
    for mask in masks:
        found.add(mask)
    return found.finish()


def merge(spans: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Spans that overlap or touch as one, in order."""
    merged: list[tuple[int, int]] = []
    for start, stop in sorted(spans):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(stop, merged[-1][1]))
        else:
            merged.append((start, stop))
    return merged


def extremes(samples: Samples) -> tuple[float, float]:
    """The lowest and the highest sample, or 0 if all lie above or below it."""
    low = high = 0.0
    for piece in pieces(samples):
        low, high = min(low, float(piece.min())), max(high, float(piece.max()))
    return low, high


def block_levels(samples: Samples, size: int) -> np.ndarray:
    """Level of every `size` samples, without the mean of all, (n // size,) [dBFS]; -120 for nothing at all."""
    whole = len(samples) // size * size
    if not whole:
        return np.empty(0)
    mean = np.float32(mean_and_deviation(samples)[0])
    power = [
        np.square((piece - mean).reshape(-1, size) / FULL_SCALE, dtype=np.float64).mean(axis=1)
        for piece in pieces(samples, 0, whole, PIECE // size * size or size)
    ]
    return 10 * np.log10(np.concatenate(power) + _POWER_FLOOR)


def mean_and_deviation(samples: Samples, start: int = 0, stop: int | None = None) -> tuple[float, float]:
    """Of a span that is not empty, in steps."""
    n, total, squares = 0, 0.0, 0.0
    for piece in pieces(samples, start, stop):
        exact = piece.astype(np.float64)
        n, total, squares = n + len(exact), total + exact.sum(), squares + np.dot(exact, exact)
    mean = total / n
    return float(mean), float(np.sqrt(max(squares / n - mean * mean, 0.0)))
