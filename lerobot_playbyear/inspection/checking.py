"""Runs all checks over a dataset."""

from collections.abc import Callable, Iterable, Iterator, Sequence

from lerobot_playbyear.inspection.control_checks import check_actions, check_interventions, check_success
from lerobot_playbyear.inspection.onsets import check_alignment
from lerobot_playbyear.inspection.sound_checks import check_sound
from lerobot_playbyear.inspection.source import DatasetSource
from lerobot_playbyear.inspection.structure_checks import (
    check_columns,
    check_finite_numbers,
    check_lengths,
    check_rows,
    check_sample_rates,
    check_statistics,
    fit_microphones,
)
from lerobot_playbyear.inspection.verdict import Verdict


def check_numbers(source: DatasetSource, action_range: Sequence[float] | None = None) -> list[Verdict]:
    """All checks that need no picture, in the order in which a person reads them.

    Args:
        source: The dataset.
        action_range: Lowest and highest action allowed; None: see `check_actions`.
    """
    verdicts: list[Verdict] = []
    verdicts += _guarded("columns", check_columns, source)
    verdicts += _guarded("rows", check_rows, source)
    verdicts += _guarded("episode lengths", check_lengths, source)
    verdicts += _guarded("finite numbers", check_finite_numbers, source)
    verdicts += _guarded("statistics", check_statistics, source)
    verdicts += _guarded("actions", lambda s: check_actions(s, action_range), source)
    verdicts += _guarded("interventions", check_interventions, source)
    verdicts += _guarded("success", check_success, source)
    verdicts += _guarded("sample rate", check_sample_rates, source)
    microphones = fit_microphones(source)
    verdicts += _guarded("sound", lambda s: check_sound(s, microphones), source)
    verdicts += _guarded("sound and motion", lambda s: check_alignment(s, microphones), source)
    return verdicts


def _guarded(
    name: str, check: Callable[[DatasetSource], Iterable[Verdict]], source: DatasetSource
) -> Iterator[Verdict]:
    """A column that cannot be read is a finding; the checks of the others go on."""
    try:
        yield from check(source)
    except ValueError as error:
        yield Verdict(name, "error", " ".join(str(error).split()))
