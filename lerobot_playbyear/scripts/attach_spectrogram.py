"""playbyear-attach-spectrogram: a copy of a dataset with sound in which the sound can also be seen.

Every microphone gets observation.images.<microphone>: the log-mel spectrogram of the last seconds
as a picture, the newest sound at the right. LeRobot's ACT, Diffusion and SmolVLA then hear without
knowing. --env.spectrogram=<the copy> shows the same pictures at rollout. More: docs/peers.md.

    playbyear-attach-spectrogram --dataset.repo_id=me/occluded --dataset.root=outputs/occluded \\
        --output.repo_id=me/seen --output.root=outputs/seen

  --dataset.repo_id=...        name of the dataset, user/name; it is not changed; needed
  --dataset.root=null          its folder; else LeRobot's cache, or the Hub
  --output.repo_id=...         the copy's name; needed
  --output.root=null           its folder, which must not be there yet; else in LeRobot's cache
  --microphones=null           those to be seen, such as [gripper]; else all
  --name={microphone}          what the pictures are called, such as heard_{microphone}, where a
                               camera has the microphone's name
  --seconds=2.0                how much sound a picture shows at least [s]; every frame moves it by
                               whole columns, so it may be a little more
  --height=null                of a picture [pixels]; else as the first camera's, or 84
  --width=null                 the same
  --low_db=null                level that is black [dB of full scale]; else that of the dataset's
                               quietest hundredth
  --high_db=null               level that is white; else that of the dataset's loudest sound
  --video=false                video, which is smaller and lossy; else each picture without loss
  --vcodec=null                of video, such as h264; else LeRobot's own
  --crf=null                   of video: its quality, 0 the best; else LeRobot's own
"""

from lerobot_playbyear.scripts.command import run_alone, run_command


def main() -> None:
    """The command."""
    run_command("playbyear-attach-spectrogram", __doc__, _attach)


def _attach() -> None:
    from lerobot_playbyear.audio.attach_spectrogram import AttachSpectrogramError, attach_spectrogram

    try:
        run_alone(attach_spectrogram)
    except OSError as error:
        raise AttachSpectrogramError(f"The copy cannot be written: {error}") from error


if __name__ == "__main__":
    main()
