"""Repairing datasets on disk: those that a killed recording left half-written, and those that were damaged later.

A survey reads a dataset once and says what is wrong with it; a plan follows from it without a look at the disk; and
what is planned is carried out in a copy, which then takes the dataset's place.
"""

from typing import TYPE_CHECKING

from lerobot_playbyear import lazy_names

if TYPE_CHECKING:
    from lerobot_playbyear.datasets.repair.repairing import check_dataset, repair_dataset
    from lerobot_playbyear.datasets.repair.report import DatasetDamagedError, RepairReport

__all__ = ["DatasetDamagedError", "RepairReport", "check_dataset", "repair_dataset"]

_HOMES = {
    "repairing": ("check_dataset", "repair_dataset"),
    "report": ("DatasetDamagedError", "RepairReport"),
}
__getattr__ = lazy_names(__name__, _HOMES)
