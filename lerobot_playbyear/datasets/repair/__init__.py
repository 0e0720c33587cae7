"""Repairing datasets on disk: those that a killed recording left half-written, and those that were damaged later."""

from typing import TYPE_CHECKING

from lerobot_playbyear import lazy_names

if TYPE_CHECKING:
    from lerobot_playbyear.datasets.repair.info import DatasetDamagedError
    from lerobot_playbyear.datasets.repair.repairing import RepairReport, check_dataset, repair_dataset

__all__ = ["DatasetDamagedError", "RepairReport", "check_dataset", "repair_dataset"]

_REPAIRING = ("RepairReport", "check_dataset", "repair_dataset")
__getattr__ = lazy_names(__name__, {"info": ("DatasetDamagedError",), "repairing": _REPAIRING})
