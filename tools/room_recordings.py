"""Recordings of voices, hits, music and footsteps, from packages of Debian 12, in two sets that share nothing: `choice`, on
which choices are made, and `held_out`, which no training and no choice has heard.

    python tools/room_recordings.py --output=outputs/room_recordings

That fetches the packages with apt (`--packages` names a folder that has them), checks every file against
`results/room_recordings.json`, where its package, version, licence and hash stand, and mixes a WAV file per kind and set.
`--list` writes that file, of packages that are there. The recordings themselves are not part of this repository.

How loud: `--env.room_noise_level=L` makes the root mean square of the whole file, without its mean, L times the usual
background's, `gym_playbyear.sound.BACKGROUND_RMS`. Rooms change that by up to 3 dB of what is broadband, of tones by more.
"""

import argparse
import hashlib
import json
import subprocess
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

import av
import numpy as np
from scipy import signal
from scipy.io import wavfile

from gym_playbyear.sound import BACKGROUND_RMS
from lerobot_playbyear.datasets.files import write_atomically

LIST = Path(__file__).parents[1] / "results/room_recordings.json"
FOLDER = Path("outputs/room_recordings")
RATE, SECONDS = 16000, 90
KINDS = ("speech", "hits", "music", "footsteps")
SETS = ("choice", "held_out")
SEED = 54
_MOST_FILES = 60  # of a kind and set
_LONGEST = 20.0  # s of a file that are used


@dataclass(frozen=True)
class Source:
    """Sounds of a package: those whose paths match one of the patterns; `archive`: the file in it that holds them."""

    package: str
    version: str
    licence: str
    patterns: tuple[str, ...]
    archive: str | None = None


def _asterisk(language: str) -> Source:
    return Source(f"asterisk-core-sounds-{language}-g722", "1.6.1-1", "CC-BY-SA-3.0", ("*/sounds/*_*_*/*.g722",))


_DRUMS = ("bassdrum", "clap", "hihat", "ride", "rim", "shaker", "snare0", "snare_a", "snare_r", "tom", "wood")
SOURCES: dict[str, dict[str, tuple[Source, ...]]] = {
    "choice": {
        "speech": (
            Source("ktuberling-data", "4:22.12.3-1", "GPL-2+", ("*/sounds/*/*.ogg", "*/sounds/*/*.wav")),
            _asterisk("fr"),
        ),
        "hits": (Source("hydrogen-data", "1.2.0~beta1+dfsg-1", "GPL-2+", ("*/GMRockKit/*.wav",)),),
        "music": (Source("singularity-music", "007-2", "CC-BY-SA-3.0", ("*/music/*.ogg",)),),
        "footsteps": (
            Source("minetest-data", "5.6.1+dfsg+~1.9.0mt8+dfsg-2", "CC-BY-SA-3.0", ("*/default_*_footstep*.ogg",)),
        ),
    },
    "held_out": {
        "speech": (_asterisk("en"), _asterisk("it"), _asterisk("ru")),
        "hits": (
            Source(
                "lmms-common",
                "1.2.2+dfsg1-6",
                "GPL-2+",
                tuple(f"*/samples/drums/{name}*.ogg" for name in _DRUMS),
            ),
        ),
        "music": (Source("wesnoth-1.16-music", "1:1.16.9-1", "GPL-2+", ("*/music/*.ogg",)),),
        "footsteps": (
            Source(
                "openarena-data",
                "0.8.5split-14",
                "GPL-2+",
                tuple(f"sound/player/footsteps/{name}?.wav" for name in ("boot", "clank", "flesh", "mech", "step")),
                "usr/share/games/openarena/baseoa/pak0.pk3",
            ),
        ),
    },
}  # fmt: skip


@cache
def contents(package: str, version: str, archive: str | None, packages: Path) -> dict[str, Path]:
    """A package's files, or those in its archive, by name; the package is fetched and unpacked once."""
    folder = packages / "unpacked" / f"{package}_{version.replace(':', '%3a')}"
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        pattern = f"{folder.name}_*.deb"
        if not list(packages.glob(pattern)):
            try:
                subprocess.run(["apt-get", "download", f"{package}={version}"], cwd=packages, check=True)
            except (OSError, subprocess.CalledProcessError) as error:
                raise SystemExit(
                    f"{package} {version}, of Debian 12, cannot be fetched: {error}. Put {pattern} into {packages}."
                ) from error
        (deb,) = packages.glob(pattern)
        unfinished = folder.with_name(f"{folder.name}.unfinished")
        subprocess.run(["dpkg-deb", "-x", str(deb), str(unfinished)], check=True)
        unfinished.rename(folder)
    if archive is not None:
        inside = folder / f"{archive}.unpacked"
        if not inside.exists():
            unfinished = inside.with_name(f"{inside.name}.unfinished")
            with zipfile.ZipFile(folder / archive) as zipped:
                zipped.extractall(unfinished, [name for name in zipped.namelist() if name.endswith((".wav", ".ogg"))])
            unfinished.rename(inside)
        folder = inside
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink()]
    return {str(path.relative_to(folder)): path for path in paths}


