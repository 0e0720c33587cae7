"""Microphones through PortAudio and a real sound server, and from files: which card, which samples, what goes wrong."""

import contextlib
import gc
import logging
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.utils.errors import DeviceNotConnectedError
from sound_server import RATE, Player, started, why_not

from lerobot_playbyear.audio.control_steps import HALF
from lerobot_playbyear.audio.sample_strip import Strip, read_strip
from lerobot_playbyear.audio.session_files import SessionSound, find_session
from lerobot_playbyear.datasets.audio_files import write_wav
from lerobot_playbyear.microphones.camera import MicrophoneCamera, MicrophoneCameraConfig, MicrophoneOptionError
from lerobot_playbyear.microphones.file import PlayedMicrophone
from lerobot_playbyear.microphones.microphone import MicrophoneError, register_source
from lerobot_playbyear.microphones.portaudio import SoundCard, channels_to_open, find_card
from lerobot_playbyear.microphones.session_file import SessionFile

TICK_S = 1 / 20
TAP = np.full(48, 20000, np.int16)  # a millisecond

needs_server = pytest.mark.skipif(bool(why_not()), reason=why_not())


def options(**changes: Any) -> MicrophoneCameraConfig:
    return MicrophoneCameraConfig(**{"sample_rate": RATE, "save_to": "none", **changes})


@contextlib.contextmanager
def listening(**configs: MicrophoneCameraConfig) -> Iterator[dict[str, MicrophoneCamera]]:
    """Cameras as LeRobot makes and connects them."""
    cameras: dict[str, MicrophoneCamera] = make_cameras_from_configs(configs)  # type: ignore[assignment]
    try:
        for camera in cameras.values():
            camera.connect()
        yield cameras
    finally:
        for camera in cameras.values():
            if camera.is_connected:
                camera.disconnect()


def heard(camera: MicrophoneCamera) -> Strip:
    strip = read_strip(camera.read_latest())
    assert strip is not None
    return strip


def until_error(camera: MicrophoneCamera, timeout_s: float) -> Exception:
    """What reading raises at last, at the pace of a control loop."""
    end = time.perf_counter() + timeout_s
    while time.perf_counter() < end:
        try:
            camera.read_latest()
        except (DeviceNotConnectedError, TimeoutError) as error:
            return error
        time.sleep(0.02)
    raise AssertionError("nothing was told")


# Which card


@needs_server
def test_a_card_is_found_by_its_number_its_name_and_a_part_of_its_name_that_no_other_has():
    with started(bench=1, bench_left=2, table=2):
        for wanted, name in [(2, "table"), ("2", "table"), ("table, ALSA", "table"), ("ABLE", "table")]:
            assert find_card(wanted, 2).name == f"{name}, ALSA"
        assert find_card("bench", 1).name == "bench, ALSA"  # whole, though it is a part of another


@needs_server
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"device": "bench_"}, "fits more than one sound card"),
        ({"device": "piano"}, "is no sound card with an input"),
        ({"device": 7}, "is no sound card with an input"),
        ({"device": "bench_left", "channel": 40}, "channel 40 is asked for"),
    ],
)
def test_another_card_is_never_taken(changes, said):
    with started(bench_left=1, bench_right=2):
        camera = MicrophoneCamera(options(**changes))
        with pytest.raises(MicrophoneError) as raised:
            camera.connect()
        assert said in str(raised.value)
        assert "bench_left" in str(raised.value)
        assert "\n" not in str(raised.value)
        assert not camera.is_connected


@needs_server
def test_a_card_that_was_plugged_in_later_is_found_but_never_at_the_cost_of_an_open_one():
    with started(table=1) as server, Player(server.fifo("table"), 1):
        cards = Path(server.environment["ALSA_CONFIG_PATH"])
        cards.write_text(cards.read_text() + cards.read_text().splitlines()[-1].replace("pcm.table", "pcm.new_one"))
        first, later = (MicrophoneCamera(options(device=name)) for name in ("table", "new_one"))
        first.connect()
        with pytest.raises(MicrophoneError, match="is no sound card"):
            later.connect()
        before = heard(first).counter
        time.sleep(0.2)
        assert heard(first).counter > before  # it goes on
        first.disconnect()
        later.connect()
        later.disconnect()


