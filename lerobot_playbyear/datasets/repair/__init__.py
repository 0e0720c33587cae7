"""Repairing datasets on disk: those that a killed recording left half-written, and those that were damaged later."""

from lerobot_playbyear.datasets.repair.info import DatasetDamagedError
from lerobot_playbyear.datasets.repair.repairing import RepairReport, check_dataset, repair_dataset

__all__ = ["DatasetDamagedError", "RepairReport", "check_dataset", "repair_dataset"]
