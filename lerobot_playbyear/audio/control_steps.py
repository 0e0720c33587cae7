"""The sound of each control step, from a microphone's newest samples at every step: the same in a dataset and while acting.

A loop's steps are not exactly as long as they should be (803 samples where 800 were meant), so what was heard between two steps
is resampled to one step's samples. Each sample of the result depends on `2 * HALF` samples around its moment, so that the sound
comes `HALF` samples late (1 ms at 16 kHz).

Here stands what a gap is. **Sound** is resampled where a step is between half and twice as long as it should be. A shorter one
(the first after a takeover) is not stretched, a longer one (a late step) is not squeezed: both get the newest samples as
they are.
**Memory** ends at a pause, where more than half a second was not recorded, as LeRobot's rollout resets the policy then.
"""

import logging
from collections.abc import Sequence

import numpy as np

from lerobot_playbyear.audio.audio_files import HALF, interpolate
from lerobot_playbyear.audio.microphone_pictures import KEPT_S, Strip
from lerobot_playbyear.datasets.errors import InputError

PAUSE_S = 0.5
"""Steps further apart than this do not belong together: a pause or a takeover lies between them [s]."""

_SHORTEST, _LONGEST = 0.5, 2.0  # of a step, in steps
_FASTEST, _SLOWEST, _USUAL = 0.75, 1.5, 0.1  # steps that are shorter or longer than meant, in steps


class ControlStepSound:
    """Makes the sound of one control step after the other.

    Args:
        n_samples: Of a step, S.

    Attributes:
        n_heard: How many samples came during the last step; None where it is the first one of a recording.

    Raises:
        ValueError: A strip is shorter than such a step.
    """

    def __init__(self, n_samples: int) -> None:
        self._size = n_samples
        self._last: Strip | None = None
        self.n_heard: int | None = None

    def next(self, strip: Strip) -> tuple[np.ndarray, bool]:
        """The sound of the step that ends with a strip.

        Returns:
            (S,) int16, and whether the step is the first one of a recording, or after a pause.
        """
        last, self._last = self._last, strip
        n, size, kept = None, self._size, len(strip.samples)
        if last is not None and (last.session, last.sample_rate) == (strip.session, strip.sample_rate):
            n = strip.counter - last.counter if strip.counter >= last.counter else None
        self.n_heard = n
        if size + 2 * HALF > kept:
            raise ValueError(
                f"A control step of {size} samples is longer than what a microphone's picture holds ({KEPT_S} s): give more "
                "frames per second, 5 or more."
            )
        is_first = n is None or n > PAUSE_S * strip.sample_rate
        if n is None or not _SHORTEST * size <= n <= min(_LONGEST * size, kept - 2 * HALF):
            return strip.samples[kept - size - HALF : kept - HALF], is_first
        places = kept - 1 - HALF - n + (np.arange(size) + 1) * (n / size)  # (S,), the last one ends with the step
        return interpolate(strip.samples, places), is_first


def check_pace(spacing: Sequence[int], rate: int, fps: float, what: str, so: str = "", is_live: bool = False) -> None:
    """Whether control steps are as long as a frame rate says: LeRobot compares `--fps` and `--dataset.fps` with nothing.

    Args:
        spacing: Samples between steps.
        rate: Of these samples [Hz].
        fps: The frame rate [Hz].
        what: Whose it is, for the message.
        so: What follows from it, as the error begins.
        is_live: A robot moves: that it is slow is only told.

    Raises:
        InputError: They are so much shorter or longer that another frame rate was meant.
    """
    if len(spacing) < 5:
        return
    seen = float(np.median(spacing)) * fps / rate
    told = f"{what} has fps={fps:g}, and the control steps are {1000 * seen / fps:.1f} ms apart ({fps / seen:.1f} per second)"
    if seen < _FASTEST or (seen > _SLOWEST and not is_live):
        raise InputError(f"{so}{told}: use one rate for --fps and --dataset.fps.")
    if abs(seen - 1) > _USUAL:
        logging.warning("%s: the machine is too slow, or too busy.", told)
