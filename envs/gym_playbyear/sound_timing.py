"""How many samples and physics steps a control step holds, and smoothing over them."""

import numpy as np


def samples_per_step(sample_rate: int, control_hz: int) -> int:
    """Samples of one microphone in a control step.

    Raises:
        ValueError: If the rate is too low, or does not give a whole number.
    """
    if sample_rate < 8000:
        raise ValueError(f"sample_rate is {sample_rate}; use at least 8000, to keep what lies below 4 kHz.")
    if control_hz <= 0 or sample_rate % control_hz:
        raise ValueError(
            f"sample_rate {sample_rate} is not a multiple of control_hz {control_hz}: a control step would not "
            "hold a whole number of samples. Change one of the two, for example to 16000 and 20."
        )
    return int(sample_rate // control_hz)


def physics_steps(control_hz: int, physics_dt: float) -> int:
    """Physics steps in a control step.

    Raises:
        ValueError: If that is not a whole number.
    """
    steps = 1.0 / (control_hz * physics_dt) if physics_dt > 0 else 0.0
    if round(steps) < 1 or abs(steps - round(steps)) > 1e-6 * steps:
        raise ValueError(
            f"physics_dt {physics_dt} s does not divide a control step of 1/{control_hz} s into whole physics "
            "steps. Change one of the two, for example to 0.002 and 20."
        )
    return round(steps)


class Smoother:
    """A running mean that forgets exponentially, over control steps of `n_substeps` physics steps, for all columns at once."""

    def __init__(self, n_substeps: int, physics_dt: float, seconds: float) -> None:
        age = np.subtract.outer(np.arange(n_substeps), np.arange(n_substeps))
        forget = np.exp(-physics_dt / seconds)
        self._kernel = np.where(age >= 0, (1.0 - forget) * forget ** np.maximum(age, 0), 0.0)
        self._fade = forget ** np.arange(1, n_substeps + 1)[:, None]

    def reset(self, value: np.ndarray) -> None:
        """`value`: what the mean has been so far, (n,)."""
        self.value = np.array(value, float)

    def next(self, values: np.ndarray) -> np.ndarray:
        """The means at every physics step of a control step, (n_substeps, n), of its `values` and all earlier ones."""
        means = self._kernel @ values + self._fade * self.value
        self.value = means[-1].copy()
        return means
