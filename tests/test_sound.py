"""Sound: it follows physics and not the simulator, the same seed sounds the same, and nothing silent is heard."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from gym_playbyear.contacts import ContactPair, Contacts
from gym_playbyear.sound import Bending, Synthesizer

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
import sound_physics
from sound_scenes import level

PAIRS = [
    ContactPair(("left_finger", "cube"), ("gripper", "cube")),
    ContactPair(("right_finger", "cube"), ("gripper", "cube")),
    ContactPair(("cube", "table"), ("cube", "table")),
    ContactPair(("left_finger", "bag"), ("gripper", "bag")),
]
LEFT, RIGHT, RESTING, BAG = range(len(PAIRS))
EARS = {"gripper": (0, 0, 0.1), "left_finger": (0, 0.03, 0.05), "right_finger": (0, -0.03, 0.05),
        "table": (0.3, 0, 0), "room": (1.0, 0, 1.0)}  # fmt: skip


def synth(microphones=("gripper",), sample_rate=16000, control_hz=20, dt=0.002, seed=0, **options) -> Synthesizer:
    made = Synthesizer(PAIRS, microphones, sample_rate, control_hz, dt, **{"noise_level": 0.0, **options})
    made.reset(np.random.default_rng(seed))
    return made


def nothing(seconds: float, dt: float = 0.002) -> Contacts:
    shape = (round(seconds / dt), len(PAIRS))
    return Contacts(*(np.zeros(shape) for _ in range(4)), np.zeros((*shape, 3)), np.full(len(PAIRS), 0.1))


def touch(contacts: Contacts, pair: int, at: float, speed=0.1, force=2.0, dt=0.002, until=None) -> Contacts:
    first, last = round(at / dt), None if until is None else round(until / dt)
    contacts.normal_force[first:last, pair] = force
    contacts.approach_speed[first, pair] = speed
    return contacts


def slide(contacts: Contacts, pair: int, at: float, speed=0.1, force=1.3, until=None, dt=0.002) -> Contacts:
    steps = slice(round(at / dt), None if until is None else round(until / dt))
    contacts.normal_force[steps, pair], contacts.slip_speed[steps, pair] = force, speed
    return contacts


def part(contacts: Contacts, steps: slice) -> Contacts:
    values = {f.name: getattr(contacts, f.name) for f in dataclasses.fields(contacts)}
    return Contacts(**{name: value if name == "mass" else value[steps] for name, value in values.items()})


def hear(made: Synthesizer, contacts: Contacts, finger_speed=0.0, bending=None) -> dict[str, np.ndarray]:
    n = made.n_substeps
    still, fingers = np.zeros(n), np.full(n, finger_speed)
    positions = {name: np.array(EARS[name]) for name in made.microphones}
    blocks = [
        made.step(part(contacts, slice(start, start + n)), still, fingers, positions, bending)
        for start in range(0, len(contacts.normal_force), n)
    ]
    return {name: np.concatenate([block[name] for block in blocks]) for name in made.microphones}


@pytest.mark.parametrize("measure", sound_physics.MEASUREMENTS, ids=lambda measure: measure.__name__)
def test_sound_follows_physics(measure):
    wrong = [row for row in measure() if not row.holds]
    assert not wrong, wrong


# Episodes


def busy() -> Contacts:
    contacts = slide(touch(nothing(1.0), LEFT, 0.11), RESTING, 0.05, until=0.6)
    return touch(touch(contacts, RIGHT, 0.23, until=0.4), BAG, 0.7)


def test_same_seed_same_bytes_and_another_seed_another_sound():
    first, again, other = (hear(synth(seed=seed, noise_level=1.0), busy())["gripper"] for seed in (5, 5, 6))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_second_microphone_leaves_the_first_as_it_is():
    alone, both = (hear(synth(ears, noise_level=1.0), busy()) for ears in (("gripper",), ("gripper", "room")))
    np.testing.assert_array_equal(alone["gripper"], both["gripper"])


@pytest.mark.parametrize(("randomise", "least", "most"), [(False, 0.0, 1.6), (True, 2.0, 20.0)])
def test_episodes_differ_in_level_and_pitch_if_they_shall(randomise, least, most):
    waves = [
        hear(synth(seed=seed, randomise=randomise), touch(nothing(0.2), LEFT, 0.1))["gripper"] for seed in range(8)
    ]
    assert least <= np.std([level(wave) for wave in waves]) <= most
    peaks = [np.argmax(np.abs(np.fft.rfft(wave))) for wave in waves]
    assert (np.std(peaks) / np.mean(peaks) > 0.05) == randomise


# Silence, background, seams


@pytest.mark.parametrize("sample_rate", [8000, 16000, 44100, 48000])
def test_nothing_silent_is_audible(sample_rate):
    heard = hear(synth(tuple(EARS), sample_rate), touch(nothing(0.4), RESTING, 0.0, speed=0.0))
    assert all(wave.dtype == np.int16 and not wave.any() for wave in heard.values())
    assert all(len(wave) == 0.4 * sample_rate for wave in heard.values())


def test_what_touches_already_makes_no_click_nor_does_the_jitter_of_a_solver():
    rng = np.random.default_rng(0)
    contacts = touch(nothing(1.0), RESTING, 0.0, speed=0.0)
    contacts.normal_force[:, RESTING] += rng.uniform(-0.3, 0.3, 500)
    contacts.approach_speed[:, RESTING] = rng.uniform(-0.0008, 0.0008, 500)
    contacts.slip_speed[:, RESTING] = rng.uniform(0, 0.002, 500)
    assert not hear(synth(), contacts)["gripper"].any()


def test_a_sound_ends():
    wave = hear(synth(), touch(slide(nothing(3.0), RESTING, 0.1, until=0.3), LEFT, 0.15))["gripper"]
    assert wave[:8000].any()
    assert not wave[-8000:].any()


@pytest.mark.parametrize("control_hz", [10, 100])
def test_a_blow_does_not_depend_on_where_control_steps_begin(control_hz):
    contacts = touch(touch(nothing(0.5), LEFT, 0.098), RESTING, 0.24, speed=0.4)
    whole, split = (hear(synth(control_hz=hz), contacts)["gripper"].astype(int) for hz in (20, control_hz))
    assert np.abs(whole).max() > 500
    assert np.abs(whole - split).max() <= 1


def test_the_same_spectrum_at_16_and_48_khz():
    contacts = touch(nothing(0.3), LEFT, 0.05)
    low, high = (hear(synth(sample_rate=rate), contacts)["gripper"] / 32768.0 for rate in (16000, 48000))
    bins = slice(30, 1000)  # of 3.3 Hz: below 3.3 kHz
    a, b = np.abs(np.fft.rfft(low))[bins], np.abs(np.fft.rfft(high))[bins] / 3
    assert np.abs(20 * np.log10(a / b))[a > 0.05 * a.max()].max() < 1.0


# Paths


def test_a_finger_that_holds_the_cube_hears_it_land():
    def landing(force):
        contacts = touch(nothing(0.6), LEFT, 0.0, speed=0.0, force=force) if force else nothing(0.6)
        wave = hear(synth(("left_finger",)), touch(contacts, RESTING, 0.4, speed=0.2))["left_finger"]
        return level(wave[6400:])

    levels = [landing(force) for force in (0.0, 0.5, 20.0)]
    assert levels[0] + 5 < levels[1] < levels[2]


def test_a_sound_in_the_air_arrives_later_the_farther_it_comes():
    made = Synthesizer(PAIRS, ("room",), 48000, 20, 0.002, 0.0, randomise=False)
    onsets = []
    for distance in (0.5, 1.5):
        made.reset(np.random.default_rng(0))
        contacts = touch(nothing(0.05), RESTING, 0.01, speed=0.5)
        block = made.step(contacts, np.zeros(25), np.zeros(25), {"room": np.array([distance, 0, 0])})["room"]
        onsets.append(np.argmax(np.abs(block) > 0.05 * np.abs(block).max()) / 48000)
    assert onsets[1] - onsets[0] == pytest.approx(1 / 343, abs=2e-4)


# Bags


def bent(speed, seed=0):
    bending = {"bag": Bending(np.full(25, speed), np.array([0, 0.03, 0]))}
    return hear(synth(seed=seed, randomise=False), nothing(3.0), bending=bending)["gripper"]


def test_a_bag_crackles_more_the_faster_it_bends_and_not_at_all_at_rest():
    assert not bent(0.0).any()
    levels = [level(bent(speed)) for speed in (0.3, 1.0, 4.0)]
    assert levels[0] < levels[1] < levels[2]
    frames = np.array([level(frame) for frame in bent(0.3).reshape(60, -1)])
    assert frames.max() > np.median(frames) + 15  # clicks, not noise


def test_what_does_not_crackle_cannot_bend_and_a_simulation_that_diverged_is_told():
    with pytest.raises(ValueError, match=r"names cube; bodies that crackle: bag"):
        hear(synth(), nothing(0.05), bending={"cube": Bending(np.zeros(25), np.zeros(3))})
    with pytest.raises(ValueError, match="not finite: the simulation diverged; reduce physics_dt"):
        hear(synth(), touch(nothing(0.05), LEFT, 0.0, speed=np.nan))
