"""The card of a dataset: what is in it, how it looks and sounds, how to use it, and a film of one episode."""

import itertools
import json
import logging
import shlex
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from huggingface_hub import HfApi

from lerobot_playbyear.datasets.info import OutsideError
from lerobot_playbyear.datasets.markdown import code, text
from lerobot_playbyear.film.dataset_film import tile
from lerobot_playbyear.film.video import amplify, at_a_rate_of_aac, compose, episode_sound, write_film
from lerobot_playbyear.inspection.source import INTERVENTION, SUCCESS, DatasetSource, Episode
from lerobot_playbyear.inspection.structure import fit_microphones

CARD = "README.md"
FILM = "preview.mp4"

AUDIO_TAGS = ("audio", "multimodal", "playbyear")
"""Tags of a dataset with sound, besides LeRobot's own."""

_MOST_TASKS = 5
_LONGEST_S = 30
_PICTURE_HEIGHT = 336  # pixels, at most
_BLANK = np.zeros((2, 480, 3), np.uint8)  # above the spectrogram of a dataset without cameras

_LISTEN = """```python
from lerobot.datasets import LeRobotDataset
from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.datasets import episode_waveform

dataset = LeRobotDataset({repo_id})
waveform, sample_rate = episode_waveform(dataset, 0, {microphone})  # int16
write_audio("episode_0.wav", waveform, sample_rate)
```"""


@dataclass(frozen=True)
class Preview:
    """What a film shows.

    Args:
        episode: The index of its episode.
        microphones: The keys of those that are heard: the first two where they have one rate, left and right.
        is_whole: Whether it shows the whole episode.
    """

    episode: int
    microphones: tuple[str, ...]
    is_whole: bool


def write_dataset_card(
    source: DatasetSource, repo_id: str, folder: Path, tags: list[str] | None, license: str, film: Path | None
) -> dict[str, Path]:
    """Writes what goes up beside a dataset.

    Args:
        source: The dataset.
        repo_id: Its name on the Hub.
        folder: Where the files are written.
        tags: Besides LeRobot's, and `AUDIO_TAGS` where there is sound.
        license: As the Hub names licences.
        film: What the card shows. None: one is made, unless that fails.

    Returns:
        The files, by their names there: the card, and the film if there is one.

    Raises:
        OutsideError: A picture lies outside the dataset.
    """
    from lerobot.datasets.utils import DatasetInfo, create_lerobot_dataset_card

    preview = None
    if film is None:
        try:
            preview = film_preview(source, folder / FILM)
            film = folder / FILM
        except OutsideError:
            raise
        except Exception:  # a film is not worth an upload
            logging.warning("No film could be made for the dataset's card", exc_info=True)
    url = f"{HfApi().endpoint}/datasets/{repo_id}/resolve/main/{FILM}" if film is not None else None
    card = create_lerobot_dataset_card(
        tags=list(dict.fromkeys([*(tags or []), *(AUDIO_TAGS if source.microphones else [])])),
        dataset_info=DatasetInfo.from_dict(deepcopy(source.info)),
        license=license,
        repo_id=repo_id,
        dataset_description=describe_dataset(source, repo_id, url, preview),
    )
    card.save(folder / CARD)
    return {CARD: folder / CARD} | ({FILM: film} if film is not None else {})


def describe_dataset(source: DatasetSource, repo_id: str, film_url: str | None, preview: Preview | None) -> str:
    """The card's description, in Markdown.

    Args:
        source: The dataset.
        repo_id: Its name on the Hub.
        film_url: Where a film of it is.
        preview: What that film shows; None for a film that somebody made.
    """
    parts = []
    if film_url is not None:
        parts.append(f'<video controls width="480" src="{film_url}"></video>')
    if preview is not None:
        parts.append(_caption(source, preview))
    parts += [_facts(source), "### Use"]
    if source.microphones:
        parts += [
            "A plain LeRobotDataset: every tool that knows LeRobot reads it. A microphone's row holds the samples heard "
            "since the previous frame. To hear an episode, with the plugin lerobot-playbyear:",
            _LISTEN.format(repo_id=_quoted(repo_id), microphone=_quoted(source.microphones[0])),
            "To train a policy that hears:",
            f"```bash\nplaybyear-train --policy.type=playbyear --policy.fps={source.fps} --policy.push_to_hub=false "
            f"--dataset.repo_id={shlex.quote(repo_id)}\n```",
        ]
    else:
        parts.append("A plain LeRobotDataset, without sound: every tool that knows LeRobot reads it.")
    return "\n\n".join(parts)


