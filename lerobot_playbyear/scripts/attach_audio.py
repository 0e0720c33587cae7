"""Adds sound to a LeRobotDataset from files that were recorded beside it, as a copy.

    playbyear-attach-audio --dataset.repo_id=user/grasp --dataset.root=outputs/grasp \
        --output.repo_id=user/grasp_with_sound --output.root=outputs/grasp_with_sound \
        --files='sound/{episode:06d}.wav' --microphone=gripper --offset=0.25

Every video is copied as it is; what is checked before anything is written, and what the columns mean, is in
docs/dataset.md.
"""

import sys

from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_playbyear.datasets.attach import AttachAudioConfig, AttachError, attach_audio
from lerobot_playbyear.hub.client import patient_hub


@parser.wrap()
def _run(cfg: AttachAudioConfig) -> None:
    attach_audio(cfg)


def main() -> None:
    """The command."""
    register_third_party_plugins()
    try:
        with patient_hub():
            _run()
    except AttachError as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        sys.exit(f"error: The copy cannot be written: {error}")


if __name__ == "__main__":
    main()
