"""Does the sound follow physics? Level and spectrum over speed, force, slip and stiffness, and independence of the simulator.

    python tools/sound_physics.py

measures small MuJoCo scenes (`sound_scenes.py`), prints the table and writes it to
`results/sound_physics.csv`. `tests/test_sound.py` asserts every row.
"""

import csv
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from sound_scenes import CONTROL_HZ, Scene, box_on_table, box_pulled, centroid, level, listen, two_fingers

from gym_playbyear.sound import Synthesizer

_STEPS = (0.002, 0.001)  # s: the physics steps that are compared
_TOLERANCE_DB, _TOLERANCE = 1.5, 0.10


class Row(NamedTuple):
    """what: was varied. values: of that. figures: what was measured. wanted: in words. holds: whether it is so."""

    what: str
    values: str
    figures: str
    wanted: str
    holds: bool


def blow(scene: Scene, seconds: float = 0.15, **options) -> np.ndarray:
    """What the table's microphone hears of a fall."""
    return listen(scene, scene.contacts(seconds), scene.synth(**options))["table"]


def rub(scene: Scene) -> np.ndarray:
    """The same of a steady slide."""
    return listen(scene, scene.contacts(0.8))["table"][4800:]


def impact_speed() -> Iterator[Row]:
    """Faster is louder and brighter."""
    speeds = (0.05, 0.1, 0.2, 0.4)
    for materials in (("cube", "table"), ("gripper", "wall")):
        waves = [blow(box_on_table(materials, speed=speed)) for speed in speeds]
        centres, levels = [centroid(wave) for wave in waves], [level(wave) for wave in waves]
        name = " on ".join(materials)
        yield _row(f"{name}: centroid over impact speed", speeds, "m/s", centres, "Hz", "rises", _rises(centres))
        slope = _slope(speeds[:3], levels[:3])
        wanted = "20 dB per decade (impulse), and more where it brightens: 20 to 30"
        yield _row(f"{name}: level over impact speed", speeds, "m/s", levels, "dBFS", wanted, 20 <= slope <= 30)


def stiffness() -> Iterator[Row]:
    """Hard is bright, soft is dull, and cloth nearly mute."""
    things = ("glass", "cube", "cardboard", "rubber")
    centres = [centroid(blow(box_on_table(("gripper", thing), speed=0.2))) for thing in things]
    holds = _rises(centres[::-1])
    yield _row("steel on something: centroid over stiffness", things, "", centres, "Hz", "falls", holds)
    things = ("table", "cloth", "sponge", "peanuts")
    levels = [level(blow(box_on_table(("gripper", thing), speed=0.2))) for thing in things]
    holds = max(levels[1:]) < levels[0] - 40
    yield _row("steel on something: level", things, "", levels, "dBFS", "soft things 40 dB below wood", holds)


def mass() -> Iterator[Row]:
    """Heavier is louder."""
    masses = (0.03, 0.06, 0.12, 0.24)
    levels = [level(blow(box_on_table(speed=0.1, mass=each))) for each in masses]
    holds = _rises(levels)
    yield _row("cube on table, 0.1 m/s: level over mass", masses, "kg", levels, "dBFS", "rises", holds)


def solver_softness() -> Iterator[Row]:
    """The same blow, whether the simulator's contact takes 2 or 10 ms to stop it."""
    softnesses = (0.004, 0.01, 0.02)
    levels = [level(blow(box_on_table(softness=softness, speed=0.2))) for softness in softnesses]
    yield _row("cube on table: level over the solver's time constant", softnesses, "s", levels, "dBFS", *_same(levels))


def friction() -> Iterator[Row]:
    """Noise that grows with force and speed, and whose band follows the speed."""
    forces = (0.5, 1.0, 2.0, 4.0)
    levels = [level(rub(box_pulled(0.1, force))) for force in forces]
    slope = _slope(forces, levels)
    yield _row(
        "cube on table, 0.1 m/s: level over normal force", forces, "N", levels, "dBFS",
        "10 dB per decade, +-2", abs(slope - 10) < 2,
    )  # fmt: skip
    speeds = (0.02, 0.05, 0.1, 0.2)
    waves = [rub(box_pulled(speed, 1.3)) for speed in speeds]
    levels, centres = [level(wave) for wave in waves], [centroid(wave) for wave in waves]
    slope = _slope(speeds, levels)
    yield _row(
        "cube on table, 1.3 N: level over slip speed", speeds, "m/s", levels, "dBFS",
        "15 dB per decade (power 3/4), +-3", abs(slope - 15) < 3,
    )  # fmt: skip
    yield _row("the same: centroid over slip speed", speeds, "m/s", centres, "Hz", "rises", _rises(centres))


def physics_step() -> Iterator[Row]:
    """2 ms against 1 ms."""
    scenes: dict[str, Callable[[float], np.ndarray]] = {
        "cube falls on table, 0.2 m/s": lambda step: blow(box_on_table(timestep=step, speed=0.2)),
        "cube pulled, 0.1 m/s, 1.3 N": lambda step: rub(box_pulled(0.1, 1.3, timestep=step)),
        "fingers squeeze a cube": lambda step: grip(two_fingers(timestep=step))["left_finger"],
        "fingers meet": lambda step: grip(two_fingers(timestep=step, box=False))["left_finger"],
    }
    for name, sound in scenes.items():
        waves = [sound(step) for step in _STEPS]
        levels, centres = [level(wave) for wave in waves], [centroid(wave) for wave in waves]
        yield _row(f"{name}: level over physics step", _STEPS, "s", levels, "dBFS", *_same(levels))
        holds = abs(centres[0] / centres[1] - 1) < _TOLERANCE
        yield _row(f"{name}: centroid over physics step", _STEPS, "s", centres, "Hz", "within 10 %", holds)


