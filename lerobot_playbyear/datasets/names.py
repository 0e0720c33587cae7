"""What LeRobot calls the files of a dataset, and where it keeps them.

LeRobot's own modules with these names import torch and torchvision, which takes seconds. Here they can be had without, so that
a dataset that is missing or damaged is found at once; a test compares them with LeRobot's.
"""

import os
from pathlib import Path

from huggingface_hub.constants import HF_HOME

HF_LEROBOT_HOME = Path(os.getenv("HF_LEROBOT_HOME", Path(HF_HOME) / "lerobot")).expanduser()
"""LeRobot's own cache, where datasets without a root are."""

INFO_PATH = "meta/info.json"
EPISODES_DIR = "meta/episodes"
DEFAULT_DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DEFAULT_VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
