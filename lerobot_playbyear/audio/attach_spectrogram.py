"""`playbyear-attach-spectrogram`: a copy of a dataset with sound in which the sound can also be seen.

LeRobot is imported when the dataset's files have been looked at.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_playbyear.audio.attach import DatasetPlace, open_for_copy, output_folder, write_new_dataset
from lerobot_playbyear.audio.sound_picture import picture_feature
from lerobot_playbyear.datasets.errors import InputError, errors_of_input
from lerobot_playbyear.datasets.features import AUDIO_PREFIX, check_audio_features

if TYPE_CHECKING:
    from lerobot_playbyear.datasets.reader import DatasetReader

_PICTURES = ("image", "video")
_USUAL_SIZE = (84, 84)


class AttachSpectrogramError(InputError):
    """The pictures cannot be made; nothing was written."""


@dataclass
class AttachSpectrogramConfig:
    """Options of `playbyear-attach-spectrogram`.

    Args:
        dataset: The dataset with sound; it is not changed.
        output: The copy with pictures of the sound.
        microphones: Names of those that are to be seen. None: all.
        name: What a microphone's pictures are called: `observation.images.<name>`. `{microphone}` stands for its name.
        seconds: How much sound a picture shows at least [s]; it is made longer until a frame moves it by whole columns.
        height, width: Of a picture [pixels]. None: as the first camera's; 84 without one.
        low_db, high_db: Levels that are black and white [dB of full scale]. None: as loud as the dataset's quietest hundredth,
            and as its loudest sound.
        video: Whether the pictures become video, which is lossy; otherwise each is stored without loss.
        vcodec, crf: Of video: the codec, and its quality (0 is best). None: LeRobot's own.
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
    video: bool = False
    vcodec: str | None = None
    crf: int | None = None


@dataclass(frozen=True)
class PicturePlan:
    """What is to be made of one microphone, before its levels are known.

    Args:
        microphone, feature: The keys of its sound and of its pictures.
        sample_rate: [Hz].
        height, width: Of a picture [pixels].
        columns_per_frame: By how many columns a frame moves it.
    """

    microphone: str
    feature: str
    sample_rate: int
    height: int
    width: int
    columns_per_frame: int


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
    if not cfg.video:
        for name in ("vcodec", "crf"):
            if getattr(cfg, name) is not None:
                raise AttachSpectrogramError(f"--{name}={getattr(cfg, name)} is for --video=true. Leave it out.")
    dataset = open_for_copy(cfg.dataset)
    plans = _plan(cfg, dataset)
    from lerobot_playbyear.audio.attached_copy import write_changed
    from lerobot_playbyear.audio.attached_pictures import EpisodePictures, fit_levels
    from lerobot_playbyear.audio.picture_storage import images_change, make_encoder, video_change
    from lerobot_playbyear.datasets.files import scratch_folder

    with scratch_folder() as scratch, errors_of_input():
        encoder = make_encoder(cfg.vcodec, cfg.crf) if cfg.video else None
        given = (cfg.low_db, cfg.high_db)
        pictures = [EpisodePictures(dataset, fit_levels(dataset, plan, given), Path(scratch)) for plan in plans]

        def write(root: Path, folder: Path) -> None:
            change = images_change(pictures) if encoder is None else video_change(pictures, root, folder, encoder)
            write_changed(root, folder, change)

        write_new_dataset(Path(dataset.root), target, write)
    for own in pictures:
        how = own.how
        print(
            f"{how.feature}: the last {how.seconds:.2f} s of '{how.microphone}', {how.width} x {how.height}, "
            f"{how.low_db:g} to {how.high_db:g} dB"
        )
    print(
        f"\nDataset: {target} ({len(dataset.episodes)} episodes). To roll out what it taught: --env.spectrogram={target}"
    )
    return target


def _plan(cfg: AttachSpectrogramConfig, dataset: "DatasetReader") -> list[PicturePlan]:
    features, fps = dataset.meta.features, dataset.fps
    try:
        rates = check_audio_features(features, fps)
    except ValueError as error:
        raise AttachSpectrogramError(str(error)) from error
    if not rates:
        raise AttachSpectrogramError(
            f"The dataset '{cfg.dataset.repo_id}' has no sound in columns '{AUDIO_PREFIX}<microphone>'. Choose another, or add "
            "sound first: playbyear-attach-audio."
        )
    names = [key.removeprefix(AUDIO_PREFIX) for key in rates]
    for name in cfg.microphones or []:
        if name not in names:
            raise AttachSpectrogramError(f"--microphones names '{name}'; the dataset has {', '.join(names)}.")
    wanted = names if cfg.microphones is None else list(dict.fromkeys(cfg.microphones))
    if not wanted:
        raise AttachSpectrogramError("--microphones names none. Name at least one, or leave it out for all.")
    height, width = _size(cfg, features)
    columns = _columns_per_frame(cfg, width, fps)
    plans: list[PicturePlan] = []
    for name in wanted:
        key = AUDIO_PREFIX + name
        feature = picture_feature(key, cfg.name)
        if feature in features or feature in [plan.feature for plan in plans] or "/" in feature:
            raise AttachSpectrogramError(
                f"--name={cfg.name}: '{feature}' is in the dataset already, or is no name. Give another, such as "
                "--name='heard_{microphone}'."
            )
        if columns > rates[key] // fps:
            raise AttachSpectrogramError(
                f"--seconds={cfg.seconds:g}: a frame of '{key}' has {rates[key] // fps} samples and would have {columns} "
                "columns. Give more seconds, or a smaller --width."
            )
        plans.append(PicturePlan(key, feature, rates[key], height, width, columns))
    return plans


def _size(cfg: AttachSpectrogramConfig, features: dict) -> tuple[int, int]:
    """Height and width: some policies (Diffusion) want one size for all pictures."""
    cameras = (tuple(f["shape"]) for f in features.values() if f["dtype"] in _PICTURES and len(f["shape"]) == 3)
    shape = next(cameras, (*_USUAL_SIZE, 3))
    usual = shape[:2] if shape[2] in (1, 3) else shape[1:]
    height, width = (own or given for own, given in zip((cfg.height, cfg.width), usual, strict=True))
    for name, size in (("height", height), ("width", width)):
        if not 8 <= size <= 4096:
            raise AttachSpectrogramError(f"--{name}={size}: wanted 8 to 4096 pixels.")
    return height, width


def _columns_per_frame(cfg: AttachSpectrogramConfig, width: int, fps: int) -> int:
    if not cfg.seconds > 0:
        raise AttachSpectrogramError(f"--seconds={cfg.seconds:g}: wanted a number above 0.")
    columns = int(width / (cfg.seconds * fps) + 1e-9)
    if columns < 1:
        raise AttachSpectrogramError(
            f"--seconds={cfg.seconds:g}: {cfg.seconds * fps:g} frames do not fit into {width} columns, one each at least. Give "
            f"at most {width / fps:.2f}, or a larger --width."
        )
    return columns