def two_ears() -> Iterator[Row]:
    """The finger that touches is the louder one, and hears it first."""
    scene = two_fingers(shift=0.006)
    heard = grip(scene, 0.15, 48000)
    ears = ("left_finger", "right_finger")
    levels = [level(heard[ear]) for ear in ears]
    holds = levels[0] > levels[1] + 6
    yield _row("left finger touches first: level", ears, "", levels, "dBFS", "left 6 dB above right", holds)
    start = int(np.flatnonzero(heard[ears[0]])[0]) - 48
    delay = 1e6 * _delay(*(heard[ear][start : start + 480] for ear in ears)) / 48000
    yield _row("the same: later by", ears[1:], "", [delay], "us", "30 to 80 (through the hand)", 30 < delay < 80)


def silence() -> Iterator[Row]:
    """What does not move is silent, and the hand's own drive is heard only while it moves."""
    resting = box_on_table()
    loudest = [int(np.abs(blow(resting, 0.5)).max())]
    yield _row("cube rests on table: loudest sample", ("0.5",), "s", loudest, "", "0", loudest == [0])
    speeds = (0.0, 0.01, 0.025, 0.05)
    scene = two_fingers(box=False)
    contacts = scene.contacts(0.3)
    levels = [level(listen(scene, contacts, finger_speed=speed)["left_finger"]) for speed in speeds]
    holds = levels[0] < -150 and _rises(levels)
    yield _row(
        "hand closes on air: level over finger speed", speeds, "m/s", levels, "dBFS", "silent, then rises", holds
    )


MEASUREMENTS = (impact_speed, stiffness, mass, solver_softness, friction, physics_step, two_ears, silence)


def grip(scene: Scene, seconds: float = 0.8, sample_rate: int = 16000) -> dict[str, np.ndarray]:
    """What the ears hear of fingers that close."""
    return listen(scene, scene.contacts(seconds), scene.synth(sample_rate))


def _delay(first: np.ndarray, second: np.ndarray, finer: int = 16) -> float:
    """By how many samples the second is later, to a fraction of one: where their correlation is largest."""
    size = 4 * len(first)
    cross = np.conj(np.fft.rfft(first.astype(float), size)) * np.fft.rfft(second.astype(float), size)
    correlation = np.fft.irfft(cross, size * finer)
    place = int(np.argmax(correlation))
    return (place if place < len(correlation) // 2 else place - len(correlation)) / finer


def cost() -> str:
    """Processor time of a control step of 50 ms at 16 kHz [ms]: fingers that close on a cube, background and all."""
    scene, figures = two_fingers(), []
    contacts, still = scene.contacts(0.6), np.zeros(scene.n_substeps)
    for count in (1, 2):
        ears = dict(list(scene.ears.items())[:count])
        synth = Synthesizer(scene.pairs, list(ears), 16000, CONTROL_HZ, scene.model.opt.timestep)
        times = []
        for _ in range(20):
            start = time.thread_time()
            for each in contacts:
                synth.step(each, still, still, ears)
            times.append((time.thread_time() - start) / len(contacts))
        figures.append(f"{1000 * min(times):.2f} ms with {count} microphone{'s' * (count > 1)}")
    return f"a control step costs {', '.join(figures)}"


def _same(levels: Sequence[float]) -> tuple[str, bool]:
    return f"within {_TOLERANCE_DB} dB", max(levels) - min(levels) < _TOLERANCE_DB


def _rises(figures: Sequence[float]) -> bool:
    return all(b > a for a, b in pairwise(figures))


def _slope(values: Sequence[float], levels: Sequence[float]) -> float:
    """[dB per decade]."""
    return float(np.polyfit(np.log10(values), levels, 1)[0])


def _row(what: str, values: Sequence, unit: str, figures: Sequence[float], of: str, wanted: str, holds: bool) -> Row:
    shown = [f"{figure:.0f}" if of != "dBFS" else f"{figure:.1f}" for figure in figures]
    silent = [text if of != "dBFS" or figure > -150 else "silent" for text, figure in zip(shown, figures, strict=True)]
    return Row(
        what, f"{', '.join(map(str, values))} {unit}".strip(), f"{', '.join(silent)} {of}".strip(), wanted, holds
    )


def main() -> None:
    start = time.perf_counter()
    rows = [row for measure in MEASUREMENTS for row in measure()]
    print("| what | at | measured | wanted | |\n|---|---|---|---|---|")
    for row in rows:
        print(f"| {row.what} | {row.values} | {row.figures} | {row.wanted} | {'yes' if row.holds else 'NO'} |")
    path = Path(__file__).parents[1] / "results" / "sound_physics.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        writer.writerows(rows)
    print(cost())
    print(f"{path}: {len(rows)} rows in {time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main()
