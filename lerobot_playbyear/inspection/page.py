"""The page: one HTML file that holds everything it shows and never asks the network for anything.

Of every episode it has a film, and beside it sound as pictures, curves, spans and moments.
"""

import base64
import contextlib
import hashlib
import html
import io
import json
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lerobot_playbyear.datasets.features import number_names
from lerobot_playbyear.datasets.files import new_file
from lerobot_playbyear.datasets.findings import Finding, summary, worst
from lerobot_playbyear.datasets.frame_rate import sample_rate_of
from lerobot_playbyear.datasets.reader import EpisodeRows, SurveyedDataset
from lerobot_playbyear.film.video import TOP_FREQUENCY, WINDOW_S, encode, gain_of, spectra, tile
from lerobot_playbyear.inspection.motion import INTERVENTION, block_levels, first_success, sudden_sounds
from lerobot_playbyear.inspection.sound import FULL_SCALE, heard, runs
from lerobot_playbyear.inspection.structure import facts, finite

_SCRIPTS = ("data.js", "timeline.js", "panels.js", "player.js", "app.js")
_EPISODES_HERE = "<!-- episodes -->"
_BYTES_AT_ONCE = 3 * 2**18  # a multiple of 3, so that the parts of a film's base64 join

_SHORTEST_HOP_S = 0.005
_MAX_COLUMNS = 1200  # of a spectrogram or waveform: more than a screen shows
_GREY_LEVELS = 64  # of a spectrogram's picture; more cannot be told apart, and cost space
_DARKEST_SHARE = 0.4  # of the levels have the darkest colour: of the background, just something is seen
_LARGEST_RANGE_DB = 100.0
_SAMPLED_EPISODES = 12  # that the range of levels is taken from
_MAX_CURVES = 32  # of one feature
_PREVIEW_COLUMNS = 60
_PREVIEW_RANGE_DB = 45.0


class PageWriter(contextlib.ExitStack):
    """Adds one episode after another to a page; the file is there only when it is complete.

    Args:
        path: The file to write; its folder is made.
        dataset: The dataset.
        picture_height: Of the film [pixels], at most.

    Raises:
        OSError: If the file cannot be written.
    """

    def __init__(self, path: Path, dataset: SurveyedDataset, picture_height: int = 240) -> None:
        super().__init__()
        self._dataset = dataset
        self._data = EpisodeData(dataset)
        self._picture_height = picture_height
        self._index: list[dict[str, Any]] = []
        before, self._after = _skeleton(dataset.repo_id).split(_EPISODES_HERE)
        self._file = self.enter_context(self.enter_context(new_file(path)).open("w", encoding="utf-8"))
        self._file.write(before)

    def add(self, episode: EpisodeRows, pictures: Mapping[str, Iterator[np.ndarray]]) -> None:
        """Writes an episode.

        Args:
            episode: The episode.
            pictures: For each camera the episode's pictures, (H, W, 3) uint8; they are read to their end.
        """
        position = len(self._index)
        widths, frames = tile(pictures, len(episode), self._picture_height)
        self._write("application/json", f"episode-{position}", [_json(self._data.draw(episode))])
        with tempfile.TemporaryDirectory() as folder:
            sound, gain = self._data.sound(episode), self._data.gain
            film = encode(Path(folder) / "film.mp4", frames, len(episode), self._dataset.fps, sound, gain)
            self._write("text/plain", f"film-{position}", _base64_parts(film))
        known = {"index": episode.index, "frames": len(episode), "task": self._dataset.task(episode)}
        seen = {"success": first_success(self._dataset, episode), "widths": widths}
        self._index.append({**known, **seen, "preview": self._data.preview(episode)})

    def finish(self, findings: Sequence[Finding]) -> None:
        """Writes what concerns the whole dataset, and puts the file into its place."""
        known = {"facts": facts(self._dataset), "episodes": self._index, "cameras": self._dataset.cameras}
        drawn = {name: getattr(self._data, name) for name in ("microphones", "gain", "curves")}
        verdicts = [{**finding.to_dict(), "figures": None} for finding in findings]
        judged = {"summary": summary(findings), "worst": worst(findings), "verdicts": verdicts}
        self._write("application/json", "dataset", [_json({**known, **drawn, **judged})])
        self._file.write(self._after)

    def _write(self, kind: str, name: str, parts: Iterable[str]) -> None:
        self._file.write(f'<script type="{kind}" id="{name}">')
        self._file.writelines(parts)
        self._file.write("</script>\n")