def choose(source: Source, n_files: int, rng: np.random.Generator, packages: Path) -> dict[str, Any]:
    """What the list has of a source: files that are drawn from it, with their hashes."""
    files = contents(source.package, source.version, source.archive, packages)
    found = [name for name in files if any(fnmatch(name, pattern) for pattern in source.patterns)]
    drawn = sorted(found[index] for index in rng.permutation(len(found))[:n_files])
    hashes = {name: hashlib.sha256(files[name].read_bytes()).hexdigest() for name in drawn}
    return {
        **{name: getattr(source, name) for name in ("package", "version", "licence", "archive")},
        "files": hashes,
    }


def read(listed: dict[str, Any], packages: Path) -> list[np.ndarray]:
    """The sounds of a source in the list, as one channel at `RATE`, (n,) each, all equally loud.

    Raises:
        ValueError: A file is not the one that the list has.
    """
    package, version = listed["package"], listed["version"]
    files = contents(package, version, listed["archive"], packages)
    for name, wanted in listed["files"].items():
        seen = hashlib.sha256(files[name].read_bytes()).hexdigest()
        if seen != wanted:
            raise ValueError(f"{files[name]} has the hash {seen}, wanted {wanted}: give {package} {version}.")
    return [_read_file(files[name]) for name in listed["files"]]


def _read_file(path: Path) -> np.ndarray:
    with av.open(str(path), format="g722" if path.suffix == ".g722" else None, metadata_errors="ignore") as file:
        resampler = av.AudioResampler("flt", "mono", RATE)
        frames = [each for frame in file.decode(audio=0) for each in resampler.resample(frame)] + resampler.resample(
            None
        )
    wave = np.concatenate([frame.to_ndarray()[0] for frame in frames])[: int(_LONGEST * RATE)].astype(np.float64)
    wave -= wave.mean()
    return wave / max(np.sqrt(np.mean(np.square(wave))), 1e-9)


def mix(kind: str, waves: Sequence[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """A recording of `SECONDS` of a kind, (n,), in [-1, 1]."""
    mixed, place = np.zeros(SECONDS * RATE), 0
    if kind in ("hits", "footsteps"):
        waves = [wave / np.abs(wave).max() for wave in waves]
    order = iter(np.concatenate([rng.permutation(len(waves)) for _ in range(SECONDS * 10)]))
    while place < len(mixed):
        wave = waves[next(order)]
        if kind == "hits":
            _add(mixed, place, 10 ** (rng.uniform(-20, 0) / 20) * wave)
            place += int(rng.exponential(0.35) * RATE)
        elif kind == "footsteps":
            near = 10 ** (rng.uniform(-12, 0) / 20)
            for step in range(rng.integers(4, 12)):
                if step % 2:
                    wave = waves[next(order)] if rng.random() < 0.2 else wave
                _add(mixed, place, near * rng.uniform(0.7, 1) * wave)
                place += int(rng.uniform(0.35, 0.7) * RATE)
            place += int(rng.uniform(0, 1.5) * RATE)
        else:
            if kind == "music":
                start = rng.integers(max(1, len(wave) - 8 * RATE))
                wave = wave[start : start + 8 * RATE] * signal.windows.tukey(len(wave[start : start + 8 * RATE]), 0.1)
            _add(mixed, place, wave)
            place += len(wave) + int(rng.uniform(0.1, 0.8) * RATE) * (kind == "speech")
    return 0.99 * mixed / np.abs(mixed).max()


def _add(mixed: np.ndarray, place: int, wave: np.ndarray) -> None:
    """Adds a sound from a place on; what is too long goes on at the beginning, as the whole does when it repeats."""
    places = (place + np.arange(len(wave))) % len(mixed)
    mixed[places] += wave


def write_list(packages: Path) -> None:
    """Draws what is used, of every kind and set, and writes it down."""
    listed: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for name, kinds in SOURCES.items():
        for kind, sources in kinds.items():
            rng, n = np.random.default_rng([SEED, *f"{name} {kind}".encode()]), _MOST_FILES // len(sources)
            listed.setdefault(name, {})[kind] = [choose(source, n, rng, packages) for source in sources]
    scaled = {
        "room_noise_level": "root mean square of the whole file, without its mean, in units of `background_rms`",
        "background_rms": BACKGROUND_RMS,
        "levels": [2, 8],
    }
    content = {"scaled": scaled, "seconds": SECONDS, "seed": SEED, "recordings": listed}
    write_atomically(LIST, json.dumps(content, indent=1) + "\n")


def make(output: Path, packages: Path) -> None:
    """Writes all recordings: `choice_speech.wav` and so on."""
    output.mkdir(parents=True, exist_ok=True)
    for name, kinds in json.loads(LIST.read_text())["recordings"].items():
        for kind, listed in kinds.items():
            waves = [wave for source in listed for wave in read(source, packages)]
            mixed = mix(kind, waves, np.random.default_rng([SEED, *f"mix {name} {kind}".encode()]))
            path = output / f"{name}_{kind}.wav"
            wavfile.write(path, RATE, (32767 * mixed).astype(np.int16))
            print(f"{path}: {len(waves)} files", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=FOLDER, help="folder of the WAV files")
    parser.add_argument("--packages", type=Path, default=FOLDER / "packages", help="folder of the packages")
    parser.add_argument("--list", action="store_true", help=f"write {LIST.name} first")
    options = parser.parse_args()
    if options.list:
        write_list(options.packages)
    make(options.output, options.packages)


if __name__ == "__main__":
    main()
