"""playbyear-attach-audio: a copy of a LeRobotDataset with the sound of its microphones.

Where a microphone was recorded as a camera, or the dataset has its sound in files of its own (dtype
"audio", LeRobot's pull request 2824), nothing more has to be said. Sound that was recorded beside
the dataset is named by --files or --session. Everything is checked before anything is written. What
the columns mean is in docs/dataset.md, microphones on robots in docs/robots.md.

    playbyear-attach-audio --dataset.repo_id=me/demos --dataset.root=outputs/demos
    playbyear-attach-audio --dataset.repo_id=me/grasp --dataset.root=outputs/grasp \\
        --output.repo_id=me/grasp_with_sound --output.root=outputs/grasp_with_sound \\
        --files='sound/{episode:06d}.wav' --microphone=gripper --offset=0.25
    playbyear-attach-audio ... --session=day.wav --clock=starts.csv \\
        --marks='2.31=1754400000.12, 1802.74=1754401800.55'

  --dataset.repo_id=...        name of the dataset, user/name; it is not changed; needed
  --dataset.root=null          its folder; else LeRobot's cache, or the Hub
  --output.repo_id=null        the copy's name; else the dataset's with _with_sound behind it
  --output.root=null           its folder, which must not be there yet; else beside the dataset
  --files=...                  each episode's sound (WAV, FLAC, film), {episode} its number
  --session=null               or one file with the sound of all, see below; or, of microphones that
                               were recorded as cameras, a folder with the files of their sessions
  --microphone=null            its name, else "microphone"; for files of several channels, one for
                               each: left,right; of recorded cameras those that are named, else all
  --channel=null               take only this channel of the files, counted from 0
  --offset=null                where in its file each episode's first frame was taken [s]; else 0,
                               or as the dataset says of its own files
  --offsets=null               a JSON file with a list of offsets [s], one per episode, in addition
  --sample_rate=null           resample to this rate [Hz]; else the files' own
  --pad=false                  fill what a file lacks with silence; otherwise that is an error

With one --session=FILE, one recorder ran through all episodes:
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
