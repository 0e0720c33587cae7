"""What differs between episodes: every body, contact, microphone and room sounds a little different each time."""

from dataclasses import dataclass

import numpy as np

# Spreads of what is drawn anew for every episode; all are chosen. Factors in decibels or in octaves either way.
_PITCH_OCTAVES = 0.2  # of a body
_MODE_OCTAVES = 0.04  # of each of its modes
_DAMPING_OCTAVES = 0.6
_LOUDNESS_DB = 3.0
_STIFFNESS_OCTAVES = 1.5  # of a contact
_ROUGHNESS_OCTAVES = 0.7
_PATH_DB = 3.0
_MICROPHONE_DB = 4.0
_NOISE_DB = 6.0
_HUM_HZ = (45.0, 75.0)
_HUM_HARMONICS = (0.81, 0.49, 0.28, 0.16)
_TILT = (0.0, 1.2)  # background power falls as frequency to this power
_DRIVE_HZ = 700.0  # of the hand's motor at `_DRIVE_SPEED` of the fingers
_DRIVE_OCTAVES = 0.5
_DRIVE_DB = 5.0
_DRIVE_HARMONICS = (1.0, 0.6, 0.5, 0.25, 0.15)


@dataclass(frozen=True)
class Draws:
    """One episode's factors (1 where nothing is randomised) and numbers.

    Attributes:
        pitch, damping: Of every mode, (n_modes,).
        loudness: Of every body, (n_bodies,).
        stiffness, roughness: Of every pair's contact, (n_pairs,).
        structure, air: Of the two ways from a contact to a microphone.
        gain: Of every microphone, (n_microphones,).
        noise, tilt: Of the background: level, and the power of frequency with which it falls.
        hum_hz, hum: The arm's motors: pitch [Hz], amplitudes of the harmonics.
        drive_hz, drive: The hand's motor: pitch [Hz] at full speed of the fingers, amplitudes of the harmonics.
    """

    pitch: np.ndarray
    damping: np.ndarray
    loudness: np.ndarray
    stiffness: np.ndarray
    roughness: np.ndarray
    structure: float
    air: float
    gain: np.ndarray
    noise: float
    tilt: float
    hum_hz: float
    hum: np.ndarray
    drive_hz: float
    drive: np.ndarray


def draw(
    rng: np.random.Generator, body_of_mode: np.ndarray, n_pairs: int, n_microphones: int, randomise: bool
) -> Draws:
    """Draws an episode; without `randomise` the same, middle one every time."""
    spread = 1.0 if randomise else 0.0
    n_bodies = int(body_of_mode.max()) + 1

    def either_way(size: int | None = None):
        return spread * rng.uniform(-1.0, 1.0, size)

    def between(limits: tuple[float, float]) -> float:
        return float(np.mean(limits) + 0.5 * (limits[1] - limits[0]) * either_way())

    octaves = _PITCH_OCTAVES * either_way(n_bodies)[body_of_mode] + _MODE_OCTAVES * either_way(len(body_of_mode))
    return Draws(
        pitch=2.0**octaves,
        damping=2.0 ** (_DAMPING_OCTAVES * either_way(n_bodies)[body_of_mode]),
        loudness=decibels(_LOUDNESS_DB * either_way(n_bodies)),
        stiffness=2.0 ** (_STIFFNESS_OCTAVES * either_way(n_pairs)),
        roughness=2.0 ** (_ROUGHNESS_OCTAVES * either_way(n_pairs)),
        structure=float(decibels(_PATH_DB * either_way())),
        air=float(decibels(_PATH_DB * either_way())),
        noise=float(decibels(_NOISE_DB * either_way())),
        tilt=between(_TILT),
        hum_hz=between(_HUM_HZ),
        hum=_harmonics(_HUM_HARMONICS, either_way(len(_HUM_HARMONICS))),
        drive_hz=float(_DRIVE_HZ * 2.0 ** (_DRIVE_OCTAVES * either_way())),
        drive=decibels(_DRIVE_DB * either_way()) * _harmonics(_DRIVE_HARMONICS, either_way(len(_DRIVE_HARMONICS))),
        gain=decibels(_MICROPHONE_DB * either_way(n_microphones)),  # last: more microphones change nothing above
    )


def decibels(level):
    """Factor on an amplitude for a level [dB]."""
    return 10.0 ** (np.asarray(level) / 20.0)


def _harmonics(amplitudes: tuple[float, ...], spread: np.ndarray) -> np.ndarray:
    """Amplitudes of a tone's harmonics, mixed anew, of rms 1 together."""
    mixed = np.array(amplitudes) * 2.0**spread
    return mixed * np.sqrt(2.0 / np.sum(mixed**2))
