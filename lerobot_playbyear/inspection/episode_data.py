"""What the page draws of an episode besides its film: sound as pictures, curves, spans and moments."""

import base64
import io
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, OBS_STATE, OBS_STR, REWARD
from PIL import Image

from lerobot_playbyear.film.video import TOP_FREQUENCY, WINDOW_S, gain_of, spectra
from lerobot_playbyear.inspection.onsets import sudden_sounds
from lerobot_playbyear.inspection.source import INTERVENTION, DatasetSource, Episode
from lerobot_playbyear.inspection.waveform import FULL_SCALE, PIECE, EpisodeSound, Samples, block_levels, extremes, runs

_SHORTEST_HOP_S = 0.005
_MAX_COLUMNS = 1200  # of a spectrogram or waveform: more than a screen shows
_GREY_LEVELS = 64  # of a spectrogram's picture; more cannot be told apart, and cost space
_DARKEST_SHARE = 0.4  # of the levels have the darkest colour: of the background, just something is seen
_LARGEST_RANGE_DB = 100.0
_SAMPLED_EPISODES = 12  # that the range of levels is taken from
_MAX_CURVES = 32  # of one feature
_PREVIEW_COLUMNS = 60
_PREVIEW_RANGE_DB = 45.0


@dataclass(frozen=True)
class Microphone:
    """How a microphone is drawn, the same in all episodes.

    Args:
        key: Its feature.
        sample_rate: [Hz].
        peak: Loudest sample of the dataset, as a share of full scale.
        top_db: Level of the brightest colour [dBFS].
        bottom_db: Level of the darkest colour [dBFS].
        top_hz: Highest frequency drawn.
    """

    key: str
    sample_rate: int
    peak: float
    top_db: float
    bottom_db: float
    top_hz: float


