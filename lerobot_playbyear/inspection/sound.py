"""Checks of what each microphone recorded: silence, clipping, offset, gaps, blocks delivered twice.

Levels are in dB of full scale (dBFS), samples in steps of 16-bit PCM whatever the column's dtype.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from lerobot_playbyear.datasets.findings import Finding, Level, name_episodes
from lerobot_playbyear.datasets.frame_rate import sample_rate_of
from lerobot_playbyear.datasets.parquet import stretches
from lerobot_playbyear.datasets.reader import EpisodeRows, SurveyedDataset

FULL_SCALE = 32768.0
"""Of 16-bit PCM, in its steps."""

_QUIET_DBFS = -80.0  # 16-bit PCM has 3 steps of RMS there: hardly anything was heard
_CLIPPED = 32766.0  # steps; at or beyond it a sample may have been cut
_FLAT_TOP = 3  # samples in a row at the same extreme value: the peak was cut, wherever that is
_FLAT_TOP_MIN = 1000.0  # steps; below it equal neighbours are just quantisation
_OFFSET = 0.01  # of full scale
_GAP_S = 0.002
_GAP_EDGE_S = 0.01  # on both sides of a gap there must be live sound for so long
_LIVE_RMS = 8.0  # steps
_BLOCK_SIZES = (64, 128, 160, 256, 320, 480, 512, 1024, 2048, 4096)  # of sound drivers, in addition to the frame's
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

    def add(self, episode: EpisodeRows, spans: list[tuple[int, int]]) -> None:
        if spans:
            self.first = self.first or f"episode {episode.index} at {spans[0][0] / self.sample_rate:.3f} s"
            self.episodes.append(episode.index)
            self.n_spans += len(spans)
            self.n_bad += sum(stop - start for start, stop in spans)

    def verdict(self, check: str, what: str, nothing: str) -> Finding:
        share = self.n_bad / self.n_samples
        figures = {"spans": self.n_spans, "share": share}
        if not self.n_spans:
            return Finding(check, "ok", nothing, self.key, figures=figures)
        level: Level = "error" if share > _TOLERATED_SHARE else "warning"
        message = (
            f"{self.n_spans} {what}, {1000 * self.n_bad / self.sample_rate:.3g} ms in all ({share:.2g} of the sound), in "
            f"{name_episodes(self.episodes)}; the first in {self.first}"
        )
        return Finding(check, level, message, self.key, self.episodes, figures)


def heard(dataset: SurveyedDataset, key: str, episode: EpisodeRows) -> np.ndarray:
    """What a microphone heard in an episode, (n * S,) float32 in steps of 16-bit PCM.

    NaN and infinite samples, a finding of their own, are 0.
    """
    sound = dataset.sound(key, episode)
    if sound.dtype.kind == "f":
        sound = np.nan_to_num(sound * FULL_SCALE, nan=0.0, posinf=0.0, neginf=0.0)
    return sound.astype(np.float32)


def dbfs(rms_steps: float) -> float:
    """Level of an RMS in steps; -120 dBFS for nothing at all."""
    return 20 * math.log10(max(rms_steps / FULL_SCALE, 1e-6))


def runs(mask: np.ndarray, shortest: int = 1) -> list[tuple[int, int]]:
    """First index, and index after the last, of every span of at least `shortest` True in a mask (n,)."""
    return [(start, stop) for start, stop in stretches(mask).tolist() if stop - start >= shortest]


def flat_tops(samples: np.ndarray) -> list[tuple[int, int]]:
    """Spans in which the sound was cut: at full scale, or several equal samples in a row at its own extremes.

    Args:
        samples: (n,) in steps.
    """
    spans = []
    for side, extreme in ((-1, -samples.min()), (1, samples.max())):
        if extreme >= _FLAT_TOP_MIN:
            spans += runs(side * samples >= min(extreme, _CLIPPED), _FLAT_TOP)
    return sorted(spans)


def gaps(samples: np.ndarray, sample_rate: float) -> list[tuple[int, int]]:
    """Spans in which live sound stands still: one exact value, with sound on both sides.

    Args:
        samples: (n,) in steps.
        sample_rate: [Hz].
    """
    shortest, edge = max(round(_GAP_S * sample_rate), 8), max(round(_GAP_EDGE_S * sample_rate), 8)
    found = []
    for start, last in runs(np.diff(samples) == 0, shortest - 1):
        stop = last + 1  # of samples, not of differences
        is_live = min(_rms(samples[max(start - edge, 0) : start]), _rms(samples[stop : stop + edge])) >= _LIVE_RMS
        if is_live and abs(samples[start]) < _FLAT_TOP_MIN:  # otherwise it is cut, not lost
            found.append((start, stop))
    return found


def repeats(samples: np.ndarray, samples_per_frame: int) -> list[tuple[int, int]]:
    """Spans that are a sample-exact copy of the block of live sound before them; those that overlap are one.

    Args:
        samples: (n,) in steps.
        samples_per_frame: S, a block size to try in addition to those of sound drivers.
    """
    merged: list[tuple[int, int]] = []
    sizes = [size for size in {*_BLOCK_SIZES, samples_per_frame} if _BLOCK_SIZES[0] <= size <= len(samples) // 2]
    copies = [(a + size, b + size) for size in sizes for a, b in runs(samples[size:] == samples[:-size], size)]
    for start, stop in sorted(span for span in copies if samples[slice(*span)].std(dtype=np.float64) >= _LIVE_RMS):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(stop, merged[-1][1]))
        else:
            merged.append((start, stop))
    return merged


def check_sound(dataset: SurveyedDataset, key: str) -> Iterator[Finding]:
    """All checks of a microphone whose rows are what its sample rate says."""
    samples_per_frame = dataset.features[key]["shape"][0]
    sample_rate = float(sample_rate_of(samples_per_frame, dataset.fps))
    dead, quiet, offset = [], [], []
    cut, lost, repeated = (_Spans(key, sample_rate, len(dataset) * samples_per_frame) for _ in range(3))
    levels, peak, worst_offset = [], 0.0, 0.0
    for episode in dataset.episodes:
        samples = heard(dataset, key, episode)
        mean = float(samples.mean(dtype=np.float64)) / FULL_SCALE
        levels.append(dbfs(float(samples.std(dtype=np.float64))))
        peak = max(peak, float(np.abs(samples).max()))
        if samples.min() == samples.max():
            dead.append(episode.index)
            continue
        if levels[-1] < _QUIET_DBFS:
            quiet.append(episode.index)
        worst_offset = max(worst_offset, abs(mean))
        if abs(mean) > _OFFSET:
            offset.append(episode.index)
        cut.add(episode, flat_tops(samples))
        lost.add(episode, gaps(samples, sample_rate))
        repeated.add(episode, repeats(samples, samples_per_frame))

    figures = {"rms_dbfs": [round(level, 2) for level in levels], "peak_dbfs": dbfs(peak)}
    span = f"{min(levels):.0f} to {max(levels):.0f} dBFS (RMS per episode), peak {dbfs(peak):.0f} dBFS"
    if dead:
        message = f"{name_episodes(dead)}: one and the same value throughout, the microphone was off"
        yield Finding("silence", "error", message, key, dead, figures)
    if quiet:
        yield Finding("silence", "warning", f"{name_episodes(quiet)}: hardly any sound; {span}", key, quiet, figures)
    if not dead and not quiet:
        yield Finding("silence", "ok", span, key, figures=figures)
    yield cut.verdict("clipping", "cut peaks", "no peak is cut")
    message = f"mean at most {worst_offset:.2%} of full scale"
    if offset:
        message = f"{name_episodes(offset)}: mean up to {worst_offset:.1%} of full scale; a high-pass filter removes it"
    yield Finding("DC offset", "warning" if offset else "ok", message, key, offset, {"largest": worst_offset})
    yield lost.verdict("drop-outs", "spans without a sample that changes", "no gap in live sound")
    yield repeated.verdict("repeated blocks", "spans that copy the block before", "no block came twice")


def _rms(samples: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(samples, dtype=np.float64)))) if len(samples) else 0.0
