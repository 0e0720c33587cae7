"""playbyear-attach-audio: a copy of a LeRobotDataset with its sound in columns.

The sound is in files recorded beside it (--files or --session). Without these it is in the
dataset's own files (dtype "audio", LeRobot's pull request 2824), or in the pictures of microphones
that were recorded as cameras. Every video is copied as it is; everything is checked before
anything is written. What the columns mean is in docs/dataset.md.

    playbyear-attach-audio --dataset.repo_id=me/grasp --dataset.root=outputs/grasp \\
        --output.repo_id=me/grasp_with_sound --output.root=outputs/grasp_with_sound \\
        --files='sound/{episode:06d}.wav' --microphone=gripper --offset=0.25
    playbyear-attach-audio ... --session=day.wav --clock=starts.csv \\
        --marks='2.31=1754400000.12, 1802.74=1754401800.55'

  --dataset.repo_id=...        name of the dataset, user/name; it is not changed; needed
  --dataset.root=null          its folder; else LeRobot's cache, or the Hub
  --output.repo_id=...         the copy's name; needed
  --output.root=null           its folder, which must not be there yet; else in LeRobot's cache
  --files=...                  each episode's sound (WAV, FLAC, film), {episode} its number
  --session=null               or one file with the sound of all; see below
  --microphone=microphone      its name; for files of several channels, one for each: left,right
  --channel=null               take only this channel of the files, counted from 0
  --offset=null                where in its file each episode's first frame was taken [s]; else 0,
                               or as the dataset says of its own files
  --offsets=null               a JSON file with a list of offsets [s], one per episode, in addition
  --sample_rate=null           resample to this rate [Hz]; else the files' own
  --pad=false                  fill what a file lacks with silence; otherwise that is an error

With --session, one recorder ran through all episodes:
  --clock=null                 when each episode's first frame was taken: lines of episode,seconds
                               (CSV), or JSON; else meta/playbyear_clock.json of the dataset
  --marks=null                 moments known in the file and on that clock, such as two claps:
                               seconds in the file=seconds on the clock. One mark places the file,
                               two, far apart, also correct its drift; without any the clock's
                               seconds are the file's
"""

from lerobot_playbyear.scripts.command import run_alone, run_command


def main() -> None:
    """The command."""
    run_command("playbyear-attach-audio", __doc__, _attach)


def _attach() -> None:
    from lerobot_playbyear.audio.attach import AttachError, attach_audio

    try:
        run_alone(attach_audio)
    except OSError as error:
        raise AttachError(f"The copy cannot be written: {error}") from error


if __name__ == "__main__":
    main()
