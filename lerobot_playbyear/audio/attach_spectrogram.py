"""`playbyear-attach-spectrogram`: a copy of a dataset with sound in which the sound can also be seen.

LeRobot is imported when the dataset's files have been looked at.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image
from tqdm import tqdm

from lerobot_playbyear.audio.attach_audio import open_for_copy, output_folder
from lerobot_playbyear.audio.sound_picture import FLOOR_DB, PICTURE_PREFIX, HeardSound, SoundPicture
from lerobot_playbyear.datasets.errors import InputError, errors_of_input, printable
from lerobot_playbyear.datasets.features import AUDIO_PREFIX, check_audio_features
from lerobot_playbyear.datasets.pictures import encode_picture
from lerobot_playbyear.datasets.reader import DatasetPlace, DatasetReader, EpisodeRows

if TYPE_CHECKING:
    from lerobot_playbyear.audio.dataset_copy import AddedColumn

_PICTURES = ("image", "video")
_USUAL_SIZE = (84, 84)
_COMPRESS_LEVEL = 3  # of 9: for noise both smaller and faster than the usual 6
_STEP_DB = 0.1  # of the histogram of levels
_LOUDEST_DB = 20.0  # a square wave at full scale has 2
_QUIET_SHARE = 0.01
_LEAST_RANGE_DB = 20.0  # so that the noise of a dataset in which nothing happens stays grey


@dataclass
class AttachSpectrogramConfig:
    """Options of `playbyear-attach-spectrogram`.

    Args:
        dataset: The dataset with sound. It is not changed.
        output: The copy with pictures of the sound.
        microphones: Names of the microphones to show. None: all.
        name: Name of a microphone's pictures: `observation.images.<name>`. `{microphone}` stands for the microphone's name.
        seconds: Least sound that a picture shows [s]. It is lengthened until every frame moves the picture by whole columns.
        height, width: Size of a picture [pixels]. None: the first camera's, or 84 without a camera.
        low_db, high_db: Levels shown as black and white [dB of full scale]. None: the level of the dataset's quietest 1 %, and
            that of its loudest sound.
    """

    dataset: DatasetPlace
    output: DatasetPlace
    microphones: list[str] | None = None
    name: str = "{microphone}"
    seconds: float = 2.0
    height: int | None = None
    width: int | None = None
    low_db: float | None = None
    high_db: float | None = None


def attach_spectrogram(cfg: AttachSpectrogramConfig) -> Path:
    """Copies a dataset and adds pictures of its sound.

    Args:
        cfg: The options.

    Returns:
        The copy's folder. It is there only when it is complete.

    Raises:
        InputError: The dataset cannot be read or has no sound, an option does not fit, or there is a folder already.
        OSError: The copy cannot be written.
    """
    target = output_folder(cfg.output)
    dataset = open_for_copy(cfg.dataset)
    from lerobot_playbyear.audio.dataset_copy import write_copy

    with errors_of_input():
        fitted = [_with_levels(dataset, plan, cfg) for plan in _plan(cfg, dataset)]
        write_copy(dataset.root, target, {how.feature: _column(dataset, how) for how in fitted})
    for how in fitted:
        told = f"{how.feature}: the last {how.seconds:.2f} s of '{how.microphone}', {how.width} x {how.height}, "
        print(printable(f"{told}{how.low_db:g} to {how.high_db:g} dB"))
    print(f"\nDataset: {target} ({len(dataset.episodes)} episodes). To roll out with it: --env.spectrogram={target}")
    return target


def _plan(cfg: AttachSpectrogramConfig, dataset: DatasetReader) -> list[SoundPicture]:
    """How each microphone's pictures are made, but for their levels."""
    features, fps = dataset.meta.features, dataset.fps
    rates = check_audio_features(features, fps)
    if not rates:
        raise InputError(
            f"The dataset in {dataset.root} has no sound in columns '{AUDIO_PREFIX}<microphone>'. Choose another, or add "
            "sound first: playbyear-attach-audio."
        )
    names = [key.removeprefix(AUDIO_PREFIX) for key in rates]
    for name in cfg.microphones or []:
        if name not in names:
            raise InputError(f"--microphones names '{name}'; the dataset in {dataset.root} has {', '.join(names)}.")
    wanted = names if cfg.microphones is None else list(dict.fromkeys(cfg.microphones))
    if not wanted:
        raise InputError("--microphones names none. Name at least one, or leave it out for all.")
    height, width = _size(cfg, features)
    columns = _columns_per_frame(cfg, width, fps)
    plans: list[SoundPicture] = []
    for name in wanted:
        key, feature = AUDIO_PREFIX + name, PICTURE_PREFIX + cfg.name.replace("{microphone}", name)
        if feature in features or feature in [plan.feature for plan in plans] or "/" in feature:
            raise InputError(
                f"--name={cfg.name}: '{feature}' is in the dataset in {dataset.root} already, or is not a valid name. Give "
                "another, such as --name='heard_{microphone}'."
            )
        levels = (FLOOR_DB, _LOUDEST_DB, (0,) * height)  # until they are known
        plans.append(SoundPicture(key, feature, rates[key], fps, height, width, columns, *levels))
    return plans


