"""A page of short sounds to listen to: blows, materials, friction, a hand that closes, two ears, a bag.

    python tools/sound_page.py --output=docs/media/sound

writes WAV files and `index.html`, in which a browser plays them. Nothing is random between runs.
"""

import argparse
import html
import wave
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from sound_scenes import Scene, box_on_table, box_pulled, listen, two_fingers

from gym_playbyear.sound import Bending

_RATE = 16000
_LOUDER = 8.0  # so that a listener hears without turning up the volume; the page says so


class Clip(NamedTuple):
    """name: of the file. text: what is heard. samples: (n,) or (n, 2), int16."""

    name: str
    text: str
    samples: np.ndarray


def clips() -> Iterator[Clip]:
    """All that is on the page."""
    speeds = (0.05, 0.2, 0.8)
    falls = [_fall(box_on_table(speed=speed)) for speed in speeds]
    yield Clip("blow_speed", "A plastic cube falls on a wooden table at 0.05, 0.2 and 0.8 m/s.", np.concatenate(falls))
    things = ("glass", "wall", "cube", "cardboard", "cloth")
    blows = [_fall(box_on_table(("gripper", thing), speed=0.2)) for thing in things]
    text = "Steel hits glass, sheet steel, plastic, cardboard and cloth at 0.2 m/s; the last is nearly mute."
    yield Clip("blow_material", text, np.concatenate(blows))
    slides = [_slide(box_pulled(speed, 1.3)) for speed in (0.03, 0.1, 0.3)]
    yield Clip("friction_speed", "The cube is pulled along the table at 0.03, 0.1 and 0.3 m/s.", np.concatenate(slides))
    scene = two_fingers(box=False)
    contacts = scene.contacts(0.65)
    fingers = [0.05 * (each.normal_force[:, 0] == 0) for each in contacts]
    heard = listen(scene, contacts, scene.synth(noise_level=1.0), finger_speed=fingers)["left_finger"]
    yield Clip("close_on_air", "The hand closes on air: its motor, and the click of the fingers.", heard[-9600:])
    scene = two_fingers(shift=0.006)
    heard = listen(scene, scene.contacts(0.3), scene.synth(noise_level=1.0))
    ears = np.stack([heard["left_finger"], heard["right_finger"]], axis=1)
    text = "Two ears, for headphones: first the left finger touches the cube, then the right one."
    yield Clip("two_ears", text, _louder(ears))
    yield Clip("bag", "A bag that is bent, slowly and then fast.", np.concatenate([_bag(0.5), _bag(3.0)]))


def _fall(scene: Scene) -> np.ndarray:
    return listen(scene, scene.contacts(0.2))["table"][:3200]


def _slide(scene: Scene) -> np.ndarray:
    return _louder(listen(scene, scene.contacts(0.7))["table"][-4000:])


def _bag(speed: float) -> np.ndarray:
    scene = box_on_table(("gripper", "bag"))
    contacts = scene.contacts(0.3)
    bending = {"table": Bending(np.full(scene.n_substeps, speed), np.zeros(3))}
    return listen(scene, contacts, bending=bending)["table"]


def _louder(samples: np.ndarray) -> np.ndarray:
    return np.clip(samples * _LOUDER, -32767, 32767).astype(np.int16)


def write(output: Path) -> int:
    """Writes all clips and their page; returns how many bytes."""
    output.mkdir(parents=True, exist_ok=True)
    lines = ["<!doctype html><meta charset='utf-8'><title>The sound of contact</title><h1>The sound of contact</h1>"]
    for clip in clips():
        path = output / f"{clip.name}.wav"
        with wave.open(str(path), "wb") as file:
            file.setparams((clip.samples.ndim, 2, _RATE, 0, "NONE", ""))
            file.writeframes(clip.samples.astype("<i2").tobytes())
        lines.append(f"<p>{html.escape(clip.text)}<br><audio controls src='{path.name}'></audio></p>")
    lines.append(f"<p>Friction and ears are played {_LOUDER:.0f} times as loud as they are.</p>\n")
    (output / "index.html").write_text("\n".join(lines), encoding="utf-8")
    return sum(path.stat().st_size for path in output.iterdir())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/media"))
    output = parser.parse_args().output
    print(f"{output}: {write(output) / 1000:.0f} kB")


if __name__ == "__main__":
    main()
