"""HG-DAgger: an expert corrects a policy while it works, and the policy learns from the corrections."""

from typing import TYPE_CHECKING

from lerobot_playbyear import lazy_names
from lerobot_playbyear.dagger.config import DaggerConfig
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.experts import Expert, ExpertConfig, ExpertError, ScriptedExpertConfig
from lerobot_playbyear.episodes.play import Verdict

if TYPE_CHECKING:
    from lerobot_playbyear.dagger.run import run_dagger

__all__ = [
    "DaggerConfig",
    "Expert",
    "ExpertConfig",
    "ExpertError",
    "InputError",
    "ScriptedExpertConfig",
    "Verdict",
    "run_dagger",
]

__getattr__ = lazy_names(__name__, {"run": ("run_dagger",)})