def _skeleton(title: str) -> str:
    """The page without data. Its policy allows its own script and style by their hashes, and no connection."""
    folder = files("lerobot_playbyear.inspection") / "page"
    style = (folder / "page.css").read_text(encoding="utf-8")
    scripts = [(folder / name).read_text(encoding="utf-8") for name in _SCRIPTS]
    script = '"use strict";\n(() => {\n' + "\n".join(scripts) + "\n})();\n"
    policy = (
        f"default-src 'none'; script-src '{_hash(script)}'; style-src '{_hash(style)}'; img-src data:; "
        "media-src blob:; base-uri 'none'; form-action 'none'"
    )
    page = (folder / "page.html").read_text(encoding="utf-8")
    parts = {"title": html.escape(title), "policy": policy, "style": style, "script": script}
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], page)  # in one go: a title may hold a mark, too


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _base64_parts(path: Path) -> Iterator[str]:
    """A file's bytes, part by part."""
    with path.open("rb") as file:
        while part := file.read(_BYTES_AT_ONCE):
            yield base64.b64encode(part).decode()


def _json(value: Any) -> str:
    """JSON that every browser reads, and that cannot end the element it stands in."""
    return json.dumps(finite(value), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


# What is drawn


class EpisodeData:
    """Prepares the drawings of one episode after another.

    Args:
        dataset: The dataset; drawn are the microphones whose rows are what their sample rate says.

    Attributes:
        microphones: How each is drawn, the same in all episodes: `key`, its feature; `sample_rate` [Hz]; `peak`, the loudest
            sample of the dataset as a share of full scale; `top_db` and `bottom_db`, levels of the brightest and of the darkest
            colour [dBFS]; `top_hz`, the highest frequency drawn [Hz].
    """

    def __init__(self, dataset: SurveyedDataset) -> None:
        self._dataset = dataset
        self.microphones = [self._measure(key) for key in dataset.timed_microphones]

    @cached_property
    def gain(self) -> float:
        """By how much sound is amplified when it is played, the same in all episodes."""
        return gain_of(max((microphone["peak"] for microphone in self.microphones), default=1.0))

    @cached_property
    def curves(self) -> list[dict[str, Any]]:
        """The features that are drawn as curves, with the range of each dimension in the dataset."""
        observed = [key for key in self._dataset.numbers if key.startswith("observation")]
        wanted = ["observation.state", *observed, "action"]
        if "next.reward" in self._dataset.numbers and len(np.unique(self._dataset.values("next.reward"))) > 2:
            wanted.append("next.reward")  # one of 0 and 1 says no more than the mark of success
        curves = []
        for key in dict.fromkeys(key for key in wanted if key in self._dataset.numbers):
            values = self._dataset.values(key).reshape(len(self._dataset), -1)[:, :_MAX_CURVES].astype(np.float64)
            finite = np.where(np.isfinite(values), values, 0)
            names = number_names(self._dataset.features[key]) or [f"[{i}]" for i in range(values.shape[1])]
            unit = str((self._dataset.features[key].get("info") or {}).get("unit", ""))
            curve = {"key": key, "names": names[: values.shape[1]], "unit": unit}
            curve |= {"low": finite.min(axis=0).tolist(), "high": finite.max(axis=0).tolist()}
            curves.append({**curve, "held": key == "action"})  # until the next frame, so drawn as steps
        return curves

    def sound(self, episode: EpisodeRows) -> list[np.ndarray]:
        """What each microphone heard, in steps of 16-bit PCM."""
        return [heard(self._dataset, microphone["key"], episode) for microphone in self.microphones]

    def draw(self, episode: EpisodeRows) -> dict[str, Any]:
        """Everything but the film, for JSON."""
        dataset = self._dataset
        interventions = None  # or the first and the last frame of each
        if INTERVENTION in dataset.numbers:
            tagged = dataset.values(INTERVENTION, episode).astype(bool)
            interventions = [(start, stop - 1) for start, stop in runs(tagged)]
        drawn = list(map(self._draw_sound, self.microphones, self.sound(episode)))
        curves = [_base64(self._curve(curve["key"], episode)) for curve in self.curves]
        return {"microphones": drawn, "curves": curves, "interventions": interventions}

    def preview(self, episode: EpisodeRows) -> list[int]:
        """The level of the first microphone over the episode, 0 to 99 of its loudest, for the list of episodes."""
        if not self.microphones:
            return []
        sound = heard(self._dataset, self.microphones[0]["key"], episode)
        level = block_levels(sound, len(sound) // len(episode))
        edges = np.linspace(0, len(level), min(_PREVIEW_COLUMNS, len(level)) + 1).astype(int)
        level = np.maximum.reduceat(level, edges[:-1])
        share = 1 + (level - level.max()) / _PREVIEW_RANGE_DB
        return np.clip(99 * share, 0, 99).astype(int).tolist()

    def _measure(self, key: str) -> dict[str, Any]:
        dataset = self._dataset
        rate = sample_rate_of(dataset.features[key]["shape"][0], dataset.fps)
        episodes = dataset.episodes[:: max(len(dataset.episodes) // _SAMPLED_EPISODES, 1)]
        levels = np.concatenate([_levels(heard(dataset, key, episode), rate)[0] for episode in episodes])
        peak = max(float(np.abs(heard(dataset, key, each)).max()) for each in dataset.episodes) / FULL_SCALE
        top = float(np.ceil(levels.max() / 5) * 5)
        bottom = float(np.floor(np.quantile(levels, _DARKEST_SHARE) / 5) * 5)
        bottom = min(max(bottom, top - _LARGEST_RANGE_DB), top - 5)
        drawn = {"top_db": top, "bottom_db": bottom, "top_hz": min(TOP_FREQUENCY, rate / 2)}
        return {"key": key, "sample_rate": rate, "peak": peak, **drawn}

    def _draw_sound(self, microphone: dict[str, Any], samples: np.ndarray) -> dict[str, Any]:
        rate, bottom = microphone["sample_rate"], microphone["bottom_db"]
        levels, hop_s = _levels(samples, rate)  # (columns, bins)
        share = (levels - bottom) / (microphone["top_db"] - bottom)
        grey = np.clip(np.round(share * (_GREY_LEVELS - 1)), 0, _GREY_LEVELS - 1) * (255 // (_GREY_LEVELS - 1))
        onsets = sudden_sounds(samples, rate)
        frame_s = 1 / self._dataset.fps  # the first block was heard before the first picture
        return {
            "spectrogram": _png(grey.astype(np.uint8).T[::-1]),
            "hop": hop_s,
            "wave": _base64(_envelope(samples, max(microphone["peak"] * FULL_SCALE, 1.0))),
            "onsets": [round(float(time) - frame_s, 4) for time in onsets],
        }

    def _curve(self, key: str, episode: EpisodeRows) -> np.ndarray:
        """(n * D,) float32."""
        values = self._dataset.values(key, episode).reshape(len(episode), -1)[:, :_MAX_CURVES]
        return values.astype("<f4").reshape(-1)


def _levels(samples: np.ndarray, sample_rate: int) -> tuple[np.ndarray, float]:
    """Level in frequency bins from 0 Hz to at most 8 kHz, (columns, bins) [dBFS], and the seconds between columns.

    Column j is about the moment (j + 1/2) * hop.
    """
    window = max(round(WINDOW_S * sample_rate), 16)
    hop = max(round(_SHORTEST_HOP_S * sample_rate), -(-len(samples) // _MAX_COLUMNS), 1)
    n_columns = max(len(samples) // hop, 1)
    padded = np.pad(samples, (window, window + hop))
    starts = hop // 2 - window // 2 + hop * np.arange(n_columns) + window
    columns = np.stack([padded[start : start + window] for start in starts.tolist()])  # (columns, window)
    return spectra(columns / FULL_SCALE, sample_rate), hop / sample_rate


def _envelope(samples: np.ndarray, peak: float) -> np.ndarray:
    """Lowest and highest sample of each column as shares of `peak`, (columns * 2,) int8."""
    edges = np.linspace(0, len(samples), min(_MAX_COLUMNS, len(samples)) + 1).astype(int)[:-1]
    extreme = np.stack([np.minimum.reduceat(samples, edges), np.maximum.reduceat(samples, edges)], axis=1) / peak
    return np.clip(np.round(127 * extreme), -127, 127).astype(np.int8).reshape(-1)


def _png(grey: np.ndarray) -> str:
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(grey)).save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
