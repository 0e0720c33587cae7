"""Checks a local dataset for damage, and repairs it: one of ours, or any LeRobotDataset v3.0.

    playbyear-repair --root=outputs/grasp                  # a recording that was killed, for example
    playbyear-repair --root=outputs/grasp --dry_run=true   # only looks

Every complete episode is kept bit for bit; the damaged dataset stays in a folder beside the repaired one. Where something
cannot be read now, because the disk or the network fails, nothing is changed.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

from lerobot.configs import parser
from lerobot.datasets.utils import INFO_PATH, DatasetInfo
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_playbyear.datasets.repair import DatasetDamagedError, RepairReport, check_dataset, repair_dataset


@dataclass
class RepairConfig:
    """Options of `playbyear-repair`.

    Args:
        root: The dataset's folder.
        like: The folder of a dataset that was recorded with the same settings; needed only where `meta/info.json` is
            lost.
        dry_run: Only say what is wrong.
    """

    root: Path
    like: Path | None = None
    dry_run: bool = False


def repair(cfg: RepairConfig) -> RepairReport:
    """Checks, and unless it is a dry run repairs. Prints what was found.

    Raises:
        DatasetDamagedError: It cannot be repaired, or `like` is no dataset.
        OSError: `like` or the dataset cannot be read now, or the repaired copy cannot be written. Nothing was changed.
        MemoryError: There is not enough of it. Nothing was changed.
    """
    known = {}
    if cfg.like is not None:
        try:
            info = DatasetInfo.from_dict(json.loads((cfg.like / INFO_PATH).read_text()))
            own = {key: feature for key, feature in info.features.items() if key not in DEFAULT_FEATURES}
        except (ValueError, TypeError, AttributeError) as error:
            raise DatasetDamagedError(f"--like={cfg.like}: its {INFO_PATH} is none of a dataset: {error}") from error
        known = {"fps": info.fps, "features": own}
    report = check_dataset(cfg.root, **known) if cfg.dry_run else repair_dataset(cfg.root, **known)
    print(report)
    return report


@parser.wrap()
def _run(cfg: RepairConfig) -> RepairReport:
    return repair(cfg)


def main() -> None:
    """The command; it fails where damage is left."""
    try:
        report = _run()
    except (OSError, MemoryError) as error:
        sys.exit(
            f"error: {str(error) or 'there is not enough memory'}\n"
            "Nothing was changed: that something cannot be read or written now is no damage. Try again when it can."
        )
    except (DatasetDamagedError, ValueError) as error:
        sys.exit(f"error: {error}")
    sys.exit(0 if report.is_sound or report.changed else 1)


if __name__ == "__main__":
    main()
