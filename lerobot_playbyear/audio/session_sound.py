"""One recording of a whole session: cut into the sound of its episodes, by the times when they began."""

from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from lerobot_playbyear.audio.attach import AttachAudioConfig, AttachError
from lerobot_playbyear.audio.attached_sound import EpisodesSound, checked_rate, offsets_of, raise_all, spool
from lerobot_playbyear.audio.clock_drift import Steady, read_marks
from lerobot_playbyear.datasets.audio_files import AudioFileError, Cut, Resampled
from lerobot_playbyear.datasets.episode_clock import CLOCK_PATH, ClockError, read_clock, read_episode_starts

if TYPE_CHECKING:
    from lerobot_playbyear.datasets.reader import DatasetReader


def read_session(cfg: AttachAudioConfig, dataset: "DatasetReader", keys: list[str], scratch: Path) -> EpisodesSound:
    """Decodes the recording, so that what is wrong with it is known before anything is written.

    Args:
        cfg: The options.
        dataset: The dataset that gets its sound.
        keys: The columns, one per channel.
        scratch: A folder for the decoded sound, 2 bytes a sample.

    Raises:
        AttachError: The recording cannot be used, an episode has no time, or lies outside the recording.
        ClockError, MarksError: The times or the marks are none.
    """
    lengths = [int(length) for length in dataset.meta.episodes["length"]]
    line = read_marks(cfg.marks)
    starts = _starts(cfg, Path(dataset.root), len(lengths))
    offsets = offsets_of(cfg, len(lengths))
    path = Path(str(cfg.session))
    try:
        samples, own_rate = spool(cfg, path, len(keys), scratch / "session")
        rate = checked_rate(cfg, own_rate, dataset.fps)
    except (AudioFileError, ValueError) as error:
        raise AttachError(f"Nothing was written. {path}: {error}") from error
    sound = Resampled(Steady(samples, line.speed), own_rate, rate)
    episodes: list[Cut] = []
    errors: list[str] = []
    order = list(zip(starts, offsets, lengths, strict=True))
    for episode, (start, offset, length) in enumerate(tqdm(order, desc="Cutting sound", unit="episode")):
        first_frame_s = line.sound_time(start) + offset
        try:
            episodes.append(Cut(sound, rate, dataset.fps, length, first_frame_s / line.speed, cfg.pad))
        except AudioFileError as error:
            errors.append(f"episode {episode}, which began at {start:.3f} s of the clock: in {path} {error}")
    raise_all(errors)
    print(
        f"{path}: its clock runs at {line.speed:.6f} of the episodes' clock ({(line.speed - 1) * 1e6:+.0f} parts in a "
        f"million); the marks fit to {line.error_s * 1000:.1f} ms."
    )
    return EpisodesSound(rate, keys, rate // dataset.fps, episodes)


def _starts(cfg: AttachAudioConfig, root: Path, n_episodes: int) -> list[float]:
    """When each episode began, on the clock [s]."""
    if cfg.clock is not None:
        try:
            known: dict[int, float] | None = read_clock(cfg.clock)
        except OSError as error:
            raise ClockError(f"--clock={cfg.clock} cannot be read: {error}") from error
    else:
        known = read_episode_starts(root)
    source = cfg.clock or root / CLOCK_PATH
    if known is None:
        raise AttachError(
            f"Nothing says when the episodes began: there is no {source}. Give --clock=times.csv with lines "
            "episode,seconds: for each episode when its first frame was taken."
        )
    missing = [episode for episode in range(n_episodes) if episode not in known]
    if missing:
        named = ", ".join(map(str, missing[:10])) + (", ..." if len(missing) > 10 else "")
        raise AttachError(
            f"{source} has no time for episode {named}; the dataset has {n_episodes} episodes. Add it, counted from 0."
        )
    return [known[episode] for episode in range(n_episodes)]
