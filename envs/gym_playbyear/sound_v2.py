"""The sound of contact, version 2: what microphones hear of blows, friction, bags that bend, and the hand itself.

A blow is a half-sine pulse as long as Hertz's theory says: a hard and fast one is short and bright, a soft one long and dull.
It rings the modes of both bodies, a little differently wherever it falls. Friction rings them with noise, and hisses
(`sound_v2_friction`). A microphone hears what it is fixed to, what presses against that, and the rest through the air
(`sound_v2_paths`). Room, arm and hand are always there (`sound_v2_background`). Everything is drawn anew for every episode
(`sound_v2_draws`). What does not move is silent, and nothing depends on the physics step but through the physics.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from gym_playbyear.contact_kinematics import Contacts, SoundingPair
from gym_playbyear.materials_v2 import material
from gym_playbyear.sound_hum import HUM_RMS, Hum
from gym_playbyear.sound_timing import physics_steps, samples_per_step
from gym_playbyear.sound_v2_background import Drive, Noise
from gym_playbyear.sound_v2_blows import BlowFinder, Blows, pulse_spectrum
from gym_playbyear.sound_v2_crackle import Bending, Crackle
from gym_playbyear.sound_v2_draws import draw
from gym_playbyear.sound_v2_friction import Friction
from gym_playbyear.sound_v2_modes import Arrivals, ModeBank
from gym_playbyear.sound_v2_paths import ALL_MICROPHONES, MICROPHONES, Microphone, Paths

__all__ = ["MICROPHONES", "Bending", "ContactSynth"]

_STRUCK = 4.8  # amplitude of a mode of amplitude 1 per Ns of a short blow (chosen)
_MIX_SPREAD = 0.2  # of the mix of modes between blows, which fall on different places
_BACKGROUND = 0.25  # of noise and hum: a touch of a finger must stand out of a room eight times as loud
BACKGROUND_RMS = _BACKGROUND * 10 ** (-60 / 20)
"""Of noise and hum, relative to full scale."""
_STREAMS = 6


def pcm16(wave: np.ndarray) -> np.ndarray:
    """Converts a wave in [-1, 1] to 16-bit samples of the same shape; what lies outside is clipped."""
    return np.rint(np.clip(wave, -1.0, 1.0) * 32767.0).astype(np.int16)


class ContactSynth:
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
        ValueError: For a rate, microphone, material or noise level that cannot be used.
    """

    def __init__(
        self,
        pairs: Sequence[SoundingPair],
        microphones: Sequence[str],
        sample_rate: int,
        control_hz: int,
        physics_dt: float,
        noise_level: float = 1.0,
        randomise: bool = True,
    ) -> None:
        unknown = [name for name in microphones if name not in ALL_MICROPHONES]
        if not microphones or len(set(microphones)) != len(microphones) or unknown:
            known = ", ".join(sorted(ALL_MICROPHONES))
            raise ValueError(f"microphones is {tuple(microphones)}; name at least one of {known}, each only once.")
        if not 0.0 <= noise_level < np.inf:
            raise ValueError(f"noise_level is {noise_level}; it must be 0 (silent background) or greater.")
        self.pairs, self.microphones = tuple(pairs), tuple(microphones)
        self.sample_rate, self.control_hz, self.physics_dt = sample_rate, control_hz, physics_dt
        self.samples_per_step = samples_per_step(sample_rate, control_hz)
        self.n_substeps = physics_steps(control_hz, physics_dt)
        self.noise_level, self.randomise = float(noise_level), randomise
        self._fixtures = [ALL_MICROPHONES.checked(name, Microphone) for name in microphones]
        self._hum_levels = np.array([[m.hum] for m in self._fixtures])
        self._drive_levels = np.array([[m.drive] for m in self._fixtures])
        self._crackle = Crackle(pairs, physics_dt)
        self._lay_out_bodies()
        self._paths = Paths(self._fixtures, [pair.bodies for pair in pairs] + [(b, b) for b in self._crackle.bodies])
        self._blows = BlowFinder(pairs, physics_dt, self.n_substeps)
        self._friction = Friction(pairs, physics_dt, self.n_substeps, sample_rate, len(microphones))
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode in silence, drawn from `rng`. What touches already makes no click."""
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
            contacts: Of every physics step, from `contact_kinematics`.
            joint_speed: Mean absolute speed of the arm's joints at every physics step, (n_substeps,) [rad/s].
            finger_speed: Absolute speed of a finger at every physics step, (n_substeps,) [m/s].
            microphone_positions: Of every microphone, (3,) [m, world].
            bending: Of bags and whatever else crackles, by body.

        Returns:
            For each microphone its samples, int16, (sample_rate / control_hz,).

        Raises:
            ValueError: If there are other numbers of physics steps or pairs, a microphone has no position, or a value is not
                finite.
        """
        joint_speed, finger_speed = np.asarray(joint_speed, float), np.abs(np.asarray(finger_speed, float))
        self._check(contacts, joint_speed, finger_speed, microphone_positions)
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

    def _lay_out_bodies(self) -> None:
        """One bank of modes per body, which all the pairs of that body strike."""
        sides = [tuple(zip(pair.bodies, pair.materials, strict=True)) for pair in self.pairs]
        banks = list(dict.fromkeys(side for pair in sides for side in pair))
        self._bank = ModeBank(
            [material(name) for _, name in banks],
            len(self.microphones), self.sample_rate, self.samples_per_step, self.n_substeps,
        )  # fmt: skip
        body_of_mode = self._bank.body_of_mode
        self._banks_of_pair = np.array([[banks.index(side) for side in pair] for pair in sides])
        weights = np.zeros((len(self.pairs) + len(self._crackle.bodies), len(body_of_mode)))
        for index, (own, pair) in enumerate(zip(self._banks_of_pair, self.pairs, strict=True)):
            for bank, loudness in zip(own, pair.loudness, strict=True):
                weights[index, body_of_mode == bank] = loudness
        for index, side in enumerate(self._crackle.sides, start=len(self.pairs)):
            weights[index, body_of_mode == banks.index(side)] = 1.0
        self._own_weights = weights

    def _check(self, contacts: Contacts, joint_speed, finger_speed, positions: Mapping[str, np.ndarray]) -> None:
        wanted = (self.n_substeps, len(self.pairs))
        if contacts.normal_force.shape != wanted:
            seen = contacts.normal_force.shape
            raise ValueError(f"contacts are of shape {seen}; wanted {wanted}: (physics steps, sounding pairs).")
        if joint_speed.shape != wanted[:1] or finger_speed.shape != wanted[:1]:
            seen = (joint_speed.shape, finger_speed.shape)
            raise ValueError(f"joint_speed and finger_speed have shapes {seen}; wanted {wanted[:1]} each.")
        missing = sorted(set(self.microphones) - set(positions))
        if missing:
            raise ValueError(f"microphone_positions lacks {', '.join(missing)}.")
        values = contacts.normal_force.sum() + contacts.slip_speed.sum() + contacts.approach_speed.sum()
        if not np.isfinite(values + joint_speed.sum() + finger_speed.sum()):
            raise ValueError("A force or speed is not finite: the simulation diverged; reduce physics_dt.")
