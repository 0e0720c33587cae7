"""Frame rates: mostly whole numbers, but films also have 12.5, 29.97 and 30000 / 1001 frames per second.

JSON that other tools wrote has 20.0 for 20. LeRobot keeps what stands there, and here it is 20 again. A row of sound holds as
many samples as any other, so a sample rate fits a frame rate if their quotient is whole.
"""

from fractions import Fraction

_LARGEST_DENOMINATOR = 1001  # 30000 / 1001, which JSON has as 29.97002997002997


def frame_rate(fps: float) -> float:
    """A frame rate [Hz] as it is written: an int where it is whole."""
    return int(fps) if fps == int(fps) else fps


def exact_rate(fps: float) -> Fraction:
    """The fraction that a frame rate [Hz] stands for: 2997 / 100 for 29.97."""
    return Fraction(fps).limit_denominator(_LARGEST_DENOMINATOR) or Fraction(fps)


def divides(fps: float, sample_rate: int) -> bool:
    """Whether every frame has as many samples as any other, one at least."""
    return sample_rate > 0 and fps > 0 and (sample_rate / exact_rate(fps)).denominator == 1


def nearest_sample_rate(sample_rate: float, fps: float) -> int:
    """The sample rate [Hz] next to another that the frame rate divides."""
    step = exact_rate(fps).numerator
    return max(1, round(sample_rate / step)) * step


def sample_rate_of(n_samples: int, fps: float) -> int:
    """The sample rate [Hz] of sound with so many samples per frame."""
    return round(n_samples * exact_rate(fps))
