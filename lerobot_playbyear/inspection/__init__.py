"""Looks at a dataset with sound: checks with verdicts, and a page to see and hear it."""

from lerobot_playbyear.inspection.checking import check_numbers
from lerobot_playbyear.inspection.picture_checks import PictureChecks
from lerobot_playbyear.inspection.source import DatasetSource, InspectionError
from lerobot_playbyear.inspection.verdict import Verdict, worst

__all__ = ["DatasetSource", "InspectionError", "PictureChecks", "Verdict", "check_numbers", "worst"]
