"""Why a dataset's folder cannot be opened, where the reader's own error does not say it."""

from pathlib import Path

from lerobot_playbyear.datasets.survey import DatasetDamagedError, survey

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
        found = survey(folder, thorough=False)
    except DatasetDamagedError as error:
        return " ".join(str(error).split())
    except (OSError, MemoryError) as error:
        return f"it cannot be read now ({error or 'not enough memory'}); that is no damage, and may pass"
    if found.is_sound:
        return None
    lines = [str(finding) for finding in found.findings if finding.level == "error"]
    more = f"; and {len(lines) - _LISTED} more" if len(lines) > _LISTED else ""
    return f"{'; '.join(lines[:_LISTED])}{more}. Repair it: playbyear-repair --root={folder}"
