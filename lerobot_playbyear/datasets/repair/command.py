"""`playbyear-repair`: says what is wrong with a dataset, and puts it right. LeRobot is imported where there is a dataset."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_playbyear.datasets.files import INFO_PATH

if TYPE_CHECKING:
    from lerobot_playbyear.datasets.repair.report import RepairReport


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


def repair(cfg: RepairConfig) -> "RepairReport":
    """Checks, and unless it is a dry run repairs. Prints what was found.

    Raises:
        ValueError: It cannot be repaired, or it or `like` is no dataset.
        OSError: `like` or the dataset cannot be read now, or the repaired copy cannot be written. Nothing was changed.
        MemoryError: There is not enough of it. Nothing was changed.
    """
    _check_root(cfg.root)
    from lerobot_playbyear.datasets.repair.repairing import check_dataset, repair_dataset

    known = {} if cfg.like is None else _settings(cfg.like)
    report = check_dataset(cfg.root, **known) if cfg.dry_run else repair_dataset(cfg.root, **known)
    print(report)
    return report


def _check_root(root: Path) -> None:
    """Refuses at once what is no folder, unless a repair of it was killed, whose copy lies beside it under a similar name."""
    beside = root.absolute().parent
    if not root.is_dir() and not (beside.is_dir() and any(root.name in path.name for path in beside.iterdir())):
        raise ValueError(f"{root} holds no LeRobotDataset: it is no folder.")


def _settings(like: Path) -> dict[str, Any]:
    """The frame rate and the features of another dataset."""
    from lerobot.datasets.utils import DatasetInfo
    from lerobot.utils.constants import DEFAULT_FEATURES

    try:
        info = DatasetInfo.from_dict(json.loads((like / INFO_PATH).read_text()))
        own = {key: feature for key, feature in info.features.items() if key not in DEFAULT_FEATURES}
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"--like={like}: its {INFO_PATH} is none of a dataset: {error}") from error
    return {"fps": info.fps, "features": own}
