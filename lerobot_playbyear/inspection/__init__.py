"""Looks at a dataset with sound: checks with findings, and a page to see and hear it."""

from typing import TYPE_CHECKING

from lerobot_playbyear import lazy_names

if TYPE_CHECKING:
    from lerobot_playbyear.datasets.findings import Finding, worst
    from lerobot_playbyear.datasets.reader import SurveyedDataset
    from lerobot_playbyear.inspection.inspect import check_numbers

__all__ = ["Finding", "SurveyedDataset", "check_numbers", "worst"]

__getattr__ = lazy_names(__name__, {"inspect": __all__})
