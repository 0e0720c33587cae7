"""`playbyear-attach-audio`: a copy of a LeRobotDataset with sound from files that were recorded beside it.

LeRobot is imported when the dataset's files have been looked at.
"""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_playbyear.datasets.audio_feature import AUDIO_PREFIX
from lerobot_playbyear.datasets.confines import check_links
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import EPISODES_DIR, HF_LEROBOT_HOME, INFO_PATH, list_files
from lerobot_playbyear.datasets.journal import flush, flush_all
from lerobot_playbyear.datasets.opening import open_dataset
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

    from lerobot_playbyear.datasets.attached_sound import EpisodesSound
    from lerobot_playbyear.datasets.long_dataset import LongDataset


class AttachError(InputError):
    """Sound cannot be attached; nothing was written."""


@dataclass
class DatasetPlace:
    """A dataset's name and place.

    Args:
        repo_id: Its name, `user/name`.
        root: Its folder. None: in LeRobot's own cache, under its name.
    """

    repo_id: str
    root: str | None = None


@dataclass
class AttachAudioConfig:
    """Options of `playbyear-attach-audio`.

    Args:
        dataset: The dataset that gets sound; it is not changed. Without a root it may come from the Hub.
        output: The copy with sound.
        files: The sound of each episode: a path in which `{episode}` stands for the episode's number, for example
            `sound/{episode:06d}.wav`. WAV, FLAC, or a film whose sound track is taken.
        microphone: What the microphone is called: the column is `observation.audio.<microphone>`. For files of
            several channels, a name for each, separated by commas.
        channel: Take only this channel of the files, counted from 0.
        offset: Where in its file each episode's first frame was taken [s]; negative where the file begins after it.
        offsets: A JSON file with a list of offsets [s], one per episode, in addition to `offset`.
        sample_rate: Resample to this rate [Hz]. None keeps the files' own.
        pad: Fill what a file lacks at its beginning or its end with silence; otherwise that is an error.
    """

    dataset: DatasetPlace
    output: DatasetPlace
    files: str
    microphone: str = "microphone"
    channel: int | None = None
    offset: float = 0.0
    offsets: Path | None = None
    sample_rate: int | None = None
    pad: bool = False


def attach_audio(cfg: AttachAudioConfig) -> Path:
    """Copies a dataset and adds a microphone.

    Args:
        cfg: The options.

    Returns:
        The copy's folder. It is there only when it is complete.

    Raises:
        AttachError: Naming every episode whose sound is missing, too short, or of another kind.
        OSError: The copy cannot be written.
    """
    target = Path(cfg.output.root) if cfg.output.root else HF_LEROBOT_HOME / cfg.output.repo_id
    if target.exists():
        raise AttachError(f"{target} is there already. Choose another --output.root, or delete it.")
    dataset = _open(cfg.dataset)
    from lerobot_playbyear.datasets.attached_sound import read_sound
    from lerobot_playbyear.datasets.long_dataset import scratch_folder

    keys = _keys(cfg, dataset)
    with scratch_folder() as scratch:
        sound = read_sound(cfg, dataset, keys, Path(scratch))
        _write(Path(dataset.root), target, sound)
    print(f"\nDataset: {target} ({dataset.num_episodes} episodes with {', '.join(keys)} at {sound.sample_rate} Hz)")
    return target


def _write(root: Path, target: Path, sound: "EpisodesSound") -> None:
    """The copy, which is there only when it is complete."""
    from lerobot_playbyear.datasets.attached_copy import write_with_sound

    unfinished = target.absolute().with_name(f".{target.name}.attaching")
    shutil.rmtree(unfinished, ignore_errors=True)  # of one that was killed
    try:
        unfinished.mkdir(parents=True)
        write_with_sound(root, unfinished, sound)
        flush_all(unfinished)
        os.rename(unfinished, target)
        flush(target.absolute().parent)
    except ParquetDamageError as error:
        raise AttachError(f"{error} Repair it first: playbyear-repair --root={root}") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _open(place: DatasetPlace) -> "LeRobotDataset | LongDataset":
    if place.root is not None and not (Path(place.root) / INFO_PATH).is_file():
        raise AttachError(f"There is no dataset in {place.root}: it has no {INFO_PATH}. Correct --dataset.root.")
    try:
        dataset = open_dataset(place.repo_id, place.root, video_backend="pyav")
        from lerobot_playbyear.datasets.attached_copy import read_named_table

        check_links(Path(dataset.root))  # the copy would hold what they lead to
        for path in list_files(Path(dataset.root), f"{EPISODES_DIR}/*/*.parquet"):
            read_named_table(path, ["length"])  # LeRobot looks at no checksum
        return dataset
    except ParquetDamageError as error:
        raise AttachError(f"{error} Repair it first: playbyear-repair --root={dataset.root}") from error
    except Exception as error:  # also what the Hub's client raises
        raise AttachError(f"The dataset '{place.repo_id}' cannot be opened: {error}") from error


def _keys(cfg: AttachAudioConfig, dataset: "LeRobotDataset | LongDataset") -> list[str]:
    names = [name.strip() for name in cfg.microphone.split(",")]
    keys = [name if name.startswith(AUDIO_PREFIX) else AUDIO_PREFIX + name for name in names]
    for key in keys:
        if "/" in key or key == AUDIO_PREFIX or keys.count(key) > 1:
            raise AttachError(f"--microphone={cfg.microphone}: give each microphone a name of its own, without '/'.")
        if key in dataset.meta.features:
            raise AttachError(f"'{key}' is in the dataset already. Give another --microphone.")
    if "{episode" not in cfg.files:
        raise AttachError(f"--files={cfg.files}: say with {{episode}} where the episode's number stands.")
    if cfg.channel is not None and len(keys) > 1:
        raise AttachError(f"--channel={cfg.channel} is for one microphone; --microphone names {len(keys)}.")
    return keys
