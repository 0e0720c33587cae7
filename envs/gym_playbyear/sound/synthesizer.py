"""What microphones hear of a control step: blows, friction, bags that bend, the hand itself, room and arm.

A blow is a half-sine pulse as long as Hertz's theory says: a hard and fast one is short and bright, a soft one long and dull.
It rings the modes of both bodies (`modal`), a little differently wherever it falls. Friction rings them with noise, and hisses
(`excitation`). A microphone hears what it is fixed to, what presses against that, and the rest through the air (`microphones`).
Room, arm and hand are always there. Everything is drawn for every episode (`Draws`). What does not move is silent, and
nothing depends on the physics step but through the physics.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from gym_playbyear.contacts import ContactPair, Contacts
from gym_playbyear.sound.excitation import Bending, BlowFinder, Blows, Crackle, Friction, Smoother, pulse_spectrum
from gym_playbyear.sound.materials import material
from gym_playbyear.sound.microphones import ALL_MICROPHONES, Microphone, Paths
from gym_playbyear.sound.modal import Arrivals, ModeBank

_STRUCK = 4.8  # amplitude of a mode of amplitude 1 per Ns of a short blow (chosen)
_MIX_SPREAD = 0.2  # of the mix of modes between blows, which fall on different places
_BACKGROUND = 0.25  # of noise and hum: a touch of a finger must stand out of a room eight times as loud
BACKGROUND_RMS = _BACKGROUND * 10 ** (-60 / 20)
"""Of noise and hum, relative to full scale."""
_STREAMS = 6


def pcm16(wave: np.ndarray) -> np.ndarray:
    """Converts a wave in [-1, 1] to 16-bit samples of the same shape; what lies outside is clipped."""
    return np.rint(np.clip(wave, -1.0, 1.0) * 32767.0).astype(np.int16)


class Synthesizer:
    """Synthesises what each microphone hears, one control step at a time, without seams between steps.

    Args:
        pairs: Contacts that can be heard, in the order of the columns of `Contacts`.
        microphones: Names in `ALL_MICROPHONES`: ours, and those of other distributions.
        sample_rate: Samples per second, at least 8,000, and a multiple of `control_hz`.
        control_hz: Control steps per second.
        physics_dt: Duration of a physics step [s]; a control step holds a whole number of them.
        noise_level: Factor on the noise of the room and the hum of the arm; 1 is about -72 dBFS rms, 0 turns both off.
        randomise: Whether every episode sounds different: pitch, damping, loudness, stiffness, gains, noise, motors.

    Raises:
        ValueError: For a microphone or material that there is not.
    """

    def __init__(
        self,
        pairs: Sequence[ContactPair],
        microphones: Sequence[str],
        sample_rate: int,
        control_hz: int,
        physics_dt: float,
        noise_level: float = 1.0,
        randomise: bool = True,
    ) -> None:
        self.pairs, self.microphones = tuple(pairs), tuple(microphones)
        self.sample_rate, self.control_hz, self.physics_dt = sample_rate, control_hz, physics_dt
        self.samples_per_step = sample_rate // control_hz
        self.n_substeps = round(1 / (control_hz * physics_dt))
        self.noise_level, self.randomise = float(noise_level), randomise
        self._fixtures = [ALL_MICROPHONES.checked(name, Microphone) for name in microphones]
        self._hum_levels = np.array([[m.hum] for m in self._fixtures])
        self._drive_levels = np.array([[m.drive] for m in self._fixtures])
        self._materials: dict[str, str] = {}
        self._lay_out(self.pairs)
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator, materials: Mapping[str, str] | None = None) -> None:
        """Starts an episode in silence. What touches already makes no click.

        Args:
            rng: What differs between episodes is drawn from it.
            materials: What bodies are made of in this episode, where that is not what their pairs say.

        Raises:
            ValueError: `materials` names a body that no contact is heard of.
        """
        self._make_of(dict(materials or {}))
        # Separate streams: the number of blows changes neither noise nor friction, and a second microphone not the first.
        streams = rng.spawn(_STREAMS + len(self.microphones))
        draws_rng, self._mix_rng, friction_rng, crackle_rng, noise_rng, drive_rng = streams[:_STREAMS]
        bank = self._bank
        draws = draw(draws_rng, bank.body_of_mode, len(self.pairs), len(self.microphones), self.randomise)
        self._gain = draws.gain[:, None]
        self._noise_gain = _BACKGROUND * self.noise_level * draws.noise
        self._weights = self._own_weights * (bank.amplitudes * draws.loudness[bank.body_of_mode])
        bank.reset(draws.pitch, draws.damping)
        self._blows.reset(draws.stiffness)
        own = np.array([pair.loudness for pair in self.pairs]) * draws.loudness[self._banks_of_pair]
        self._friction.reset(friction_rng, draws.roughness, np.sqrt(np.mean(own**2, axis=1)))
        self._crackle.reset(crackle_rng)
        self._paths.reset(draws.structure, draws.air)
        self._noise = Noise(streams[_STREAMS:], self.sample_rate, draws.tilt)
        rates = (self.sample_rate, self.samples_per_step)
        self._hum = Hum(noise_rng.uniform(size=len(draws.hum)), draws.hum_hz, HUM_RMS * draws.hum, *rates)
        self._drive = Drive(drive_rng.uniform(), draws.drive_hz, draws.drive, *rates, self.n_substeps)

    def step(
        self,
        contacts: Contacts,
        joint_speed: np.ndarray,
        finger_speed: np.ndarray,
        microphone_positions: Mapping[str, np.ndarray],
        bending: Mapping[str, Bending] | None = None,
    ) -> dict[str, np.ndarray]:
        """Synthesises the sound of one control step.

        Args:
            contacts: Of every physics step, from `contacts.ContactReader`.
            joint_speed: Mean absolute speed of the arm's joints at every physics step, (n_substeps,) [rad/s].
            finger_speed: Absolute speed of a finger at every physics step, (n_substeps,) [m/s].
            microphone_positions: Of every microphone, (3,) [m, world].
            bending: Of bags and whatever else crackles, by body.

        Returns:
            For each microphone its samples, int16, (sample_rate / control_hz,).

        Raises:
            ValueError: If a force or speed is not finite, or a body bends that does not crackle.
        """
        values = contacts.normal_force.sum() + contacts.slip_speed.sum() + contacts.approach_speed.sum()
        if not np.isfinite(values + joint_speed.sum() + finger_speed.sum()):
            raise ValueError("A force or speed is not finite: the simulation diverged; reduce physics_dt.")
        wave = np.zeros((len(self.microphones), self.samples_per_step))
        ears = np.array([microphone_positions[name] for name in self.microphones], float)
        for part in self._heard(contacts, ears, bending or {}):
            if part is not None:
                wave += part
        drive = self._drive.next(finger_speed)
        if drive is not None:
            wave += self._drive_levels * drive
        if self._noise_gain > 0.0:
            hum = self._hum_levels * self._hum.next(float(joint_speed.mean()))
            wave += self._noise_gain * (self._noise.next(self.samples_per_step) + hum)
        samples = pcm16(np.tanh(self._gain * wave))  # a hard blow saturates softly
        return dict(zip(self.microphones, samples, strict=True))

    def _heard(
        self, contacts: Contacts, ears: np.ndarray, bending: Mapping[str, Bending]
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Ringing and hiss, each (n_microphones, n_samples) or None."""
        rubs = self._friction.find(contacts)
        found = (self._blows.find(contacts), self._crackle.find(bending))
        if rubs is None and found == (None, None):
            return self._bank.ring(None, None), self._friction.hiss(None, None)
        force, position = contacts.normal_force, contacts.position
        if self._crackle.bodies:
            force = np.hstack([force, np.zeros((len(force), len(self._crackle.bodies)))])
            position = np.concatenate([position, self._crackle.positions(bending, len(force))], axis=1)
        gains, delays = self._paths.gains(force, position, ears)
        blows = [each for each in found if each is not None]
        arrivals = None
        if blows:
            all_blows = blows[0] if len(blows) == 1 else Blows(*map(np.concatenate, zip(*blows, strict=True)))
            arrivals = self._arrivals(all_blows, gains, delays)
        pair_gains = gains[:, :, : len(self.pairs)]
        kicks = None
        if rubs is not None:
            weights = self._weights[: len(self.pairs)]
            kicks = self._friction.kicks(rubs, pair_gains, weights, self._bank.frequencies, self._bank.cell)
        return self._bank.ring(kicks, arrivals), self._friction.hiss(rubs, pair_gains)

    def _arrivals(self, blows: Blows, gains: np.ndarray, delays: np.ndarray) -> Arrivals:
        """Every blow at every microphone, at its own time and level."""
        bank = self._bank
        mix = np.exp(_MIX_SPREAD * self._mix_rng.standard_normal((len(blows.step), len(bank.frequencies))))
        pulse = pulse_spectrum(bank.frequencies, blows.duration[:, None])
        amplitudes = (_STRUCK * blows.impulse)[:, None] * self._weights[blows.pair] * mix * pulse
        gain, delay = gains[:, blows.step, blows.pair], delays[:, blows.step, blows.pair]  # (n_microphones, n)
        # The middle of the pulse is when the ringing that it leaves behind seems to have begun.
        time = blows.step * self.physics_dt + 0.5 * blows.duration + delay
        ear = np.broadcast_to(np.arange(len(gain))[:, None], gain.shape)
        return Arrivals(time.ravel(), ear.ravel(), (gain[..., None] * amplitudes).reshape(-1, amplitudes.shape[1]))

    def _make_of(self, materials: dict[str, str]) -> None:
        """Chooses what bodies are made of."""
        bodies = {body for pair in self.pairs for body in pair.bodies}
        if not materials.keys() <= bodies:
            unheard, heard = sorted(materials.keys() - bodies), ", ".join(sorted(bodies))
            raise ValueError(f"materials names {unheard}, which no contact is heard of: there are {heard}.")
        if materials == self._materials:
            return
        self._materials = materials
        sides = [tuple(zip(pair.bodies, pair.materials, strict=True)) for pair in self.pairs]
        self._lay_out(
            [
                replace(pair, materials=(materials.get(*first), materials.get(*second)))
                for pair, (first, second) in zip(self.pairs, sides, strict=True)
            ]
        )

    def _lay_out(self, pairs: Sequence[ContactPair]) -> None:
        """One bank of modes per body, which all the pairs of that body strike."""
        self._crackle = Crackle(pairs, self.physics_dt)
        sources = [pair.bodies for pair in pairs] + [(body, body) for body in self._crackle.bodies]
        self._paths = Paths(self._fixtures, sources)
        self._blows = BlowFinder(pairs, self.physics_dt, self.n_substeps)
        self._friction = Friction(pairs, self.physics_dt, self.n_substeps, self.sample_rate, len(self.microphones))
        sides = [tuple(zip(pair.bodies, pair.materials, strict=True)) for pair in pairs]
        banks = list(dict.fromkeys(side for pair in sides for side in pair))
        self._bank = ModeBank(
            [material(name) for _, name in banks],
            len(self.microphones), self.sample_rate, self.samples_per_step, self.n_substeps,
        )  # fmt: skip
        body_of_mode = self._bank.body_of_mode
        self._banks_of_pair = np.array([[banks.index(side) for side in pair] for pair in sides])
        weights = np.zeros((len(pairs) + len(self._crackle.bodies), len(body_of_mode)))
        for index, (own, pair) in enumerate(zip(self._banks_of_pair, pairs, strict=True)):
            for bank, loudness in zip(own, pair.loudness, strict=True):
                weights[index, body_of_mode == bank] = loudness
        for index, side in enumerate(self._crackle.sides, start=len(pairs)):
            weights[index, body_of_mode == banks.index(side)] = 1.0
        self._own_weights = weights


