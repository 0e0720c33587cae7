"""The card of a dataset: what is in it, how it looks and sounds, how to use it, and a film of one episode."""

import itertools
import json
import logging
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
from huggingface_hub import HfApi

from lerobot_playbyear.datasets.info import OutsideError
from lerobot_playbyear.datasets.markdown import code, text
from lerobot_playbyear.datasets.next_command import training_command
from lerobot_playbyear.datasets.reader import SurveyedDataset
from lerobot_playbyear.film.video import compose, film_sound, tile, write_film
from lerobot_playbyear.inspection.motion import INTERVENTION, SUCCESS, first_success
from lerobot_playbyear.inspection.sound import heard

CARD = "README.md"
FILM = "preview.mp4"

AUDIO_TAGS = ("audio", "multimodal", "playbyear")
"""Tags of a dataset with sound, in addition to LeRobot's own."""

_MOST_TASKS = 5
_LONGEST_S = 30
_PICTURE_HEIGHT = 336  # pixels, at most
_BLANK = np.zeros((2, 480, 3), np.uint8)  # above the spectrogram of a dataset without cameras
# With x264's mbtree the same film differs from run to run, and would be sent again.
_REPEATABLE = {"x264-params": "mbtree=0"}

_LISTEN = """```python
from lerobot.datasets import LeRobotDataset
from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.datasets import episode_waveform

dataset = LeRobotDataset({repo_id})
waveform, sample_rate = episode_waveform(dataset, 0, {microphone})  # int16
write_audio("episode_0.wav", waveform, sample_rate)
```"""


def write_dataset_card(
    dataset: SurveyedDataset, repo_id: str, folder: Path, tags: list[str] | None, license: str, film: Path | None
) -> dict[str, Path]:
    """Writes what goes up beside a dataset.

    Args:
        dataset: The dataset.
        repo_id: Its name on the Hub.
        folder: Where the files are written.
        tags: In addition to LeRobot's, and to `AUDIO_TAGS` where there is sound.
        license: As the Hub names licences.
        film: What the card shows. None: one is made, unless that fails.

    Returns:
        The files, by their names there: the card, and the film if there is one.

    Raises:
        OutsideError: A picture lies outside the dataset.
    """
    from lerobot.datasets.utils import DatasetInfo, create_lerobot_dataset_card

    caption = ""
    if film is None:
        try:
            caption = film_preview(dataset, folder / FILM)
            film = folder / FILM
        except OutsideError:
            raise
        except Exception:  # a film is not worth an upload
            logging.warning("No film could be made for the dataset's card", exc_info=True)
    url = f"{HfApi().endpoint}/datasets/{repo_id}/resolve/main/{FILM}" if film is not None else None
    card = create_lerobot_dataset_card(
        tags=list(dict.fromkeys([*(tags or []), *(AUDIO_TAGS if dataset.microphones else [])])),
        dataset_info=DatasetInfo.from_dict(deepcopy(dataset.info)),
        license=license,
        repo_id=repo_id,
        dataset_description=describe_dataset(dataset, repo_id, url, caption),
    )
    card.save(folder / CARD)
    return {CARD: folder / CARD} | ({FILM: film} if film is not None else {})


def describe_dataset(dataset: SurveyedDataset, repo_id: str, film_url: str | None = None, caption: str = "") -> str:
    """The card's description, in Markdown.

    Args:
        dataset: The dataset.
        repo_id: Its name on the Hub.
        film_url: Where a film of it is.
        caption: What that film shows; empty for one that somebody made.
    """
    film = f'<video controls width="480" src="{film_url}"></video>' if film_url is not None else ""
    parts = [*(part for part in (film, caption) if part), _facts(dataset), "### Use"]
    if dataset.microphones:
        parts += [
            "A plain LeRobotDataset: every tool that knows LeRobot reads it. A microphone's row holds the samples heard "
            "since the previous frame. To hear an episode, with the plugin lerobot-playbyear:",
            _LISTEN.format(repo_id=_quoted(repo_id), microphone=_quoted(dataset.microphones[0])),
            "To train a policy that hears:",
            f"```bash\n{training_command(repo_id, dataset.features, preset='cpu')}\n```",
            "On a GPU: `--preset=gpu`.",
        ]
    else:
        parts.append("A plain LeRobotDataset, without sound: every tool that knows LeRobot reads it.")
    return "\n\n".join(parts)