def _caption(source: DatasetSource, preview: Preview) -> str:
    sound = "without sound"
    if preview.microphones:
        names = " (left) and ".join(code(_short(key)) for key in preview.microphones)
        right = " (right)" if len(preview.microphones) == 2 else ""
        sound = f"with the sound of {names}{right}, amplified; below the picture its spectrogram"
    part = "Episode" if preview.is_whole else "The beginning of episode"
    return f"*{part} {preview.episode} of {len(source.episodes)}, {sound}.*"


def _facts(source: DatasetSource) -> str:
    seconds = len(source) / source.fps
    rows = [
        ("Episodes", f"{len(source.episodes)}, {len(source):,} frames, {seconds:,.0f} s"),
        ("Task", _tasks(source)),
        ("Success", _success(source)),
        ("Expert in control", _interventions(source)),
        ("Frame rate", f"{source.fps} Hz"),
        ("Cameras", "<br>".join(_camera(source, key) for key in source.cameras) or "none"),
        ("Microphones", "<br>".join(_microphone(source, key) for key in source.microphones) or "none"),
        ("Robot", text(str(source.info.get("robot_type") or ""))),
    ]
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows if value)])


def _tasks(source: DatasetSource) -> str:
    tasks = sorted({text(source.task(episode)) for episode in source.episodes} - {""})
    more = f" and {len(tasks) - _MOST_TASKS} more" if len(tasks) > _MOST_TASKS else ""
    return "; ".join(tasks[:_MOST_TASKS]) + more


def _success(source: DatasetSource) -> str:
    if SUCCESS not in source.numbers:
        return ""
    n_solved = sum(source.succeeded(episode) != -1 for episode in source.episodes)
    return f"{n_solved} of {len(source.episodes)} episodes"


def _interventions(source: DatasetSource) -> str:
    if INTERVENTION not in source.numbers:
        return ""
    return f"in {100 * float(np.mean(source.values(INTERVENTION).astype(bool))):.0f} % of the frames"


def _camera(source: DatasetSource, key: str) -> str:
    feature = source.features[key]
    return f"{code(key)}: {' x '.join(str(size) for size in feature['shape'])}, {text(feature['dtype'])}"


def _microphone(source: DatasetSource, key: str) -> str:
    feature = source.features[key]
    rate = (feature.get("info") or {}).get("sample_rate")
    is_known = isinstance(rate, int | float)
    known = f"{rate:,} Hz, " if is_known else f"sample rate {text(str(rate)) if rate else 'unknown'}, "
    return f"{code(key)}: {known}{feature['shape'][0]:,} samples a frame, {text(feature['dtype'])}"


def _short(key: str) -> str:
    return key.rsplit(".", 1)[-1]


def _quoted(name: str) -> str:
    """A name as Python and JSON write it: on one line, so that it cannot end the block of code."""
    return json.dumps(name, ensure_ascii=False)


def film_preview(source: DatasetSource, path: Path) -> Preview:
    """Films the first episode with success, or without any the first, for at most 30 seconds.

    Args:
        source: The dataset.
        path: The mp4 to write.
    """
    solved = [each for each in source.episodes if source.succeeded(each) not in (None, -1)]
    episode = (solved or source.episodes)[0]
    n_frames = min(len(episode), _LONGEST_S * source.fps)
    microphones = _heard_together(source, fit_microphones(source))
    shown = replace(episode, stop=episode.start + n_frames)
    blocks = [
        np.clip(source.sound(key, shown), -32768, 32767).astype(np.int16).reshape(n_frames, -1) for key in microphones
    ]
    stacked = np.stack(blocks, axis=-1) if blocks else np.zeros((n_frames, 0, 0), np.int16)  # (n, S, n_microphones)
    heard, sample_rate = at_a_rate_of_aac(amplify(episode_sound(stacked)), stacked.shape[1] * source.fps)
    pictures, sound = itertools.islice(_pictures(source, shown), n_frames), heard[:]
    write_film(path, compose(pictures, n_frames, sound, sample_rate), source.fps, sound, sample_rate)
    return Preview(episode.index, tuple(microphones), n_frames == len(episode))


def _pictures(source: DatasetSource, episode: Episode) -> Iterator[np.ndarray]:
    if not source.cameras:
        return itertools.repeat(_BLANK)
    streams = {camera: source.pictures(episode, camera) for camera in source.cameras}
    return tile(streams, len(episode), _PICTURE_HEIGHT)[1]


def _heard_together(source: DatasetSource, microphones: list[str]) -> list[str]:
    first_two = microphones[:2]
    rates = {source.features[key]["shape"][0] for key in first_two}
    return first_two if len(rates) == 1 else first_two[:1]