# Spreads of what is drawn for every episode; all are chosen. Factors in decibels or in octaves either way.
_PITCH_OCTAVES = 0.2  # of a body
_MODE_OCTAVES = 0.04  # of each of its modes
DAMPING_OCTAVES = 0.4  # within what was measured (`tools/decay_times.py`)
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
        damping=2.0 ** (DAMPING_OCTAVES * either_way(n_bodies)[body_of_mode]),
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
    """Amplitudes of a tone's harmonics, newly mixed, of rms 1 together."""
    mixed = np.array(amplitudes) * 2.0**spread
    return mixed * np.sqrt(2.0 / np.sum(mixed**2))


_NOISE_RMS = 10 ** (-61 / 20)  # up to `_NOISE_BAND_HZ`; full scale is a wave of amplitude 1
_NOISE_BAND_HZ = 8000.0
_DRIVE_RMS = 10 ** (-32 / 20)  # the hand's motor at full speed: a hand that closes is the loudest part of a robot
_DRIVE_SPEED = 0.05  # m/s of a finger: full speed of the real hand (Franka Hand, product manual)
_DRIVE_STILL = (0.0005, 0.004)  # m/s: slower is silent, faster turns the motor
_DRIVE_SMOOTHING = 0.004  # s
_DRIVE_FASTEST = 1.5  # times full speed
_TABLE = 4096  # values of one turn
_POLES = 4