class EpisodeData:
    """Prepares the drawings of one episode after another.

    Args:
        source: The dataset; its microphones must be in the format's shape.
        microphones: The keys to draw.
    """

    def __init__(self, source: DatasetSource, microphones: Sequence[str]) -> None:
        self._source = source
        self.microphones = [self._measure(key) for key in microphones]

    @cached_property
    def gain(self) -> float:
        """By how much sound is amplified when it is played, the same in all episodes."""
        return gain_of(max((microphone.peak for microphone in self.microphones), default=1.0))

    @cached_property
    def curves(self) -> list[dict[str, Any]]:
        """The features that are drawn as curves, with the range of each dimension in the dataset."""
        wanted = [OBS_STATE, *(key for key in self._source.numbers if key.startswith(OBS_STR)), ACTION]
        if REWARD in self._source.numbers and len(np.unique(self._source.values(REWARD))) > 2:
            wanted.append(REWARD)  # one of 0 and 1 says no more than the mark of success
        curves = []
        for key in dict.fromkeys(key for key in wanted if key in self._source.numbers):
            values = self._source.values(key).reshape(len(self._source), -1)[:, :_MAX_CURVES].astype(np.float64)
            finite = np.where(np.isfinite(values), values, 0)
            curves.append(
                {
                    "key": key,
                    "names": _dimension_names(self._source.features[key], values.shape[1]),
                    "unit": str((self._source.features[key].get("info") or {}).get("unit", "")),
                    "low": finite.min(axis=0).tolist(),
                    "high": finite.max(axis=0).tolist(),
                    "held": key == ACTION,  # until the next frame, so drawn as steps
                }
            )
        return curves

    def sound(self, episode: Episode) -> list[EpisodeSound]:
        """What each microphone heard, in steps of 16-bit PCM."""
        return [self._source.sound(microphone.key, episode) for microphone in self.microphones]

    def draw(self, episode: Episode) -> dict[str, Any]:
        """Everything but the film, for JSON."""
        source = self._source
        interventions = None  # or the first and the last frame of each
        if INTERVENTION in source.numbers:
            tagged = source.values(INTERVENTION)[episode.rows].astype(bool)
            interventions = [(start, stop - 1) for start, stop in runs([tagged])]
        return {
            "microphones": [
                self._draw_sound(*pair) for pair in zip(self.microphones, self.sound(episode), strict=True)
            ],
            "curves": [_base64(self._curve(curve["key"], episode)) for curve in self.curves],
            "interventions": interventions,
        }

    def preview(self, episode: Episode) -> list[int]:
        """The level of the first microphone over the episode, 0 to 99 of its loudest, for the list of episodes."""
        if not self.microphones:
            return []
        sound = self._source.sound(self.microphones[0].key, episode)
        level = block_levels(sound, sound.samples_per_frame)
        edges = np.linspace(0, len(level), min(_PREVIEW_COLUMNS, len(level)) + 1).astype(int)
        level = np.maximum.reduceat(level, edges[:-1])
        share = 1 + (level - level.max()) / _PREVIEW_RANGE_DB
        return np.clip(99 * share, 0, 99).astype(int).tolist()

    def _measure(self, key: str) -> Microphone:
        source = self._source
        rate = source.samples_per_frame(key) * source.fps
        episodes = source.episodes[:: max(len(source.episodes) // _SAMPLED_EPISODES, 1)]
        levels = np.concatenate([_levels(source.sound(key, episode), rate)[0] for episode in episodes])
        peak = max(max(map(abs, extremes(source.sound(key, each)))) for each in source.episodes) / FULL_SCALE
        top = float(np.ceil(levels.max() / 5) * 5)
        bottom = float(np.floor(np.quantile(levels, _DARKEST_SHARE) / 5) * 5)
        return Microphone(
            key=key,
            sample_rate=rate,
            peak=peak,
            top_db=top,
            bottom_db=min(max(bottom, top - _LARGEST_RANGE_DB), top - 5),
            top_hz=min(TOP_FREQUENCY, rate / 2),
        )

    def _draw_sound(self, microphone: Microphone, samples: Samples) -> dict[str, Any]:
        levels, hop_s = _levels(samples, microphone.sample_rate)  # (columns, bins)
        share = (levels - microphone.bottom_db) / (microphone.top_db - microphone.bottom_db)
        grey = np.clip(np.round(share * (_GREY_LEVELS - 1)), 0, _GREY_LEVELS - 1) * (255 // (_GREY_LEVELS - 1))
        onsets = sudden_sounds(samples, microphone.sample_rate)
        frame_s = 1 / self._source.fps  # the first block was heard before the first picture
        return {
            "spectrogram": _png(grey.astype(np.uint8).T[::-1]),
            "hop": hop_s,
            "wave": _base64(_envelope(samples, max(microphone.peak * FULL_SCALE, 1.0))),
            "onsets": [round(float(time) - frame_s, 4) for time in onsets],
        }

    def _curve(self, key: str, episode: Episode) -> np.ndarray:
        """(n * D,) float32."""
        values = self._source.values(key)[episode.rows].reshape(len(episode), -1)[:, :_MAX_CURVES]
        return values.astype("<f4").reshape(-1)


def _levels(samples: Samples, sample_rate: int) -> tuple[np.ndarray, float]:
    """Level in frequency bins from 0 Hz to at most 8 kHz, (columns, bins) [dBFS], and the seconds between columns.

    Column j is about the moment (j + 1/2) * hop.
    """
    window = max(round(WINDOW_S * sample_rate), 16)
    hop = max(round(_SHORTEST_HOP_S * sample_rate), -(-len(samples) // _MAX_COLUMNS), 1)
    n_columns = max(len(samples) // hop, 1)
    samples = samples[:] if len(samples) <= PIECE else samples  # many small reads cost more than one
    starts = hop // 2 - window // 2 + hop * np.arange(n_columns)
    columns = np.stack([_padded(samples, int(start), window) for start in starts])  # (columns, window)
    return spectra(columns / FULL_SCALE, sample_rate), hop / sample_rate


def _padded(samples: Samples, start: int, size: int) -> np.ndarray:
    """A span of sound, with silence where it reaches over its ends."""
    stop = start + size
    inside = samples[max(start, 0) : max(stop, 0)]
    return np.pad(inside, (max(-start, 0), max(stop - max(len(samples), start), 0))) if len(inside) < size else inside


def _envelope(samples: Samples, peak: float) -> np.ndarray:
    """Lowest and highest sample of each column as shares of `peak`, (columns * 2,) int8."""
    samples = samples[:] if len(samples) <= PIECE else samples
    edges = np.linspace(0, len(samples), min(_MAX_COLUMNS, len(samples)) + 1).astype(int).tolist()
    columns = (samples[start:stop] for start, stop in itertools.pairwise(edges))
    extreme = np.array([(column.min(), column.max()) for column in columns]) / peak
    return np.clip(np.round(127 * extreme), -127, 127).astype(np.int8).reshape(-1)


def _dimension_names(feature: dict[str, Any], size: int) -> list[str]:
    names = feature.get("names")
    while isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if isinstance(names, dict):
        names = list(names)
    if isinstance(names, Sequence) and not isinstance(names, str) and len(names) >= size:
        return [str(name) for name in names[:size]]
    return [f"[{i}]" for i in range(size)]


def _png(grey: np.ndarray) -> str:
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(grey)).save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
