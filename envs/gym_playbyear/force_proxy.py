"""The paper's stand-in for sound: what presses on a thing, silent once it is lifted (`sound="contact_force"`)."""

from typing import Any

import numpy as np

from gym_playbyear.arena import TABLE_TOP

_SILENT_ABOVE = TABLE_TOP + 0.04  # m: as in the authors' code, whose cubes lie on the table
_LIFTED = 0.015  # m: above where a thing lay that lay higher than they do, such as keys in a bag


class ForceProxy:
    """Mean net contact force and torque on the thing that a task has for it (`Task.felt`); copied with its environment."""

    def __init__(self) -> None:
        self._silent_above = _SILENT_ABOVE

    def begin(self, env: Any) -> None:
        """An episode begins; the scene has settled."""
        felt = env.definition.felt
        self._silent_above = max(_SILENT_ABOVE, -np.inf if felt is None else float(env.position(felt)[2]) + _LIFTED)

    def observe(self, env: Any, sensordata: np.ndarray) -> np.ndarray:
        """(6,) float32 [N, Nm] of a control step's sensor readings (T, nsensordata)."""
        felt = env.definition.felt
        is_silent = felt is None or env.position(felt)[2] > self._silent_above
        force = np.zeros(6) if is_silent else env.contacts.felt(sensordata).mean(axis=0)
        return force.astype(np.float32)