class Noise:
    """Noise whose power falls as frequency to the power `tilt`, from a stream of its own for each microphone."""

    def __init__(self, rngs: list[np.random.Generator], sample_rate: int, tilt: float) -> None:
        self._rngs = rngs
        self._filter = _tilted(sample_rate, tilt)
        self._state = np.zeros((len(rngs), _POLES))
        self.next(sample_rate // 10)  # let the filter forget that it started from nothing

    def next(self, n_samples: int) -> np.ndarray:
        """(n_microphones, n_samples)."""
        white = np.stack([rng.standard_normal(n_samples) for rng in self._rngs])
        noise, self._state = signal.lfilter(*self._filter, white, zi=self._state)
        return noise


class Drive:
    """The hand's motor: its pitch and its level follow the speed of the fingers; still fingers are silent."""

    def __init__(
        self, phase: float, pitch: float, harmonics: np.ndarray, sample_rate: int, n_samples: int, n_substeps: int
    ) -> None:
        self._phase, self._pitch = phase, pitch / sample_rate
        heard = np.arange(1, len(harmonics) + 1) * pitch * _DRIVE_FASTEST < 0.45 * sample_rate
        turn = np.arange(_TABLE) / _TABLE
        waves = [amplitude * np.sin(2.0 * np.pi * n * turn) for n, amplitude in enumerate(harmonics * heard, start=1)]
        self._table = _DRIVE_RMS * np.sum(waves, axis=0)  # one turn
        self._smoother = Smoother(n_substeps, n_samples / sample_rate / n_substeps, _DRIVE_SMOOTHING)
        self._smoother.reset(np.zeros(1))
        self._edges = np.arange(n_substeps + 1.0)
        self._place = np.arange(1, n_samples + 1) * (n_substeps / n_samples)

    def next(self, speed: np.ndarray) -> np.ndarray | None:
        """The next samples, (n_samples,), or None; `speed` of a finger at every physics step, (n_substeps,) [m/s]."""
        before = self._smoother.value
        if speed.max() < _DRIVE_STILL[0] and before[0] < _DRIVE_STILL[0]:
            before[:] = 0.0
            return None
        smooth = np.concatenate([before, self._smoother.next(speed[:, None])[:, 0]])
        turning = np.interp(self._place, self._edges, np.minimum(smooth / _DRIVE_SPEED, _DRIVE_FASTEST))
        phase = self._phase + np.cumsum(turning) * self._pitch  # in turns
        self._phase = float(phase[-1] % 1.0)
        still, full = (limit / _DRIVE_SPEED for limit in _DRIVE_STILL)
        level = np.sqrt(turning) * np.minimum(np.maximum((turning - still) / (full - still), 0.0), 1.0)
        return self._table[(phase * _TABLE).astype(int) % _TABLE] * level


def _tilted(sample_rate: int, tilt: float) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients that make white noise fall as frequency to the power `tilt`, equally loud at every sample rate."""
    ratio = 4.5  # from pole to pole, 40 Hz to 16 kHz in all, each with a zero above it
    poles = -2 * np.pi * 40.0 * ratio ** np.arange(_POLES)
    zeros = poles * ratio ** (0.5 * tilt)
    band = np.linspace(0.0, _NOISE_BAND_HZ, 4001)
    power = np.mean(np.abs(signal.freqs_zpk(zeros, poles, 1.0, worN=2 * np.pi * band)[1]) ** 2)
    gain = _NOISE_RMS / np.sqrt(power * _NOISE_BAND_HZ / (0.5 * sample_rate))
    numerator, denominator = signal.zpk2tf(*signal.bilinear_zpk(zeros, poles, 1.0, sample_rate))
    return gain * numerator, denominator


HUM_RMS = 10 ** (-69 / 20)  # of an arm at rest; full scale is a wave of amplitude 1

# Growth of the level with the joints' speed, and its speed scale [rad/s]; and its response time [s]: so slow that an arm
# checked by a contact does not tell.
_HUM_GROWTH, _HUM_SPEED, _HUM_SECONDS = 0.5, 0.5, 1.0


class Hum:
    """A steady tone with harmonics, whose level follows the joints' speed slowly.

    Args:
        phases: Of the harmonics, in turns.
        pitch: Of the first one [Hz].
        amplitudes: Of the harmonics while the arm rests.
        sample_rate: Samples per second.
        n_samples: Of a control step.
    """

    def __init__(
        self, phases: np.ndarray, pitch: float, amplitudes: np.ndarray, sample_rate: int, n_samples: int
    ) -> None:
        angles = 2j * np.pi * pitch * np.arange(1, len(amplitudes) + 1) / sample_rate
        self._harmonics = amplitudes * np.exp(2j * np.pi * phases)
        self._turn = np.exp(angles * n_samples)
        wave = np.exp(angles[:, None] * np.arange(n_samples))
        self._table = np.concatenate([wave.imag, wave.real]).astype(np.float32)  # (2 n_harmonics, n_samples)
        self._ramp = np.linspace(0.0, 1.0, n_samples, dtype=np.float32)
        self._response = -np.expm1(-n_samples / (sample_rate * _HUM_SECONDS))
        self._speed = 0.0

    def next(self, speed: float) -> np.ndarray:
        """The next samples, (n_samples,), while the joints move at `speed` [rad/s]."""
        before = self._level()
        self._speed += self._response * (speed - self._speed)
        parts = np.concatenate([self._harmonics.real, self._harmonics.imag]).astype(np.float32)
        self._harmonics = self._harmonics * self._turn
        return (parts @ self._table) * (before + (self._level() - before) * self._ramp)

    def _level(self) -> float:
        return 1.0 + _HUM_GROWTH * math.tanh(self._speed / _HUM_SPEED)
