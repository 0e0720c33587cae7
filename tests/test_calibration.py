"""The latency of sound beside pictures is found from taps, whatever the rate of pictures, or refused."""

import contextlib
import threading
import time
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
from lerobot.cameras import Camera, CameraConfig
from PIL import Image
from sound_server import RATE, Player, started, why_not

from lerobot_playbyear.calibration import calibrate
from lerobot_playbyear.calibration.calibrate import CalibrateLatencyConfig, calibrate_latency
from lerobot_playbyear.calibration.estimator import CalibrationError, estimate_latency
from lerobot_playbyear.calibration.listening import SoundLevel
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.microphones import microphone as microphones
from lerobot_playbyear.microphones.config import MicrophoneConfig, PortAudioMicrophoneConfig
from lerobot_playbyear.microphones.microphone import Microphone, MicrophoneError


def recorded(
    latency_s: float,
    *,
    event: str = "begins",
    n_taps: int = 10,
    fps: float = 30.0,
    seed: int = 0,
    wrong: int = 0,
    jitter_s: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times and motion of pictures, times and level of sound, of taps about 0.8 s apart."""
    rng = np.random.default_rng(seed)
    taps = 1 + np.arange(n_taps) * 0.8 + rng.uniform(0, 0.1, n_taps)
    picture_times = np.arange(0, taps[-1] + 1, 1 / fps) + rng.uniform(0, 0.002)
    places = np.zeros(len(picture_times))  # of a hand that moves for 0.2 s, or a lamp that changes at once
    for tap in taps:
        begin = tap - 0.2 if event == "stops" else tap
        places += np.clip((picture_times - begin) / 0.2, 0, 1) if event == "stops" else picture_times >= tap
    motion = np.abs(np.diff(places, prepend=0)) + rng.uniform(0, 0.002, len(places))
    sound_times = np.arange(0, taps[-1] + 1, 0.001)
    level = rng.uniform(0, 5, len(sound_times))
    for index, tap in enumerate(taps):
        heard = tap + latency_s + rng.normal(0, jitter_s) + (0.3 if index < wrong else 0)
        since = sound_times - heard
        level += np.where(since >= 0, 3000 * np.exp(-since / 0.02), 0)
    return picture_times, motion, sound_times, level


@pytest.mark.parametrize("event", ["begins", "stops"])
@pytest.mark.parametrize("latency_s", [0.037, 0.0, -0.08, 0.25])
@pytest.mark.parametrize("fps", [15, 30, 60])
def test_the_latency_is_found_finer_than_the_rate_of_pictures(event, latency_s, fps):
    errors = []
    for seed in range(10):
        found = estimate_latency(*recorded(latency_s, event=event, fps=fps, seed=seed, jitter_s=0.001), event=event)
        errors.append(abs(found.latency_s - latency_s))
        assert abs(found.latency_s - latency_s) <= found.resolution_s + 0.004
    assert np.median(errors) < 0.2 / fps + 0.001


def test_sounds_that_belong_to_nothing_do_not_move_it():
    found = estimate_latency(*recorded(0.037, wrong=3), event="begins")
    assert found.latency_s == pytest.approx(0.037, abs=0.008)
    assert len(found.taps) == 7
    assert found.n_heard == 10


@pytest.mark.parametrize(
    ("options", "said"),
    [({"n_taps": 4}, "5 are needed"), ({"jitter_s": 0.2, "n_taps": 12}, "spread|belong together")],
)
def test_too_few_taps_and_taps_that_disagree_are_refused(options, said):
    with pytest.raises(CalibrationError, match=said):
        estimate_latency(*recorded(0.037, **options), event="begins")


def test_silence_and_a_picture_in_which_nothing_moves_are_refused():
    picture_times, motion, sound_times, level = recorded(0.037)
    with pytest.raises(CalibrationError, match="0 sounds"):
        estimate_latency(picture_times, motion, sound_times, np.zeros_like(level))
    with pytest.raises(CalibrationError, match="0 motions"):
        estimate_latency(picture_times, np.zeros_like(motion), sound_times, level)


# In real time, with a camera and a microphone

FPS = 30
LATENCY_S = 0.037
TAP = np.full(96, 20000, np.int16)


class Taps:
    """When something happens that is seen and heard [s of time.perf_counter]."""

    times: ClassVar[np.ndarray] = np.zeros(0)

    @classmethod
    def begin(cls, n_taps: int = 10) -> None:
        """A tap every 0.7 s, each at another moment between two pictures."""
        cls.times = time.perf_counter() + 1 + np.arange(n_taps) * (0.7 + 0.37 / FPS)


@CameraConfig.register_subclass("lamp")
@dataclass(kw_only=True)
class LampCameraConfig(CameraConfig):
    works: bool = True


class LampCamera(Camera):
    """Sees a lamp that is switched with every tap; gives its pictures at their pace, as they were when they were due."""

    def __init__(self, config: LampCameraConfig) -> None:
        super().__init__(config)
        self._works, self._next, self._is_connected = config.works, 0.0, False

    @property
    def is_connected(self) -> bool:
        return self._is_connected

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        return []

    def connect(self, warmup: bool = True) -> None:
        self._is_connected, self._next = True, time.perf_counter()

    def read(self) -> np.ndarray:
        return self.async_read()

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        if not self._works:
            raise TimeoutError("no picture came")
        time.sleep(max(self._next - time.perf_counter(), 0))
        lit = int((Taps.times <= self._next).sum()) % 2
        self._next += 1 / FPS
        picture = np.full((120, 160, 3), 40, np.uint8)
        picture[40:80, 60:100] += np.uint8(150 * lit)
        return picture

    def disconnect(self) -> None:
        self._is_connected = False


@MicrophoneConfig.register_subclass("late_taps")
@dataclass(kw_only=True)
class LateTapsConfig(MicrophoneConfig):
    @property
    def card(self) -> Hashable:
        return "late_taps"

    def make(self, channels: int) -> Microphone:
        return LateTaps("late taps", self.sample_rate, channels)


class LateTaps(Microphone):
    """Hears the taps in quiet noise, and brings them 37 ms later."""

    def _open(self) -> None:
        self._ended = ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def _close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _play(self) -> None:
        rng, size, start, n = np.random.default_rng(0), 240, time.perf_counter(), 0
        while not self._stop.wait(max(start + (n + size) / self.sample_rate - time.perf_counter(), 0)):
            chunk = rng.normal(0, 5, (size, self.channels)).astype(np.int16)
            first = np.round((Taps.times + LATENCY_S - start) * self.sample_rate).astype(int) - n
            for begin in first[(first > -len(TAP)) & (first < size)]:
                chunk[max(begin, 0) : max(begin + len(TAP), 0)] += TAP[0]
            n += size
            self._heard(chunk, time.perf_counter())


@contextlib.contextmanager
def microphone(kind: str) -> Iterator[MicrophoneConfig]:
    """One that is 37 ms late; begins the taps."""
    if kind == "late_taps":
        Taps.begin()
        yield LateTapsConfig()
        return
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(started(table=1))
        player = stack.enter_context(Player(server.fifo("table"), 1))
        Taps.begin()
        for tap in Taps.times:
            player.play(TAP, tap + LATENCY_S)
        yield PortAudioMicrophoneConfig(device="table")


_NEEDS_SERVER = pytest.mark.skipif(bool(why_not()), reason=why_not())


@pytest.mark.parametrize("kind", ["late_taps", pytest.param("portaudio", marks=_NEEDS_SERVER)])
def test_a_latency_of_37_ms_is_found_to_5_ms(kind, tmp_path, capsys):
    with microphone(kind) as config:
        cfg = CalibrateLatencyConfig(LampCameraConfig(), config, event="begins", plot=tmp_path / "plots/latency.png")
        found = calibrate_latency(cfg)
    assert found.latency_s == pytest.approx(LATENCY_S, abs=0.005)
    assert len(found.taps) >= 9
    said = capsys.readouterr().out
    assert f"latency_s: {found.latency_s:.3f}" in said
    assert "10 of 10" in said
    with Image.open(cfg.plot) as plot:
        assert plot.format == "PNG"
        assert len(plot.convert("RGB").getcolors(1 << 16)) > 4


def test_what_was_measured_is_told_where_its_plot_cannot_be_written(tmp_path, capsys):
    Taps.begin()
    cfg = CalibrateLatencyConfig(LampCameraConfig(), LateTapsConfig(), event="begins", plot=tmp_path)  # a folder
    with pytest.raises(CalibrationError, match=r"--plot=.* cannot be written: Is a directory.* stands above and holds"):
        calibrate_latency(cfg)
    assert "Give the microphone latency_s: 0.0" in capsys.readouterr().out


def test_a_plot_that_can_go_nowhere_is_told_before_anybody_taps(tmp_path):
    (tmp_path / "file").touch()
    cfg = CalibrateLatencyConfig(LampCameraConfig(works=False), LateTapsConfig(), plot=tmp_path / "file/latency.png")
    with pytest.raises(
        InputError, match=r"--plot=.*/latency.png cannot be written: Not a directory in .*/file; wanted"
    ):
        calibrate_latency(cfg)


def test_a_camera_that_gives_no_pictures_ends_it_with_one_line(tmp_path):
    cfg = CalibrateLatencyConfig(LampCameraConfig(works=False), LateTapsConfig(), plot=tmp_path / "latency.png")
    with pytest.raises(CalibrationError, match="The camera gives no pictures: no picture came"):
        calibrate_latency(cfg)


def test_where_nobody_taps_it_ends_in_time_and_says_so(tmp_path):
    Taps.times = np.zeros(0)
    cfg = CalibrateLatencyConfig(LampCameraConfig(), LateTapsConfig(), timeout_s=1, plot=tmp_path / "latency.png")
    with pytest.raises(CalibrationError, match="5 are needed"):
        calibrate_latency(cfg)
    assert not cfg.plot.exists()


class FailingTaps(LateTaps):
    """Brings nothing before it is opened for the so-manieth time, and only so many chunks of 5 ms."""

    def __init__(self, opening: int, most: float, reason: str) -> None:
        super().__init__("the microphone 'tin can'", RATE, 1)
        self.opening, self.most, self.reason = opening, most, reason
        self.n_openings = self.n_heard = 0

    def _open(self) -> None:
        self.n_openings += 1
        super()._open()

    def _heard(self, chunk: np.ndarray, came_s: float) -> None:
        if self.n_openings >= self.opening:
            self.n_heard += 1
            if self.n_heard <= self.most:
                super()._heard(chunk, came_s)
            elif self.reason:
                self._end(self.reason)


@pytest.mark.parametrize(
    ("taps", "error", "said", "n_openings"),
    [
        ((3, 0, ""), MicrophoneError, "nothing after it was opened again. Is it plugged in", 2),
        ((2, np.inf, ""), CalibrationError, "5 are needed", 2),
        ((1, 60, ""), MicrophoneError, "tin can' no more sound comes: nothing has come for 0.", 1),
        ((1, 60, "its server is gone"), MicrophoneError, "no more sound comes: its server is gone", 1),
    ],
)
def test_a_microphone_that_is_dead_is_told_and_no_person_is_blamed(
    taps, error, said, n_openings, tmp_path, monkeypatch
):
    failing, Taps.times = FailingTaps(*taps), np.zeros(0)
    monkeypatch.setattr(microphones, "_FIRST_SOUND_S", 0.2)
    monkeypatch.setattr(calibrate, "_STALLED_S", 0.5)
    monkeypatch.setattr(calibrate, "make_microphone", lambda config: failing)
    timeout_s = 1 if error is CalibrationError else 60
    cfg = CalibrateLatencyConfig(LampCameraConfig(), LateTapsConfig(), timeout_s=timeout_s, plot=tmp_path / "plot.png")
    begins = time.perf_counter()
    with pytest.raises(error, match=said):
        calibrate_latency(cfg)
    assert time.perf_counter() - begins < 10
    assert failing.n_openings == n_openings


@pytest.mark.parametrize("options", [{"taps": 4}, {"event": "jumps"}, {"timeout_s": 0}])
def test_an_option_without_meaning_is_named(options):
    with pytest.raises(InputError, match=next(iter(options))):
        calibrate_latency(CalibrateLatencyConfig(LampCameraConfig(), LateTapsConfig(), **options))


def test_the_level_of_sound_stands_at_the_time_at_which_it_came_also_after_a_loss():
    level, rng = SoundLevel(RATE, 1), np.random.default_rng(0)
    for k in range(600):
        if 200 <= k < 240:
            continue  # a fifth of a second is lost
        chunk = np.zeros((240, 2), np.int16)
        chunk[0, 1] = 10000 if k % 100 == 50 else 0
        level.listen(chunk, 100 + (k + 1) * 0.005 + rng.uniform(0, 0.003))
    times, levels = level.so_far()
    heard = times[levels > 5000]
    wanted = 100 + np.array([50, 150, 350, 450, 550]) * 0.005
    assert [np.abs(heard - time_s).min() < 0.004 for time_s in wanted] == [True] * 5
