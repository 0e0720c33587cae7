"""Checks of what each microphone recorded: silence, clipping, offset, gaps, blocks delivered twice.

Levels are in dB of full scale (dBFS), samples in steps of 16-bit PCM whatever the column's dtype.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from lerobot_playbyear.inspection.source import DatasetSource, Episode
from lerobot_playbyear.inspection.verdict import Level, Verdict, name_episodes

FULL_SCALE = 32768.0

_QUIET_DBFS = -80.0  # 16-bit PCM has 3 steps of RMS there: hardly anything was heard
_CLIPPED = 32766.0  # steps; at or beyond it a sample may have been cut
_FLAT_TOP = 3  # samples in a row at the same extreme value: the peak was cut, wherever that is
_FLAT_TOP_MIN = 1000.0  # steps; below it equal neighbours are just quantisation
_OFFSET = 0.01  # of full scale
_GAP_S = 0.002
_GAP_EDGE_S = 0.01  # on both sides of a gap there must be live sound for so long
_LIVE_RMS = 8.0  # steps
_BLOCK_SIZES = (64, 128, 160, 256, 320, 480, 512, 1024, 2048, 4096)  # of sound drivers, besides the frame's
_TOLERATED_SHARE = 0.01  # of the samples: more makes a warning an error


@dataclass
class _Spans:
    """Spans of bad sound that one check found in the episodes of one microphone."""

    key: str
    sample_rate: float
    n_samples: int
    episodes: list[int] = field(default_factory=list)
    n_spans: int = 0
    n_bad: int = 0
    first: str = ""

    def add(self, episode: Episode, spans: list[tuple[int, int]]) -> None:
        if spans:
            self.first = self.first or f"episode {episode.index} at {spans[0][0] / self.sample_rate:.3f} s"
            self.episodes.append(episode.index)
            self.n_spans += len(spans)
            self.n_bad += sum(stop - start for start, stop in spans)

    def verdict(self, check: str, what: str, nothing: str) -> Verdict:
        share = self.n_bad / self.n_samples
        figures = {"spans": self.n_spans, "share": share}
        if not self.n_spans:
            return Verdict(check, "ok", nothing, self.key, figures=figures)
        level: Level = "error" if share > _TOLERATED_SHARE else "warning"
        message = (
            f"{self.n_spans} {what}, {1000 * self.n_bad / self.sample_rate:.3g} ms in all ({share:.2g} of the sound), in "
            f"{name_episodes(self.episodes)}; the first in {self.first}"
        )
        return Verdict(check, level, message, self.key, self.episodes, figures)


def check_sound(source: DatasetSource, microphones: Sequence[str]) -> Iterator[Verdict]:
    """All checks of these microphones, whose rows must be what their sample rate says."""
    for key in microphones:
        yield from _check_microphone(source, key)


def steps(sound: np.ndarray) -> np.ndarray:
    """Any sound in steps of 16-bit PCM, as float32; NaN and infinite samples, a finding of their own, become 0."""
    if np.issubdtype(sound.dtype, np.floating):
        return np.nan_to_num(sound * FULL_SCALE, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)
    return sound.astype(np.float32)


def dbfs(rms_steps: float) -> float:
    """Level of an RMS in steps; -120 dBFS for nothing at all."""
    return 20 * math.log10(max(rms_steps / FULL_SCALE, 1e-6))


def flat_tops(samples: np.ndarray) -> list[tuple[int, int]]:
    """Spans in which the sound was cut: at full scale, or several equal samples in a row at its own extremes.

    Args:
        samples: (n,) in steps.
    """
    spans = []
    for extreme in (samples.max(initial=0), samples.min(initial=0)):
        if abs(extreme) >= _FLAT_TOP_MIN:
            limit = min(abs(extreme), _CLIPPED)
            spans += [span for span in _spans(np.sign(extreme) * samples >= limit) if span[1] - span[0] >= _FLAT_TOP]
    return sorted(spans)


def gaps(samples: np.ndarray, sample_rate: float) -> list[tuple[int, int]]:
    """Spans in which live sound stands still: one exact value, with sound on both sides.

    Args:
        samples: (n,) in steps.
        sample_rate: [Hz].
    """
    shortest, edge = max(round(_GAP_S * sample_rate), 8), max(round(_GAP_EDGE_S * sample_rate), 8)
    found = []
    for start, stop in _spans(np.diff(samples) == 0):
        start, stop = start, stop + 1  # of samples, not of differences
        before, after = samples[max(start - edge, 0) : start], samples[stop : stop + edge]
        is_live = min(_rms(before), _rms(after)) >= _LIVE_RMS
        is_peak = abs(samples[start]) >= _FLAT_TOP_MIN  # cut, not lost
        if stop - start >= shortest and is_live and not is_peak:
            found.append((start, stop))
    return found


def repeats(samples: np.ndarray, samples_per_frame: int) -> list[tuple[int, int]]:
    """Spans that are a sample-exact copy of the block of live sound before them.

    Args:
        samples: (n,) in steps.
        samples_per_frame: S, a block size to try besides those of sound drivers.
    """
    taken = np.zeros(len(samples), bool)
    for size in sorted({*_BLOCK_SIZES, samples_per_frame}):
        if size < _BLOCK_SIZES[0] or len(samples) < 2 * size:
            continue
        for start, stop in _spans(samples[size:] == samples[:-size]):
            if stop - start >= size and samples[start + size : stop + size].std() >= _LIVE_RMS:
                taken[start + size : stop + size] = True
    return _spans(taken)


def _check_microphone(source: DatasetSource, key: str) -> Iterator[Verdict]:
    sound = source.sound(key)
    sample_rate = float(sound.shape[1] * source.fps)
    dead, quiet, offset = [], [], []
    cut, lost, repeated = (_Spans(key, sample_rate, sound.size) for _ in range(3))
    levels, peak, worst_offset = [], 0.0, 0.0
    for episode in source.episodes:
        samples = steps(sound[episode.rows]).reshape(-1)
        levels.append(dbfs(_rms(samples - samples.mean())))
        peak = max(peak, float(np.abs(samples).max()))
        if np.ptp(samples) == 0:
            dead.append(episode.index)
            continue
        if levels[-1] < _QUIET_DBFS:
            quiet.append(episode.index)
        mean = float(samples.mean()) / FULL_SCALE
        worst_offset = max(worst_offset, abs(mean))
        if abs(mean) > _OFFSET:
            offset.append(episode.index)
        cut.add(episode, flat_tops(samples))
        lost.add(episode, gaps(samples, sample_rate))
        repeated.add(episode, repeats(samples, sound.shape[1]))

    figures = {"rms_dbfs": [round(level, 2) for level in levels], "peak_dbfs": dbfs(peak)}
    span = f"{min(levels):.0f} to {max(levels):.0f} dBFS (RMS per episode), peak {dbfs(peak):.0f} dBFS"
    if dead:
        message = f"{name_episodes(dead)}: one and the same value throughout, the microphone was off"
        yield Verdict("silence", "error", message, key, dead, figures)
    if quiet:
        yield Verdict("silence", "warning", f"{name_episodes(quiet)}: hardly any sound; {span}", key, quiet, figures)
    if not dead and not quiet:
        yield Verdict("silence", "ok", span, key, figures=figures)
    yield cut.verdict("clipping", "cut peaks", "no peak is cut")
    if offset:
        message = (
            f"{name_episodes(offset)}: mean up to {worst_offset:.1%} of full scale; remove it with a high-pass filter"
        )
        yield Verdict("DC offset", "warning", message, key, offset, {"largest": worst_offset})
    else:
        message = f"mean at most {worst_offset:.2%} of full scale"
        yield Verdict("DC offset", "ok", message, key, figures={"largest": worst_offset})
    yield lost.verdict("drop-outs", "spans without a sample that changes", "no gap in live sound")
    yield repeated.verdict("repeated blocks", "spans that copy the block before", "no block came twice")


def _rms(samples: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(samples, dtype=np.float64)))) if len(samples) else 0.0


def _spans(mask: np.ndarray) -> list[tuple[int, int]]:
    """First index, and index after the last, of every span of True, from (n,) bool."""
    if not mask.any():
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
