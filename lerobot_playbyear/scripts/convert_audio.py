"""playbyear-convert-audio: a copy of a dataset with its sound in columns, not files, or vice versa.

Files are those of LeRobot's pull request 2824: features of dtype "audio", and the sound in
audio/<key>/chunk-000/file-000.m4a. Columns are what this plugin trains on. The dataset is not
changed; everything is checked before anything is written. More: docs/dataset.md.

    playbyear-convert-audio --to=columns --dataset.repo_id=me/files --dataset.root=outputs/files \\
        --output.repo_id=me/columns --output.root=outputs/columns

  --to=...                     columns or files; needed
  --dataset.repo_id=...        name of the dataset, user/name; needed
  --dataset.root=null          its folder; else LeRobot's cache, and for --to=files the Hub
  --output.repo_id=...         the copy's name; needed
  --output.root=null           its folder, which must not be there yet; else in LeRobot's cache

To columns; every channel becomes a column of its own:
  --sample_rate=null           resample to this rate [Hz]; else the files' own, or the nearest
                               multiple of the frame rate
  --start_time_s=null          how long before an episode's first frame its sound begins [s]; else
                               as the dataset says
  --pad=false                  fill what a file lacks with silence; otherwise that is an error

To files:
  --codec=alac                 alac loses nothing; aac is what the pull request writes
"""

from lerobot_playbyear.scripts.command import run_alone, run_command


def main() -> None:
    """The command."""
    run_command("playbyear-convert-audio", __doc__, _convert)


def _convert() -> None:
    from lerobot_playbyear.audio.convert_audio import ConvertError, convert_audio

    try:
        run_alone(convert_audio)
    except OSError as error:
        raise ConvertError(f"The copy cannot be written: {error}") from error


if __name__ == "__main__":
    main()
