"""Looks at a dataset with sound: checks with verdicts, and a page to see and hear it."""

from typing import TYPE_CHECKING

from lerobot_playbyear import lazy_names
from lerobot_playbyear.inspection.source import DatasetSource, InspectionError
from lerobot_playbyear.inspection.verdict import Verdict, worst

if TYPE_CHECKING:
    from lerobot_playbyear.inspection.checking import check_numbers
    from lerobot_playbyear.inspection.picture_checks import PictureChecks

__all__ = ["DatasetSource", "InspectionError", "PictureChecks", "Verdict", "check_numbers", "worst"]

__getattr__ = lazy_names(__name__, {"checking": ("check_numbers",), "picture_checks": ("PictureChecks",)})
