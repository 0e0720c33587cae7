"""`playbyear-calibrate-latency`: a person taps in view of a camera and near a microphone."""

import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lerobot.cameras
from lerobot.cameras import CameraConfig

from lerobot_playbyear.calibration.estimator import (
    EVENTS,
    FEWEST_TAPS,
    CalibrationError,
    Latency,
    estimate_latency,
    sound_onsets,
)
from lerobot_playbyear.calibration.listening import Motion, SoundLevel
from lerobot_playbyear.calibration.plot import write_plot
from lerobot_playbyear.compat import import_devices
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import check_can_be_made
from lerobot_playbyear.microphones.config import MicrophoneConfig, make_microphone
from lerobot_playbyear.microphones.microphone import Microphone, MicrophoneError, wait_for_first_sound

_LOOK_S = 0.2
_STALLED_S = 2.0  # a microphone that brings nothing for as long is gone
_AFTER_LAST_S = 0.7
_MOST_FPS = 1000
_ASKED = {
    "stops": "Tap the table, or clap, {n} times, and let the hand rest after each for half a second.",
    "begins": "Make {n} sounds at which something in the picture begins to move or to shine, a second apart.",
}

import_devices(lerobot.cameras)  # registers their types


@dataclass
class CalibrateLatencyConfig:
    """Options of `playbyear-calibrate-latency`.

    Args:
        camera: LeRobot's options of a camera.
        microphone: Its options; its `latency_s` is not used.
        taps: How many.
        event: Whether motion "stops" with the sound, as a hand that taps does, or "begins".
        timeout_s: For how long it waits for the taps [s].
        plot: A picture of what was measured.
    """

    camera: CameraConfig
    microphone: MicrophoneConfig
    taps: int = 10
    event: str = "stops"
    timeout_s: float = 60.0
    plot: Path = Path("outputs/latency.png")

    def check(self) -> None:
        """
        Raises:
            InputError: An option is out of range, or the plot's folder cannot be made.
        """
        if self.taps < FEWEST_TAPS:
            raise InputError(f"taps={self.taps}: give at least {FEWEST_TAPS}.")
        if self.event not in EVENTS:
            raise InputError(f"event={self.event!r}: give one of {', '.join(EVENTS)}.")
        if not 1 <= self.timeout_s <= 3600:
            raise InputError(f"timeout_s={self.timeout_s}: give seconds from 1 to 3600.")
        check_can_be_made(self.plot.parent, f"--plot={self.plot}")


def calibrate_latency(cfg: CalibrateLatencyConfig) -> Latency:
    """Measures how much later sound arrives than pictures, prints which option to give, and writes the plot.

    Raises:
        CalibrationError: The camera gives no pictures, the taps do not tell the latency, or the plot cannot be written.
        MicrophoneError: The microphone cannot be opened, or brings nothing.
    """
    cfg.check()
    level = SoundLevel(cfg.microphone.sample_rate, cfg.microphone.channel)
    microphone = make_microphone(cfg.microphone)
    with ExitStack() as stack:
        camera = _connected(cfg.camera)
        stack.callback(camera.disconnect)
        motion = Motion(camera)
        motion.start()
        stack.callback(motion.end)
        microphone.connect(level.listen)
        stack.callback(microphone.disconnect)
        wait_for_first_sound(microphone, level.listen, level.wait_for_sound)
        print(_ASKED[cfg.event].format(n=cfg.taps), flush=True)
        _wait_for_taps(cfg, level, motion, microphone)
        pictures, sound = motion.so_far(), level.so_far()
    found = estimate_latency(*pictures, *sound, cfg.event)
    print(told(found, cfg.microphone.sample_rate), flush=True)  # first: nobody taps twice for a plot
    try:
        print(f"Plot: {write_plot(cfg.plot, found, pictures, sound)}")
    except OSError as error:
        raise CalibrationError(
            f"--plot={cfg.plot} cannot be written: {error.strerror or error}; wanted a file that can be made. What was "
            "measured stands above and holds; for the plot give another file, and tap again."
        ) from error
    return found


def told(found: Latency, sample_rate: int) -> str:
    """What was found, and which options to give, with a microphone of this rate [Hz]."""
    ms = found.latency_s * 1000
    side = f"{abs(ms):.0f} ms later than the picture" if ms >= 0 else f"{abs(ms):.0f} ms earlier than the picture"
    lines = [
        f"Sound arrives {side}, within about {found.resolution_s * 500 + 1:.0f} ms.",
        f"{len(found.taps)} of {found.n_heard} taps; median {found.median_s * 1000:.0f} ms, median absolute deviation "
        f"{found.spread_s * 1000:.0f} ms. Each tap alone is as coarse as the camera's pictures.",
    ]
    if ms >= 0:
        latency_s = round(found.latency_s, 3)
        can_be = (fps for fps in range(1, _MOST_FPS + 1) if latency_s < 1 / fps and sample_rate % fps == 0)
        fastest = max(can_be, default=1)
        lines.append(
            f"Give the microphone latency_s: {latency_s:.3f}, such as "
            f"--env.microphones='{{table: {{type: portaudio, device: ..., latency_s: {latency_s:.3f}}}}}'"
        )
        lines.append(f"Every tick has to be longer than that: give --env.fps={fastest} or less.")
    else:
        lines.append(f"Give the camera --env.camera_latency_s={-found.latency_s:.3f}")
    return "\n".join(lines)


def _connected(config: CameraConfig) -> Any:
    from lerobot.cameras.utils import make_cameras_from_configs

    try:
        camera = make_cameras_from_configs({"camera": config})["camera"]
        camera.connect()
    except Exception as error:  # whatever a camera's own program may raise
        said = " ".join(str(error).split())
        raise CalibrationError(
            f"The camera cannot be opened: {said} (lerobot-find-cameras lists what there is)"
        ) from error
    return camera


def _wait_for_taps(cfg: CalibrateLatencyConfig, level: SoundLevel, motion: Motion, microphone: Microphone) -> None:
    end, n_told = time.perf_counter() + cfg.timeout_s, 0
    while time.perf_counter() < end:
        time.sleep(_LOOK_S)
        motion.so_far()  # says if the camera is gone
        n_heard = len(sound_onsets(*level.so_far()))
        if n_heard > n_told:
            n_told = n_heard
            print(f"{n_heard} of {cfg.taps}", flush=True)
        if n_heard >= cfg.taps:
            time.sleep(_AFTER_LAST_S)
            return
        _check(microphone)


def _check(microphone: Microphone) -> None:
    """
    Raises:
        MicrophoneError: It is gone.
    """
    silent_for_s = microphone.silent_for_s
    if microphone.problem or silent_for_s > _STALLED_S:
        why = microphone.problem or f"nothing has come for {silent_for_s:.1f} s"
        raise MicrophoneError(f"From {microphone.name} no more sound comes: {why}. Look at its cable, and tap again.")