@needs_server
def test_a_channel_is_that_of_the_card_and_no_mixture_of_several():
    """A sound server gives the mean of left and right to whom asks for one channel."""
    loud = np.full((8 * RATE, 2), [1000, 3000], np.int16)
    with started(table=2) as server, Player(server.fifo("table"), 2, noise=0) as player:
        player.play(loud, time.perf_counter())
        with listening(mic=options(device="table")) as cameras:
            time.sleep(0.3)
            samples = heard(cameras["mic"]).samples
    assert set(np.unique(samples)) <= {0, 1000}
    assert 1000 in samples


def test_how_many_channels_are_opened():
    def card(channels: int) -> SoundCard:
        return SoundCard(0, "card", channels, RATE, True)

    assert [channels_to_open(card(4), 1), channels_to_open(card(1), 1), channels_to_open(card(32), 1)] == [4, 1, 2]
    assert channels_to_open(card(32), 3) == 3


# Which samples


@needs_server
def test_two_microphones_of_one_card_share_its_stream_and_are_alike_to_the_sample():
    rng = np.random.default_rng(0)
    left = rng.integers(-30000, 30000, 2 * RATE).astype(np.int16)
    configs = {name: options(device="table", channel=i) for i, name in enumerate(("left", "right"))}
    with (
        started(table=2) as server,
        Player(server.fifo("table"), 2, noise=0) as player,
        listening(**configs) as cameras,
    ):
        player.play(np.stack([left, -left], axis=1), time.perf_counter() + 0.1)
        time.sleep(0.8)
        strips = [heard(camera) for camera in cameras.values()]
    assert strips[0].counter == strips[1].counter
    np.testing.assert_array_equal(strips[0].samples, -strips[1].samples)
    assert np.abs(strips[0].samples.astype(int)).mean() > 10000


