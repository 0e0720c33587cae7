"""playbyear-calibrate-latency: how much later sound arrives than pictures, from taps seen and heard.

Tap the table in view of the camera and near the microphone, and let the hand rest after each tap.
Nothing else shall move in the picture. docs/microphones.md says more.

    playbyear-calibrate-latency \\
        --camera.type=opencv --camera.index_or_path=0 --camera.fps=30 \\
        --camera.width=640 --camera.height=480 \\
        --microphone.type=portaudio --microphone.device=USB

  --camera.type=...            LeRobot's cameras: opencv, intelrealsense, zmq, ...; needed
  --microphone.type=...        portaudio, file, or one of a plugin; needed
                               .device: its name, a part of it, or its number, as
                               playbyear-find-microphones lists them; .channel; .sample_rate [Hz]
  --taps=10                    how many
  --event=stops                the sound comes when a motion stops; or begins, as that of a flash
  --timeout_s=60.0             for how long to wait for them [s]
  --plot=outputs/latency.png   a picture of what was measured
"""

import logging

from lerobot_playbyear.scripts.command import run_command, run_with_lerobot


def main() -> None:
    """The command."""
    run_command("playbyear-calibrate-latency", __doc__, _calibrate)


def _calibrate() -> None:
    logging.basicConfig(level=logging.WARNING)
    from lerobot_playbyear.calibration.calibrate import calibrate_latency
    from lerobot_playbyear.datasets.errors import errors_of_input
    from lerobot_playbyear.microphones.config import register_microphone_plugins

    register_microphone_plugins()
    with errors_of_input(OSError):
        run_with_lerobot(calibrate_latency)


if __name__ == "__main__":
    main()
