"""A picture of what the latency was measured from."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lerobot_playbyear.calibration.estimator import Latency

_WIDTH, _ROW, _TOP, _LEFT = 900, 56, 60, 60
_BEFORE_S, _AFTER_S = 0.4, 0.4
_INK, _MOTION, _SOUND, _MARK, _PALE = "#222222", "#e08214", "#2166ac", "#b2182b", "#dddddd"


def write_plot(
    path: Path,
    found: Latency,
    pictures: tuple[np.ndarray, np.ndarray],
    sound: tuple[np.ndarray, np.ndarray],
) -> Path:
    """Writes a PNG with a row per tap: motion as bars, the level of sound as a line, and where sound begins.

    Args:
        path: The file; its folder is made.
        found: What was found.
        pictures: Times (n,) [s] and motion (n,).
        sound: Times (m,) [s] and level (m,).

    Returns:
        The path.

    Raises:
        OSError: It cannot be written.
    """
    image = Image.new("RGB", (_WIDTH, _TOP + _ROW * len(found.taps) + 30), "white")
    draw = ImageDraw.Draw(image)
    draw.text((_LEFT, 10), f"Sound arrives {found.latency_s * 1000:+.0f} ms after the picture", fill=_INK)
    legend = "Orange: motion, of each picture. Blue: sound. Red: its begin. Gray: when the tap was seen. 0: its middle."
    draw.text((_LEFT, 28), legend, fill=_INK)
    for row, tap in enumerate(found.taps):
        middle, bottom = (tap.after_s + tap.until_s) / 2, _TOP + _ROW * (row + 1) - 6

        def x_of(time_s: float, middle: float = middle) -> float:
            return _LEFT + (time_s - middle + _BEFORE_S) / (_BEFORE_S + _AFTER_S) * (_WIDTH - 2 * _LEFT)

        draw.rectangle((x_of(tap.after_s), bottom - _ROW + 10, x_of(tap.until_s), bottom), fill=_PALE)
        times, motion = _near(pictures, middle)
        for time_s, height in zip(times, motion, strict=True):
            draw.rectangle((x_of(time_s) - 2, bottom - height, x_of(time_s) + 2, bottom), fill=_MOTION)
        times, level = _near(sound, middle)
        draw.line([(x_of(time_s), bottom - height) for time_s, height in zip(times, level, strict=True)], fill=_SOUND)
        draw.line((x_of(tap.heard_s), bottom - _ROW + 10, x_of(tap.heard_s), bottom), fill=_MARK)
        draw.text((8, bottom - 14), f"{tap.latency_s * 1000:+.0f} ms", fill=_INK)
    bottom = image.height - 20
    for at in np.arange(-_BEFORE_S, _AFTER_S + 0.01, 0.1).tolist():
        x = _LEFT + (at + _BEFORE_S) / (_BEFORE_S + _AFTER_S) * (_WIDTH - 2 * _LEFT)
        draw.line((x, bottom - 6, x, bottom), fill=_INK)
        draw.text((x - 12, bottom + 2), str(round(at * 1000)), fill=_INK)
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, format="PNG")
    return path


def _near(curve: tuple[np.ndarray, np.ndarray], middle: float) -> tuple[np.ndarray, np.ndarray]:
    """The part of a curve that a row shows, as high as the row."""
    times, values = curve
    shown = (times > middle - _BEFORE_S) & (times < middle + _AFTER_S)
    part = values[shown].astype(np.float64)
    highest = part.max() if len(part) else 0.0
    return times[shown], part * ((_ROW - 12) / highest if highest > 0 else 0)
