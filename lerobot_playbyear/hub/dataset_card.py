"""What the card of a dataset says: what is in it, how it looks and sounds, and how to use it."""

import json
import shlex

import numpy as np

from lerobot_playbyear.datasets.markdown import code, text
from lerobot_playbyear.hub.preview import Preview
from lerobot_playbyear.inspection.source import INTERVENTION, SUCCESS, DatasetSource

AUDIO_TAGS = ("audio", "multimodal", "playbyear")
"""Tags of a dataset with sound, besides LeRobot's own."""

_MOST_TASKS = 5

_LISTEN = """```python
from lerobot.datasets import LeRobotDataset
from lerobot_playbyear.datasets import episode_waveform, write_audio

dataset = LeRobotDataset({repo_id})
waveform, sample_rate = episode_waveform(dataset, 0, {microphone})  # int16
write_audio("episode_0.wav", waveform, sample_rate)
```"""


def card_tags(source: DatasetSource, tags: list[str] | None = None) -> list[str]:
    """The card's tags besides "LeRobot": those given, and `AUDIO_TAGS` where there is sound."""
    return list(dict.fromkeys([*(tags or []), *(AUDIO_TAGS if source.microphones else [])]))


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
        ("Robot", text(str(source.dataset.meta.robot_type or ""))),
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