@needs_server
def test_a_tap_is_heard_soon_after_it_was_played_and_always_as_late():
    with (
        started(table=1) as server,
        Player(server.fifo("table"), 1) as player,
        listening(mic=options(device="table")) as c,
    ):
        begins = time.perf_counter() + 0.3
        taps = begins + np.arange(20) * 0.21
        for tap in taps:
            player.play(TAP, tap)
        late, last = [], 0
        while time.perf_counter() < taps[-1] + 0.1:
            time.sleep(TICK_S)
            now, strip = time.perf_counter(), heard(c["mic"])
            loud = strip.counter - len(strip.samples) + np.flatnonzero(np.abs(strip.samples.astype(int)) > 8000)
            if len(new := loud[loud > last + RATE // 10]):
                at = now - (strip.counter - new[0]) / RATE  # when it was heard, if the newest sample is of now
                late.append(float(at - taps[np.abs(taps - at).argmin()]))
                last = int(new[0])
    assert len(late) >= 18
    assert 0 <= np.median(late) < 0.05  # the server's own latency and a chunk
    assert np.percentile(np.abs(late - np.median(late)), 90) < 0.005


def test_a_pictures_sound_is_of_its_moment_to_5_ms():
    """With a card that has no delay of its own; what attaching and acting take is in it."""
    begun: list[float] = []

    @register_source("timed")
    def timed(config: MicrophoneCameraConfig, channels: int) -> PlayedMicrophone:
        class Timed(PlayedMicrophone):
            def _play(self) -> None:
                begun.append(time.perf_counter())
                super()._play()

        return Timed("the clock", np.ones((RATE, channels), np.int16), config.sample_rate)

    late = []
    with listening(mic=options(source="timed")) as cameras:
        for _ in range(60):
            now = time.perf_counter()
            late.append(now - begun[0] - (heard(cameras["mic"]).counter - HALF) / RATE)
            time.sleep(max(now + TICK_S - time.perf_counter(), 0))
    assert np.median(late) < 0.005
    assert np.percentile(late, 90) < 0.007  # a busy machine may be late for once
    assert min(late) > 0


def test_microphones_of_one_card_have_one_sample_rate(tmp_path):
    path = str(write_wav(tmp_path / "sound.wav", np.ones((RATE, 2), np.int16), RATE))
    with (
        pytest.raises(MicrophoneError, match=r"have sample_rate 48000 and 16000: give them the same"),
        listening(left=options(file=path), right=options(file=path, channel=1, sample_rate=16000)),
    ):
        pass


# What goes wrong


@needs_server
def test_a_server_that_dies_is_told_within_a_step_and_heard_again_when_it_is_back():
    with started(table=2) as server, Player(server.fifo("table"), 2), listening(mic=options(device="table")) as cameras:
        camera = cameras["mic"]
        camera.read_latest()
        killed = time.perf_counter()
        server.kill()
        assert "sound server, has ended the recording" in str(until_error(camera, 5))
        assert time.perf_counter() - killed < 3 * TICK_S
        camera.disconnect()
        with pytest.raises(MicrophoneError, match="sound server running"):
            camera.connect()
        server.start()
        camera.connect()
        camera.read_latest()


@needs_server
def test_a_card_that_is_pulled_out_is_told():
    with (
        started(table=2, other=2) as server,
        Player(server.fifo("table"), 2),
        listening(mic=options(device="table")) as c,
    ):
        server.remove("table")
        assert "table" in str(until_error(c["mic"], 10))


@needs_server
def test_a_card_that_gives_nothing_but_zeros_is_told_once(caplog):
    with (
        started(table=1) as server,
        Player(server.fifo("table"), 1, noise=0),
        listening(mic=options(device="table")) as c,
    ):
        end = time.perf_counter() + 2.5
        while time.perf_counter() < end:
            c["mic"].read_latest()
            time.sleep(TICK_S)
    assert caplog.text.count("gives nothing but zeros") == 1


class MadeUpPortAudio(ModuleType):
    """Cards of one channel that are found by their names, and get another handle when they are plugged in again."""

    class PortAudioError(Exception):
        pass

    class _StreamBase:
        samplerate: float

        def __init__(self) -> None:
            self.closed = False

        def close(self, ignore_errors: bool = True) -> None:
            self.closed = True

        abort = close

    def __init__(self, **handles: int) -> None:
        super().__init__("sounddevice")
        self.plugged_in, self.seen = dict(handles), dict(handles)
        self.default = SimpleNamespace(device=(0, 0))
        self.open: list[MadeUpPortAudio._StreamBase] = []

    def query_hostapis(self) -> list[dict[str, str]]:
        return [{"name": "Core Audio"}]

    def query_devices(self) -> list[dict[str, object]]:
        rest = {"hostapi": 0, "max_input_channels": 1, "default_samplerate": RATE}
        return [{"name": name, **rest} for name in self.seen]

    def _terminate(self) -> None:
        assert all(stream.closed for stream in self.open)

    def _initialize(self) -> None:
        self.seen = dict(self.plugged_in)

    def InputStream(self, samplerate, blocksize, device, callback, **options):  # noqa: N802
        name, handle = list(self.seen.items())[device]
        if self.plugged_in.get(name) != handle:
            raise self.PortAudioError("Device unavailable")
        stream = self._StreamBase()
        stream.samplerate = samplerate
        self.open.append(stream)

        def play() -> None:
            while not stream.closed:
                time.sleep(blocksize / samplerate)
                if self.plugged_in.get(name) == handle:
                    callback(np.ones((blocksize, 1), np.int16), blocksize, None, None)

        stream.start = threading.Thread(target=play, daemon=True).start
        return stream


def test_of_two_cards_one_that_was_plugged_in_again_is_found(monkeypatch):
    port_audio = MadeUpPortAudio(left=10, right=11)
    monkeypatch.setitem(sys.modules, "sounddevice", port_audio)
    left, right = (MicrophoneCamera(options(device=name)) for name in ("left", "right"))
    left.connect()
    right.connect()
    del port_audio.plugged_in["right"]
    assert "has brought nothing" in str(until_error(right, 5))
    port_audio.plugged_in["right"] = 12
    right.disconnect()
    with pytest.raises(MicrophoneError, match="Device unavailable"):  # PortAudio would close the left one to look again
        right.connect()
    left.disconnect()
    for camera in (left, right):
        camera.connect()
        camera.read_latest()
        camera.disconnect()
    assert all(stream.closed for stream in port_audio.open)


# Other people's microphones

_PLUGIN = """
import numpy as np
from lerobot_playbyear.microphones import register_source
from lerobot_playbyear.microphones.file import PlayedMicrophone

@register_source("tin_can")
def tin_can(config, channels):
    return PlayedMicrophone("the tin can " + config.device, np.full((100, channels), 7, np.int16), config.sample_rate)
"""


def test_an_installed_distribution_brings_its_own_source_and_a_broken_one_harms_no_other(tmp_path, monkeypatch, caplog):
    for name, text in {"lerobot_microphone_broken": "import no_such_module", "lerobot_microphone_tin": _PLUGIN}.items():
        (tmp_path / f"{name}.py").write_text(text)
        (tmp_path / f"{name}-0.1.dist-info").mkdir()
        (tmp_path / f"{name}-0.1.dist-info/METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with listening(mic=options(source="tin_can", device="string")) as cameras:
        assert set(np.unique(heard(cameras["mic"]).samples)) == {7}
    assert "lerobot_microphone_broken" in caplog.text
    with (
        pytest.raises(MicrophoneError, match=r"source='no' .* there is .*tin_can"),
        listening(mic=options(source="no")),
    ):
        pass


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"file": None}, "nothing: give one of device, file and tone_hz"),
        ({"tone_hz": 440.0}, "file and tone_hz: give one"),
        ({"sample_rate": 0}, "sample_rate=0"),
        ({"channel": -1}, "channel=-1"),
        ({"gain_db": float("nan")}, "gain_db=nan"),
        ({"low_db": -10.0}, "low_db=-10.0"),
        ({"high_db": float("inf")}, "high_db=inf"),
        ({"width": 90}, "width=96"),
        ({"width": 225}, "both even"),
        ({"height": 98}, "at this width height=100"),
    ],
)
def test_an_option_without_meaning_is_named(changes, said):
    with pytest.raises(MicrophoneOptionError, match=said):
        options(**{"file": "x.wav", **changes})


