"""HG-DAgger: an expert corrects a policy while it works, and the policy learns from the corrections."""

from lerobot_playbyear.episodes.experts import Expert, ExpertConfig

__all__ = ["Expert", "ExpertConfig"]
