"""Repairing datasets: those that a killed recording left half-written, and those that were damaged later."""

from typing import TYPE_CHECKING

from lerobot_playbyear import lazy_names

if TYPE_CHECKING:
    from lerobot_playbyear.repair.repair import RepairConfig, RepairReport, repair, repair_dataset

__all__ = ["RepairConfig", "RepairReport", "repair", "repair_dataset"]

__getattr__ = lazy_names(__name__, {"repair": ("RepairConfig", "RepairReport", "repair", "repair_dataset")})