@pytest.mark.parametrize(
    ("changes", "said"), [({"channel": 2}, "channel 2 is asked for"), ({"file": "no.wav"}, "no.wav")]
)
def test_a_file_that_does_not_fit_is_refused(changes, said, tmp_path):
    path = str(write_wav(tmp_path / "sound.wav", np.ones((RATE, 2), np.int16), RATE))
    with pytest.raises(MicrophoneError, match=said), listening(mic=options(**{"file": path, **changes})):
        pass


# The session's sound


def test_the_pictures_samples_are_those_of_the_sessions_file_bit_for_bit_with_gain(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    path = write_wav(tmp_path / "noise.wav", np.random.default_rng(0).normal(0, 3000, (RATE, 2)).astype(np.int16), RATE)
    changes = {"file": str(path), "save_to": str(tmp_path / "sessions")}
    with listening(left=options(**changes), right=options(**changes, channel=1, gain_db=12)) as cameras:
        strips = []
        for _ in range(10):
            strips += [heard(camera) for camera in cameras.values()]
            time.sleep(TICK_S)
    for strip in strips:
        found = find_session(tmp_path / "sessions", strip.session)
        assert found is not None
        samples = SessionSound(found).samples(strip.counter - len(strip.samples), strip.counter)
        np.testing.assert_array_equal(samples, strip.samples)
        assert caplog.text.count(str(found)) == 2  # told at the beginning and at the end
    assert strips[-1].samples.max() == 32767  # 3,000 and 12 dB more


def test_a_full_disk_ends_the_recording_with_its_reason(tmp_path, monkeypatch):
    write = SessionFile._write

    def full(self, data, place):
        if place > 20000:
            raise OSError(28, "No space left on device")
        write(self, data, place)

    monkeypatch.setattr(SessionFile, "_write", full)
    with listening(mic=options(tone_hz=440.0, save_to=str(tmp_path))) as cameras:
        assert "No space left on device" in str(until_error(cameras["mic"], 5))


def test_a_microphone_that_is_forgotten_listens_no_longer(tmp_path):
    camera = MicrophoneCamera(options(tone_hz=440.0, save_to=str(tmp_path)))
    camera.connect()
    del camera
    gc.collect()
    (path,) = tmp_path.glob("*.wav")
    size = path.stat().st_size
    time.sleep(0.3)
    assert path.stat().st_size == size


def test_without_a_file_it_says_that_a_video_loses_the_sound(caplog):
    with listening(mic=options(tone_hz=440.0)):
        assert "a dataset with videos loses it" in caplog.text
