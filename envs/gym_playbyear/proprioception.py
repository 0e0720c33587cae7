"""What the arm measures of itself."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviation and quantum of what the arm measures of itself, as on a real one. Zero switches noise off.

    position: end effector [m]; finger: finger positions [m]; finger_velocity: [m/s]; quantum_*: rounding step. A hand whose
    encoder has 8 bits counts in steps of half a millimetre.
    differentiated: finger velocities are differences of the measured positions over a step, as from a hand that reports
    its width alone; otherwise they are the fingers' own at the moment, in which every touch rings.
    wander: of an error of the end effector's place that wanders, as an arm's calibration is off by something else at every
    place [m]: white noise averages away, this does not. wander_seconds: in which it is forgotten, to 1/e.
    """

    position: float = 0.0003
    finger: float = 0.00002
    finger_velocity: float = 0.002
    quantum_position: float = 0.0001
    quantum_finger: float = 0.0005
    quantum_velocity: float = 0.001
    differentiated: bool = True
    wander: float = 0.0
    wander_seconds: float = 2.0


class Proprioception:
    """The sensors of one arm.

    Args:
        noise: What is wrong with them.
        rate_hz: Measurements per second.
        wander_rng: The wandering error is drawn from it, so that a task without one draws what it always drew.
    """

    def __init__(self, noise: SensorNoise, rate_hz: float, wander_rng: np.random.Generator | None = None) -> None:
        self._noise, self._rate_hz = noise, rate_hz
        n_values = (3, 2, 2)
        self._scale = np.repeat([noise.position, noise.finger, noise.finger_velocity], n_values)
        self._quantum = np.repeat([noise.quantum_position, noise.quantum_finger, noise.quantum_velocity], n_values)
        self._fingers: np.ndarray | None = None
        self._wander: np.ndarray | None = None
        self._wander_rng = wander_rng or np.random.default_rng(0)
        self._kept = float(
            np.exp(-1 / (noise.wander_seconds * rate_hz))
        )  # of the wandering error, by the next measurement

    def measure(self, true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """What the sensors say of the true values, (7,) float32.

        Args:
            true: (7,) end effector x, y, z [m], finger positions [m] and velocities [m/s].
            rng: The noise is drawn from it.
        """
        values = true + self._scale * rng.standard_normal(7)
        if self._noise.wander:
            values[:3] += self._wandered()
        coarse = self._quantum > 0
        values[coarse] = np.round(values[coarse] / self._quantum[coarse]) * self._quantum[coarse]
        if self._noise.differentiated:
            before = values[3:5] if self._fingers is None else self._fingers
            self._fingers = values[3:5].copy()
            values[5:] = (values[3:5] - before) * self._rate_hz
        return values.astype(np.float32)

    def _wandered(self) -> np.ndarray:
        """(3,) the error that wanders [m]: an autoregressive process whose standard deviation is always `wander`."""
        drawn = self._noise.wander * self._wander_rng.standard_normal(3)
        if self._wander is None:
            self._wander = drawn
        else:
            self._wander = self._kept * self._wander + np.sqrt(1 - self._kept**2) * drawn
        return self._wander