def _size(cfg: AttachSpectrogramConfig, features: dict) -> tuple[int, int]:
    """Height and width: some policies (Diffusion) want one size for all pictures."""
    cameras = (tuple(f["shape"]) for f in features.values() if f["dtype"] in _PICTURES and len(f["shape"]) == 3)
    shape = next(cameras, (*_USUAL_SIZE, 3))
    usual = shape[:2] if shape[2] in (1, 3) else shape[1:]
    height, width = (own or given for own, given in zip((cfg.height, cfg.width), usual, strict=True))
    return height, width


def _columns_per_frame(cfg: AttachSpectrogramConfig, width: int, fps: float) -> int:
    if not 0 < cfg.seconds * fps <= width + 1e-6:
        raise InputError(
            f"--seconds={cfg.seconds:g}: wanted above 0 and at most {width / fps:.2f}, since each frame takes one of {width} "
            "columns at least. Give that, or a larger --width."
        )
    return int(width / (cfg.seconds * fps) + 1e-6)


def _with_levels(dataset: DatasetReader, plan: SoundPicture, cfg: AttachSpectrogramConfig) -> SoundPicture:
    """How one microphone's pictures are made, once all of its sound has been heard.

    Raises:
        InputError: There is nothing but silence, or the levels do not go together.
    """
    edges = np.arange(FLOOR_DB, _LOUDEST_DB + _STEP_DB / 2, _STEP_DB)
    counts = np.zeros((plan.height, len(edges) - 1), np.int64)
    bands = np.arange(plan.height)
    heard = (frame for each in dataset.episodes for frame in map(HeardSound(plan).hear, _blocks(dataset, plan, each)))
    for sound, n_heard in tqdm(heard, "Hearing", len(dataset), unit="frame", delay=1):
        levels = plan.levels(sound)[plan.begun(n_heard)]
        bins = np.clip(((levels - FLOOR_DB) / _STEP_DB).astype(int), 0, counts.shape[1] - 1)
        np.add.at(counts, (bands, bins), 1)
    counts[:, 0] = 0  # digital silence, which no microphone has: something is missing there
    total = counts.sum(axis=0)
    low, high = cfg.low_db, cfg.high_db
    if not total.any() and (low is None or high is None):
        raise InputError(
            f"'{plan.microphone}' holds nothing but silence. Choose others with --microphones, or give --low_db and --high_db."
        )
    if low is None:
        low = float(edges[np.searchsorted(np.cumsum(total), _QUIET_SHARE * total.sum())])
    if high is None:
        high = max(float(edges[np.flatnonzero(total)[-1] + 1]), low + _LEAST_RANGE_DB)
    fitted = replace(plan, low_db=round(low, 1), high_db=round(high, 1))
    halves = counts.sum(axis=1, keepdims=True) / 2
    median = edges[(np.cumsum(counts, axis=1) < halves).sum(axis=1)]  # (height,)
    return replace(fitted, before_episode=tuple(fitted.pixels_of(median).tolist()))


def _column(dataset: DatasetReader, how: SoundPicture) -> "AddedColumn":
    """One microphone's pictures, without loss. They are cheap, and so drawn twice: for statistics, and when written."""
    from lerobot_playbyear.audio.dataset_copy import AddedColumn
    from lerobot_playbyear.datasets.statistics import picture_stats

    shape, names = (how.height, how.width, 3), ["height", "width", "channels"]
    feature = {"dtype": "image", "shape": shape, "names": names, "info": how.as_info()}
    episodes = tqdm(dataset.episodes, "Drawing", unit="episode", delay=1)
    stats = [picture_stats(_pictures(dataset, how, episode)) for episode in episodes]

    def values(episode: int) -> list[dict[str, bytes | None]]:
        pictures = map(Image.fromarray, _pictures(dataset, how, dataset.episodes[episode]))
        return [{"bytes": encode_picture(one, False, _COMPRESS_LEVEL), "path": None} for one in pictures]

    return AddedColumn(feature, stats, values)


def _pictures(dataset: DatasetReader, how: SoundPicture, episode: EpisodeRows) -> Iterator[np.ndarray]:
    """Those of an episode's frames, (height, width, 3) uint8 each."""
    return map(HeardSound(how).add, _blocks(dataset, how, episode))


def _blocks(dataset: DatasetReader, how: SoundPicture, episode: EpisodeRows) -> np.ndarray:
    """The sound of an episode, (n_frames, S)."""
    return dataset.sound(how.microphone, episode).reshape(len(episode), -1)
