"""Microphones, as LeRobot has cameras: configurations by type, devices that are connected, read and disconnected."""

from lerobot_playbyear import lazy_names

__all__ = ["Microphone", "MicrophoneConfig", "MicrophoneError", "make_microphone"]

_MODULES = {"config": ("MicrophoneConfig", "make_microphone"), "microphone": ("Microphone", "MicrophoneError")}
__getattr__ = lazy_names("lerobot_playbyear.microphones", _MODULES)
