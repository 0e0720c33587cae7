"""Sound in files beside the frames becomes columns: decoded once, cut at the episodes, and read where it is indexed."""

from pathlib import Path

import numpy as np
from tqdm import tqdm

from lerobot_playbyear.audio.attach import AttachAudioConfig, AttachError
from lerobot_playbyear.audio.attached_sound import EpisodesSound, SpooledFile, raise_all
from lerobot_playbyear.audio.audio_layout import AudioLayout, AudioTrack, column_names
from lerobot_playbyear.datasets.audio_files import AudioFileError, Channels, Cut, Resampled, audio_pieces

_SPARE_S = 1.0
_FORMATS = "mov,mp4,m4a,wav,flac,ogg,matroska,webm,mp3,aac"  # none of which names other files


class Part:
    """The samples from `start` to `stop` of others, (n, channels), read where they are indexed."""

    def __init__(self, sound: Channels, start: int, stop: int) -> None:
        self._sound = sound
        self._start = min(start, len(sound))
        self.shape = (max(min(stop, len(sound)) - self._start, 0), sound.shape[1])

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, span: slice) -> np.ndarray:
        start, stop, _ = span.indices(len(self))
        return self._sound[self._start + start : self._start + max(start, stop)]


def read_tracks_sound(layout: AudioLayout, cfg: AttachAudioConfig, scratch: Path) -> list[EpisodesSound]:
    """Decodes all files, so that what is wrong with them is known before anything is written.

    Args:
        layout: Where the files are.
        cfg: The options.
        scratch: A folder for the decoded sound, 2 bytes a sample.

    Returns:
        The sound of each microphone.

    Raises:
        AttachError: Naming every microphone, episode and file whose sound is missing, too short or of another kind.
    """
    if cfg.sample_rate is not None and (cfg.sample_rate <= 0 or cfg.sample_rate % layout.fps):
        raise AttachError(f"--sample_rate={cfg.sample_rate}: wanted a multiple of {layout.fps} frames per second.")
    errors: list[str] = []
    sounds = [_read(track, layout, cfg, scratch / str(i), errors) for i, track in enumerate(layout.tracks)]
    raise_all(errors)
    return [sound for sound in sounds if sound is not None]


def _read(
    track: AudioTrack, layout: AudioLayout, cfg: AttachAudioConfig, scratch: Path, errors: list[str]
) -> EpisodesSound | None:
    scratch.mkdir()
    files: dict[Path, tuple[SpooledFile, int] | None] = {}
    episodes: list[Cut] = []
    rates: set[int] = set()
    order = list(zip(track.spans, layout.lengths, strict=True))
    needed_s: dict[Path, float] = {}  # to where in each file; one may decode to more than a disk holds
    for span, length in order:
        end_s = span.start_s + track.start_time_s + length / layout.fps + _SPARE_S
        needed_s[span.path] = max(end_s, needed_s.get(span.path, 0.0))
    for episode, (span, length) in enumerate(tqdm(order, desc=f"Reading {track.key}", unit="episode")):
        try:
            if span.path not in files:
                files[span.path] = None  # also where it cannot be read: that is said once
                files[span.path] = _spool(track, span.path, needed_s[span.path], scratch / str(len(files)))
            spooled = files[span.path]
            if spooled is None:
                continue
            samples, rate = spooled
            rates.add(rate)
            start = round(span.start_s * rate)
            stop = len(samples) if span.end_s is None else round(span.end_s * rate)
            new_rate = cfg.sample_rate or _nearest_rate(rate, layout.fps)
            sound = Resampled(Part(samples, start, stop), rate, new_rate)
            episodes.append(Cut(sound, new_rate, layout.fps, length, track.start_time_s, cfg.pad))
        except (AudioFileError, ValueError) as error:
            errors.append(f"'{track.key}', episode {episode}, {span.path}: {error}")
    if len(rates) > 1:
        errors.append(
            f"'{track.key}': its files have the sample rates {sorted(rates)} Hz; wanted one. Encode them again."
        )
    if len(episodes) < len(layout.lengths) or len(rates) != 1:
        return None
    rate = cfg.sample_rate or _nearest_rate(rates.pop(), layout.fps)
    return EpisodesSound(rate, column_names(track), rate // layout.fps, episodes)


def _nearest_rate(own: int, fps: int) -> int:
    """The rate that is a multiple of the frame rate [Hz]."""
    return own if own % fps == 0 else max(1, round(own / fps)) * fps


def _spool(track: AudioTrack, path: Path, last_s: float, target: Path) -> tuple[SpooledFile, int]:
    """Decodes a file as far as it is needed; the samples, and their rate [Hz]."""
    rate = n_samples = 0
    with target.open("wb") as file:
        for samples, rate in audio_pieces(path, _FORMATS):
            if n_samples > last_s * rate:
                break
            if samples.shape[1] != track.n_channels:
                raise AudioFileError(
                    f"it has {samples.shape[1]} channels; the feature's shape says {track.n_channels}. Correct meta/info.json."
                )
            if track.sample_rate not in (None, rate):
                raise AudioFileError(
                    f"it has {rate} samples per second; the feature's info says {track.sample_rate}. Correct meta/info.json."
                )
            file.write(np.ascontiguousarray(samples).tobytes())
            n_samples += len(samples)
    return SpooledFile(target, track.n_channels), rate
