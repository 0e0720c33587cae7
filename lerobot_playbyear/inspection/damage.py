"""Why a dataset's folder cannot be opened, where the reader's own error does not say it."""

from pathlib import Path

from lerobot_playbyear.datasets.repair import DatasetDamagedError, check_dataset

_LISTED = 3


def find_damage(folder: Path) -> str | None:
    """What is wrong with the files of a local dataset, and how to repair it, in one line.

    Args:
        folder: The dataset's root.

    Returns:
        The line, or None if there is no dataset in the folder, or nothing wrong with its files.
    """
    if not (folder / "meta" / "info.json").is_file():
        return None
    try:
        report = check_dataset(folder, thorough=False)
    except DatasetDamagedError as error:
        return " ".join(str(error).split())
    except (OSError, MemoryError) as error:
        return f"it cannot be read now ({error or 'not enough memory'}); that is no damage, and may pass"
    if report.is_sound:
        return None
    lines = [*report.damage, *report.undecided]
    more = f"; and {len(lines) - _LISTED} more" if len(lines) > _LISTED else ""
    first = "Correct by hand what has to be decided, then repair it" if report.undecided else "Repair it"
    return f"{'; '.join(lines[:_LISTED])}{more}. {first}: playbyear-repair --root={folder}"
