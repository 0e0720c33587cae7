"""Sound into datasets: from files, and from the pictures of microphones that were recorded as cameras; and as pictures."""

from lerobot_playbyear import lazy_names

__all__ = ["cut_into_frames", "note_episode_start", "read_audio", "resample", "write_audio"]

_FILES = ("cut_into_frames", "read_audio", "resample", "write_audio")
__getattr__ = lazy_names(__name__, {"audio_files": _FILES, "recorder_clock": ("note_episode_start",)})
