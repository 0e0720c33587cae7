"""Microphones that LeRobot reads as cameras: sound cards, files, and what other packages bring."""

from lerobot_playbyear import lazy_names

__all__ = ["Microphone", "MicrophoneCamera", "MicrophoneCameraConfig", "MicrophoneError", "register_source"]

_MODULES = {
    "camera": ("MicrophoneCamera", "MicrophoneCameraConfig"),
    "microphone": ("Microphone", "MicrophoneError", "register_source"),
}
__getattr__ = lazy_names("lerobot_playbyear.microphones", _MODULES)
