"""What a robot's recording noted: sound that is missing, and ticks that came late."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lerobot_playbyear.datasets.recording_notes import recording_notes
from lerobot_playbyear.inspection.source import DatasetSource
from lerobot_playbyear.inspection.verdict import Verdict, name_episodes

_LATE_SHARE = 0.01
_LATE_MS = 5


def check_recording(source: DatasetSource) -> Iterator[Verdict]:
    """Drop-outs of microphones and late ticks, of episodes that a robot recorded; nothing where none are noted."""
    shown = {episode.index for episode in source.episodes}
    notes = {index: note for index, note in recording_notes(Path(source.dataset.root)).items() if index in shown}
    if not notes:
        return
    drops = {index: _n_drop_outs(note) for index, note in notes.items()}
    with_drops = [index for index in sorted(drops) if drops[index]]
    figures: dict[str, Any] = {"drop_outs": {str(index): drops[index] for index in with_drops}}
    if with_drops:
        total = sum(drops.values())
        message = f"{total} place{'s' if total > 1 else ''} without sound, or with sound left out ({name_episodes(with_drops)})"
        yield Verdict("drop-outs noted", "warning", message, None, with_drops, figures)
    else:
        yield Verdict("drop-outs noted", "ok", f"none in {len(notes)} episodes", figures=figures)
    ticks, late = (sum(_whole(note.get(name)) for note in notes.values()) for name in ("ticks", "late_ticks"))
    if ticks:
        share = late / ticks
        message = f"{late} of {ticks} came more than {_LATE_MS} ms late ({share:.1%})"
        yield Verdict(
            "ticks", "warning" if share > _LATE_SHARE else "ok", message, figures={"ticks": ticks, "late": late}
        )


def _n_drop_outs(note: dict[str, Any]) -> int:
    by_microphone = note.get("drop_outs")
    lists = (
        [each for each in by_microphone.values() if isinstance(each, list)] if isinstance(by_microphone, dict) else []
    )
    return max((len(each) for each in lists), default=0)  # the channels of a card lose the same


def _whole(value: Any) -> int:
    return value if isinstance(value, int) and 0 <= value < 2**53 else 0
