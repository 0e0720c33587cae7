"""The sound of contact: what microphones hear of what touches."""

from gym_playbyear.sound.excitation import Bending
from gym_playbyear.sound.microphones import ALL_MICROPHONES
from gym_playbyear.sound.synthesizer import BACKGROUND_RMS, Synthesizer

__all__ = ["ALL_MICROPHONES", "BACKGROUND_RMS", "Bending", "Synthesizer"]
