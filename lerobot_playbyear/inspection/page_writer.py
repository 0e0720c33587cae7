"""Writes the page: one HTML file that holds everything it shows and never asks the network for anything."""

import base64
import hashlib
import html
import json
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_playbyear.inspection.episode_data import EpisodeData
from lerobot_playbyear.inspection.film import encode, tile
from lerobot_playbyear.inspection.report import dataset_facts, finite, summary
from lerobot_playbyear.inspection.source import DatasetSource, Episode
from lerobot_playbyear.inspection.structure_checks import fit_microphones
from lerobot_playbyear.inspection.verdict import Verdict, worst

_SCRIPTS = ("data.js", "timeline.js", "panels.js", "player.js", "app.js")
_EPISODES_HERE = "<!-- episodes -->"
_BYTES_AT_ONCE = 3 * 2**18  # a multiple of 3, so that the parts of a film's base64 join


class PageWriter:
    """Adds one episode after another to a page; the file is there only when it is complete.

    Args:
        path: The file to write; its folder is made.
        source: The dataset.
        picture_height: Of the film [pixels], at most.

    Raises:
        OSError: If the file cannot be written.
    """

    def __init__(self, path: Path, source: DatasetSource, picture_height: int = 240) -> None:
        self.path = path
        self._source = source
        self._data = EpisodeData(source, fit_microphones(source))
        self._picture_height = picture_height
        self._index: list[dict[str, Any]] = []
        self._partial = path.with_name(f".{path.name}.partial")
        path.parent.mkdir(parents=True, exist_ok=True)
        before, self._after = _skeleton(source.dataset.repo_id).split(_EPISODES_HERE)
        self._file = self._partial.open("w", encoding="utf-8")
        self._file.write(before)

    def __enter__(self) -> "PageWriter":
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()
        self._partial.unlink(missing_ok=True)

    def add(self, episode: Episode, pictures: Mapping[str, Iterator[np.ndarray]]) -> None:
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
            film = encode(Path(folder) / "film.mp4", frames, len(episode), self._source.fps, sound, gain)
            self._write("text/plain", f"film-{position}", _base64(film))
        self._index.append(
            {
                "index": episode.index,
                "frames": len(episode),
                "task": self._source.task(episode),
                "success": self._source.succeeded(episode),
                "widths": widths,
                "preview": self._data.preview(episode),
            }
        )

    def finish(self, verdicts: Sequence[Verdict]) -> Path:
        """Writes what concerns the whole dataset, and puts the file into its place."""
        dataset = {
            "facts": dataset_facts(self._source),
            "episodes": self._index,
            "cameras": self._source.cameras,
            "microphones": [asdict(microphone) for microphone in self._data.microphones],
            "gain": self._data.gain,
            "curves": self._data.curves,
            "summary": summary(verdicts),
            "worst": worst(verdicts),
            "verdicts": [{**verdict.to_dict(), "figures": None} for verdict in verdicts],
        }
        self._write("application/json", "dataset", [_json(dataset)])
        self._file.write(self._after)
        self._file.close()
        os.replace(self._partial, self.path)
        return self.path

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


def _base64(path: Path) -> Iterator[str]:
    """A file's bytes, part by part."""
    with path.open("rb") as file:
        while part := file.read(_BYTES_AT_ONCE):
            yield base64.b64encode(part).decode()


def _json(value: Any) -> str:
    """JSON that every browser reads, and that cannot end the element it stands in."""
    return json.dumps(finite(value), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
