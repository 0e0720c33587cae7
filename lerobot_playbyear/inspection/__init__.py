"""Looks at a dataset with sound: checks with findings, and a page to see and hear it."""

from typing import TYPE_CHECKING

from lerobot_playbyear import lazy_names

if TYPE_CHECKING:
    from lerobot_playbyear.datasets.findings import Finding, worst
    from lerobot_playbyear.inspection.inspect import check_numbers
    from lerobot_playbyear.inspection.source import DatasetSource, InspectionError

__all__ = ["DatasetSource", "Finding", "InspectionError", "check_numbers", "worst"]

_HOMES = {
    "inspect": ("check_numbers", "Finding", "worst"),
    "source": ("DatasetSource", "InspectionError"),
}
__getattr__ = lazy_names(__name__, _HOMES)
