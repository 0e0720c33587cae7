"""A page to hear our materials beside measured objects of the same kind, and beside recordings where a free one was found.

    python tools/material_page.py --tdw=tdw-1.13.0.0 --minetest=unpacked --output=docs/media/materials

writes a sound for each kind and `index.html`, in which a browser plays them. `tools/decay_times.py` says how to unpack
`tdw`; `unpacked` is made by `apt-get download minetest-data && dpkg -x minetest-data_*.deb unpacked`, on Debian 12.
"""

import argparse
import html
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from decay_times import KINDS, Measured, measured, objects
from sound_scenes import box_on_table, listen

_RATE = 32000
_SECONDS, _PAUSE = 0.3, 0.2  # of a sound, and after it
_PEAK = 0.7  # of every sound; full scale is 1
_FAINT = 2000  # of 32,768: what is quieter falls faster, for 16 bits to hold how it ends
_MODS = "usr/share/games/minetest/games/minetest_game/mods"


class Recording(NamedTuple):
    """path: below the game's modules. text: what is heard, by whom, where from."""

    path: str
    text: str


RECORDINGS = {
    "metal": Recording("default/sounds/default_place_node_metal.1.ogg", "metal on metal (Ogrebane, OpenGameArt)"),
    "glass": Recording("doors/sounds/doors_glass_door_close.ogg", "a glass door (SkeetMasterFunk69, freesound 235546)"),
    "wood_medium": Recording("default/sounds/default_dig_choppy.1.ogg", "an axe in wood (Sheyvan, freesound 476113)"),
}
"""All are in the public domain (CC0), in Debian's package minetest-data."""


def ours(material: str) -> np.ndarray:
    """A box of it that falls on a table of it, in the middle one of all episodes, so fast that it is not too faint."""
    wave = np.zeros(1)
    for speed in (0.05, 0.2, 1.0, 3.0):  # m/s
        scene = box_on_table((material, material), speed=speed)
        wave = listen(scene, scene.contacts(_SECONDS + 0.1), scene.synth(_RATE))["table"].astype(float)
        if np.abs(wave).max() > _FAINT:
            break
    return wave


def theirs(tdw: Path, kind: str) -> np.ndarray:
    """The modes of the measured object that rings nearest to the median of its kind."""
    wanted = measured()[kind].median
    played = min(objects(tdw)[kind], key=lambda modes: abs(1000.0 * np.median(modes.times) - wanted))
    time = np.arange(round(_SECONDS * _RATE)) / _RATE
    heard = [each for each in zip(*played, strict=True) if each[0] < 0.45 * _RATE]
    waves = [10 ** (level / 20 - 3 * time / ring) * np.sin(2 * np.pi * pitch * time) for pitch, level, ring in heard]
    return np.sum(waves, axis=0)


def recorded(path: Path) -> np.ndarray:
    """A recording from its loudest moment on."""
    resampler = av.AudioResampler("flt", "mono", _RATE)
    with av.open(str(path)) as file:
        frames = [each for frame in [*file.decode(audio=0), None] for each in resampler.resample(frame)]
    wave = np.concatenate([frame.to_ndarray()[0] for frame in frames])
    return wave[max(0, int(np.argmax(np.abs(wave))) - _RATE // 100) :]


def joined(waves: list[np.ndarray]) -> np.ndarray:
    """One after the other, each from where it begins, equally loud, int16."""
    parts = []
    for wave in waves:
        first = max(0, int(np.flatnonzero(wave)[0]) - _RATE // 100)
        wave = wave[first : first + round(_SECONDS * _RATE)]
        parts += [_PEAK * wave / np.abs(wave).max(), np.zeros(round((_SECONDS + _PAUSE) * _RATE) - len(wave))]
    return np.rint(32767 * np.concatenate(parts)).astype(np.int16)


def save(path: Path, samples: np.ndarray) -> None:
    """Writes FLAC, one channel."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("flac", rate=_RATE, layout="mono")
        frame = av.AudioFrame.from_ndarray(samples[None], "s16", "mono")
        frame.sample_rate = _RATE
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            file.mux(packet)


def write(output: Path, tdw: Path, minetest: Path) -> int:
    """Writes all sounds and their page; returns how many bytes."""
    output.mkdir(parents=True, exist_ok=True)
    lines = ["<!doctype html><meta charset='utf-8'><title>Materials</title><h1>Ours, measured, recorded</h1>"]
    for kind in dict.fromkeys(KINDS.values()):
        names = [name for name, each in KINDS.items() if each == kind]
        waves = [*map(ours, names), theirs(tdw, kind)]
        text = f"Ours: {', '.join(names)}; then a measured object of {kind.replace('_', ' ')}"
        if kind in RECORDINGS:
            waves.append(recorded(minetest / _MODS / RECORDINGS[kind].path))
            text += f"; then {RECORDINGS[kind].text}"
        save(output / f"{kind}.flac", joined(waves))
        lines.append(f"<p>{html.escape(text)}.<br><audio controls src='{kind}.flac'></audio></p>")
    source = html.escape(Measured._field_defaults["source"])
    lines.append(f"<p>All are equally loud. Measured objects are ten modes each, from {source}: see LICENSE-tdw.txt.")
    lines.append("Recordings are from Debian's minetest-data, and in the public domain (CC0).</p>\n")
    (output / "LICENSE-tdw.txt").write_bytes((tdw / "LICENSE.txt").read_bytes())
    (output / "index.html").write_text("\n".join(lines), encoding="utf-8")
    return sum(path.stat().st_size for path in output.iterdir())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/media/materials"))
    parser.add_argument("--tdw", type=Path, required=True, help="folder into which the package was unpacked")
    parser.add_argument("--minetest", type=Path, required=True, help="the same of Debian's minetest-data")
    options = parser.parse_args()
    print(f"{options.output}: {write(options.output, options.tdw, options.minetest) / 1000:.0f} kB")


if __name__ == "__main__":
    main()
