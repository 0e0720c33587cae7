"""Looks at a dataset with sound: checks with findings, and a page to see and hear it."""

from lerobot_playbyear import lazy_names

__all__ = ["Finding", "SurveyedDataset", "check_numbers", "worst"]

__getattr__ = lazy_names(__name__, {"inspect": __all__})