def _facts(dataset: SurveyedDataset) -> str:
    seconds = len(dataset) / dataset.fps
    rows = [
        ("Episodes", f"{len(dataset.episodes)}, {len(dataset):,} frames, {seconds:,.0f} s"),
        ("Task", _tasks(dataset)),
        ("Success", _success(dataset)),
        ("Expert in control", _interventions(dataset)),
        ("Frame rate", f"{dataset.fps} Hz"),
        ("Cameras", "<br>".join(_camera(dataset, key) for key in dataset.cameras) or "none"),
        ("Microphones", "<br>".join(_microphone(dataset, key) for key in dataset.microphones) or "none"),
        ("Robot", text(str(dataset.info.get("robot_type") or ""))),
    ]
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows if value)])


def _tasks(dataset: SurveyedDataset) -> str:
    tasks = sorted({text(dataset.task(episode)) for episode in dataset.episodes} - {""})
    more = f" and {len(tasks) - _MOST_TASKS} more" if len(tasks) > _MOST_TASKS else ""
    return "; ".join(tasks[:_MOST_TASKS]) + more


def _success(dataset: SurveyedDataset) -> str:
    if SUCCESS not in dataset.numbers:
        return ""
    n_solved = sum(first_success(dataset, episode) != -1 for episode in dataset.episodes)
    return f"{n_solved} of {len(dataset.episodes)} episodes"


def _interventions(dataset: SurveyedDataset) -> str:
    if INTERVENTION not in dataset.numbers:
        return ""
    return f"in {100 * float(np.mean(dataset.values(INTERVENTION).astype(bool))):.0f} % of the frames"


def _camera(dataset: SurveyedDataset, key: str) -> str:
    feature = dataset.features[key]
    return f"{code(key)}: {' x '.join(str(size) for size in feature['shape'])}, {text(feature['dtype'])}"


def _microphone(dataset: SurveyedDataset, key: str) -> str:
    feature = dataset.features[key]
    rate = (feature.get("info") or {}).get("sample_rate")
    known = f"{rate:,} Hz, " if isinstance(rate, int | float) else f"sample rate {text(str(rate or 'unknown'))}, "
    return f"{code(key)}: {known}{feature['shape'][0]:,} samples a frame, {text(feature['dtype'])}"


def _quoted(name: str) -> str:
    """A name as Python and JSON write it: on one line, so that it cannot end the block of code."""
    return json.dumps(name, ensure_ascii=False)


def film_preview(dataset: SurveyedDataset, path: Path) -> str:
    """Films the first episode with success, or without any the first, for at most 30 seconds. Returns what it shows."""
    solved = [each for each in dataset.episodes if first_success(dataset, each) not in (None, -1)]
    episode = (solved or dataset.episodes)[0]
    shown = replace(episode, stop=min(episode.stop, episode.start + round(_LONGEST_S * dataset.fps)))
    microphones, n_frames = dataset.timed_microphones, len(shown)
    sound, sample_rate = film_sound([heard(dataset, key, shown) for key in microphones[:2]], n_frames, dataset.fps)
    streams = {camera: dataset.pictures(camera, shown) for camera in dataset.cameras}
    pictures = tile(streams, n_frames, _PICTURE_HEIGHT)[1] if streams else itertools.repeat(_BLANK, n_frames)
    film = compose(pictures, n_frames, sound, sample_rate)
    write_film(path, film, dataset.fps, sound, sample_rate, _REPEATABLE)
    part = "Episode" if n_frames == len(episode) else "The beginning of episode"
    names = [code(key.rsplit(".", 1)[-1]) for key in microphones[: sound.shape[1]]]
    sides = f"{names[0]} (left) and {names[1]} (right)" if len(names) == 2 else "".join(names)
    said = f"with the sound of {sides}, amplified; below the picture its spectrogram" if names else "without sound"
    return f"*{part} {episode.index} of {len(dataset.episodes)}, {said}.*"
