"""Microphones through PortAudio and a real sound server, and from files: which card, which samples, what goes wrong."""

import contextlib
import gc
import logging
import re
import shlex
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.utils.errors import DeviceNotConnectedError
from sound_server import RATE, Player, SoundServer, started, why_not
from support.distributions import install

from lerobot_playbyear.audio.audio_files import read_audio, write_audio
from lerobot_playbyear.audio.control_steps import HALF
from lerobot_playbyear.audio.microphone_pictures import SessionSound, Strip, find_session, read_strip
from lerobot_playbyear.microphones.camera import MicrophoneCamera, MicrophoneCameraConfig
from lerobot_playbyear.microphones.card import CardRecording, _open_cards
from lerobot_playbyear.microphones.finding import FindMicrophonesConfig, described, find_microphones, suggested_device
from lerobot_playbyear.microphones.microphone import SOURCES, MicrophoneError, PlayedMicrophone, register_source
from lerobot_playbyear.microphones.portaudio import SoundCard, cards_called, find_card, sound_cards
from lerobot_playbyear.microphones.session_file import SessionFile

FPS, CHUNK = 20, 144
TICK_S = 1 / FPS
ROUND_S = 3.0  # after which the samples' values begin again
STEPS_PER_S = 10_000  # of these values
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


@pytest.fixture(scope="module")
def server() -> Iterator[SoundServer]:
    """Its cards, all of them silent unless a test plays something."""
    with started(bench=1, bench_left=2, table=2) as server:
        yield server


# Which card


@needs_server
def test_a_card_is_found_by_its_number_its_name_and_a_part_of_its_name_that_no_other_has(server):
    for wanted, name in [(2, "table"), ("2", "table"), ("table, ALSA", "table"), ("ABLE", "table")]:
        assert find_card(wanted, 2).name == f"{name}, ALSA"
    assert find_card("bench", 1).name == "bench, ALSA"  # whole, though it is a part of another


@needs_server
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"device": "benc"}, "fits more than one sound card"),
        ({"device": 7}, "is not a sound card with an input"),
        ({"device": "bench_left", "channel": 40}, "channel 40 is asked for"),
    ],
)
def test_another_card_is_never_taken(changes, said, server):
    camera = MicrophoneCamera(options(**changes))
    with pytest.raises(MicrophoneError) as raised:
        camera.connect()
    assert said in str(raised.value)
    assert "bench_left" in str(raised.value)
    assert "\n" not in str(raised.value)
    assert not camera.is_connected


@needs_server
def test_a_card_that_was_plugged_in_later_is_found_but_never_at_the_cost_of_an_open_one(server):
    cards = Path(server.environment["ALSA_CONFIG_PATH"])
    cards.write_text(cards.read_text() + cards.read_text().splitlines()[-1].replace("pcm.table", "pcm.new_one"))
    first, later = (MicrophoneCamera(options(device=name)) for name in ("table", "new_one"))
    with Player(server.fifo("table"), 2):
        first.connect()
        with pytest.raises(MicrophoneError, match="is not a sound card"):
            later.connect()
        before = heard(first).counter
        time.sleep(0.2)
        assert heard(first).counter > before  # it goes on
        first.disconnect()
        later.connect()
        later.disconnect()


# Which samples


@needs_server
def test_a_channel_is_that_of_the_card_and_two_microphones_share_its_stream_to_the_sample(server):
    """A sound server gives the mean of left and right, here nothing, to whom asks for one channel."""
    left = np.random.default_rng(0).integers(-30000, 30000, 20 * RATE).astype(np.int16)
    configs = {name: options(device="table", channel=i) for i, name in enumerate(("left", "right"))}
    with Player(server.fifo("table"), 2, noise=0) as player:
        player.play(np.stack([left, -left], axis=1), time.perf_counter())
        with listening(left=configs["left"]) as cameras:
            time.sleep(0.4)
            alone = heard(cameras["left"]).samples
        with listening(**configs) as cameras:
            time.sleep(0.4)
            pairs = [[heard(camera) for camera in cameras.values()] for _ in range(10)]
    strips = next(pair for pair in pairs if pair[0].counter == pair[1].counter)  # a busy machine may be late for once
    np.testing.assert_array_equal(strips[0].samples, -strips[1].samples)
    assert min(np.abs(samples.astype(int)).mean() for samples in (alone, strips[0].samples)) > 10000


@needs_server
def test_a_tap_is_heard_soon_after_it_was_played_and_always_as_late(server):
    with Player(server.fifo("table"), 2) as player, listening(mic=options(device="table")) as cameras:
        taps = time.perf_counter() + 0.3 + np.arange(20) * 0.21
        for tap in taps:
            player.play(TAP, tap)
        late, last = [], 0
        while time.perf_counter() < taps[-1] + 0.1:
            time.sleep(TICK_S)
            now, strip = time.perf_counter(), heard(cameras["mic"])
            loud = strip.counter - len(strip.samples) + np.flatnonzero(np.abs(strip.samples.astype(int)) > 8000)
            if len(new := loud[loud > last + RATE // 10]):
                at = now - (strip.counter - new[0]) / RATE  # when it was heard, if the newest sample is of now
                late.append(float(at - taps[np.abs(taps - at).argmin()]))
                last = int(new[0])
    assert len(late) >= 15
    assert 0 <= np.median(late) < 0.05  # the server's own latency and a chunk
    assert np.percentile(np.abs(late - np.median(late)), 75) < 0.005  # a busy machine delays some


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


def test_microphones_of_one_card_share_its_rate(tmp_path):
    path = str(write_audio(tmp_path / "sound.wav", np.ones((RATE, 2), np.int16), RATE))
    cameras = {"left": options(file=path), "right": options(file=path, channel=1, sample_rate=16000)}
    with (
        pytest.raises(MicrophoneError, match="have sample_rate 48000 and 16000: give them the same"),
        listening(**cameras),
    ):
        pass


# The clock of a card; here time is made up, so that minutes take seconds


class Simulation:
    """A card whose samples tell when they were heard, and control steps at which its newest sample is looked at.

    Args:
        seconds: For how long.
        speed: Of the card's clock beside this machine's.
        came: When a chunk comes that was complete at a time [s]; None: never.
    """

    def __init__(
        self, seconds: float, speed: float = 1.0, came: Callable[[float], float | None] = lambda at: at
    ) -> None:
        rng = np.random.default_rng(0)
        self.recording = CardRecording("the card", RATE, 1)
        true_rate, chunks = RATE * speed, []
        for k in range(int((seconds + 1) * true_rate / CHUNK)):
            comes = came((k + 1) * CHUNK / true_rate)
            if comes is not None:
                heard = (k * CHUNK + np.arange(CHUNK)) / true_rate
                values = np.floor(heard % ROUND_S * STEPS_PER_S).astype(np.int16)
                chunks.append((comes + rng.uniform(0, 0.004), values[:, None]))
        first, n_written, last = 1.0, 0, 0.0
        self.counters: list[int] = []
        # How long before the step its newest sample was heard [s]; nan where it is silence.
        self.errors: list[float] = []
        for step in range(round((seconds - first) * FPS)):
            now = first + step * TICK_S
            while chunks[n_written][0] <= now:
                last = max(last, chunks[n_written][0])  # a thread takes one after the other
                self.recording.write(chunks[n_written][1], last)
                n_written += 1
            self.counters.append(self.recording.heard_at(now))
            newest = self.recording.samples(self.counters[-1] - 10, self.counters[-1])[:, 0].astype(float)
            away = (now - newest[-1] / STEPS_PER_S) % ROUND_S
            self.errors.append(float(away - ROUND_S if away > ROUND_S / 2 else away) if newest.any() else float("nan"))

    def errors_from(self, seconds: float) -> np.ndarray:
        """Of all steps from a time on [s]."""
        return np.array(self.errors[round((seconds - 1) * FPS) :])


@pytest.mark.parametrize("speed", [1.0, 1.005, 0.998])
def test_the_newest_sample_is_a_chunk_old_beside_a_clock_that_is_fast_or_slow(speed):
    simulation = Simulation(20, speed)
    errors = simulation.errors_from(2)
    assert errors.min() > 0
    assert errors.max() < 0.012
    assert np.ptp(errors) < 0.007  # and steps have the same length, whatever the chunks do


@pytest.mark.parametrize("period_s", [0.0213, 0.1])
def test_steps_have_the_length_that_they_have_in_time_where_a_sound_server_sends_bursts(period_s):
    simulation = Simulation(20, came=lambda at: float(np.ceil(at / period_s) * period_s))
    lengths = np.diff(simulation.counters)[3 * FPS :]
    assert np.abs(lengths / RATE * FPS - 1).max() < 0.1  # the made-up chunks come up to 4 ms late
    assert simulation.errors_from(4).max() < period_s + 0.012


@pytest.mark.parametrize("held_s", [0.06, 0.9])
def test_chunks_that_were_held_up_are_late_and_not_lost_and_shift_nothing(held_s, caplog):
    simulation = Simulation(9, came=lambda at: max(at, 5 + held_s) if at >= 5 else at)
    assert "lost" not in caplog.text
    assert np.abs(simulation.errors_from(5 + held_s + 2 * TICK_S)).max() < 0.012
    assert np.abs(simulation.errors_from(1)[: round(3.9 * FPS)]).max() < 0.012
    assert np.diff(simulation.counters).min() >= 0


@pytest.mark.parametrize("lost_s", [0.02, 2.0])
def test_samples_that_were_lost_are_told_and_are_silence_so_that_numbers_follow_the_time(lost_s, caplog):
    simulation = Simulation(11, came=lambda at: None if 5 <= at < 5 + lost_s else at)
    (told,) = (float(n) for n in re.findall(r"the card lost (\d+) ms", caplog.text))
    assert told == pytest.approx(1000 * lost_s, abs=6)
    assert np.abs(simulation.errors_from(5 + lost_s + 0.25 + 2 * TICK_S)).max() < 0.012


def test_a_card_that_lost_an_hour_costs_no_memory_and_the_last_seconds_are_kept():
    recording = CardRecording("the card", RATE, 1)
    for k in range(1000):
        chunk = np.full((CHUNK, 1), k % 100 + 1, np.int16)
        recording.write(chunk, (k + 1) * CHUNK / RATE + (3600 if k >= 500 else 0))
    assert recording.written == pytest.approx(3603 * RATE, abs=CHUNK)
    newest = recording.samples(recording.written - 2 * CHUNK, recording.written + 5)[:, 0]
    np.testing.assert_array_equal(newest, np.repeat([99, 100, 0], [CHUNK, CHUNK, 5]))


# What goes wrong


@needs_server
def test_a_server_that_dies_is_told_within_a_step_and_heard_again_when_it_is_back(server):
    with Player(server.fifo("table"), 2), listening(mic=options(device="table")) as cameras:
        camera = cameras["mic"]
        camera.read_latest()
        server.kill()
        killed = time.perf_counter()
        assert "sound server, has ended the recording" in str(until_error(camera, 5))
        assert time.perf_counter() - killed < 3 * TICK_S
        camera.disconnect()
        with pytest.raises(MicrophoneError, match="sound server running"):
            camera.connect()
        server.start()
        camera.connect()
        camera.read_latest()


@needs_server
def test_a_card_that_is_pulled_out_is_told(server):
    with Player(server.fifo("bench_left"), 2), listening(mic=options(device="bench_left")) as cameras:
        server.remove("bench_left")
        assert "bench_left" in str(until_error(cameras["mic"], 10))
    server.add("bench_left")


def test_a_card_that_gives_nothing_but_zeros_is_told_once(caplog):
    @register_source("muted")
    def muted(config: MicrophoneCameraConfig, channels: int) -> PlayedMicrophone:
        return PlayedMicrophone("a muted card", np.zeros((RATE, channels), np.int16), config.sample_rate)

    with listening(mic=options(source="muted")) as cameras:
        end = time.perf_counter() + 2.5
        while time.perf_counter() < end:
            cameras["mic"].read_latest()
            time.sleep(TICK_S)
    assert caplog.text.count("gives nothing but zeros") == 1


# Other people's microphones

_PLUGIN = """
import numpy as np
from lerobot_playbyear.microphones import register_source
from lerobot_playbyear.microphones.microphone import PlayedMicrophone

@register_source("tin_can")
def tin_can(config, channels):
    return PlayedMicrophone("the tin can " + config.device, np.full((100, channels), 7, np.int16), config.sample_rate)
"""


def test_an_installed_distribution_brings_its_own_source_and_a_broken_one_harms_no_other(tmp_path, monkeypatch, caplog):
    install("lerobot_microphone_broken", tmp_path, "import no_such_module")
    install("lerobot_microphone_tin", tmp_path, _PLUGIN)
    monkeypatch.syspath_prepend(str(tmp_path))
    with listening(mic=options(source="tin_can", device="string")) as cameras:
        assert set(np.unique(heard(cameras["mic"]).samples)) == {7}
    assert "lerobot_microphone_broken" in caplog.text
    with (
        pytest.raises(MicrophoneError, match=r"source='no' .* there is .*tin_can"),
        listening(mic=options(source="no")),
    ):
        pass


# The session's sound


def test_the_pictures_samples_are_those_of_the_sessions_file_bit_for_bit_with_gain(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    path = write_audio(
        tmp_path / "noise.wav", np.random.default_rng(0).normal(0, 3000, (RATE, 2)).astype(np.int16), RATE
    )
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


def test_a_disk_that_is_too_slow_ends_the_recording_before_silence_is_written(tmp_path):
    written = [0]
    path = tmp_path / "slow.wav"
    file = SessionFile(path, 1000, lambda: written[0], lambda start, stop: np.ones(stop - start, np.int16), 10_000)
    written[0] = 10_000  # as much as is kept
    while path.stat().st_size < 20_000:
        time.sleep(0.01)
    assert not file.error
    written[0] = 30_000
    file.close()
    assert "the disk was too slow" in file.error


def test_a_card_that_is_refused_is_not_kept(monkeypatch):
    source = partial(
        PlayedMicrophone, "a mute card", np.zeros((RATE, 1), np.int16), 16000
    )  # whatever rate is asked for
    monkeypatch.setitem(SOURCES, "stubborn", lambda config, channels: source())
    for _ in range(2):
        with (
            pytest.raises(MicrophoneError, match="have sample_rate 16000 and 48000"),
            listening(mic=options(source="stubborn")),
        ):
            pass
    assert not _open_cards


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


# playbyear-find-microphones


@needs_server
def test_each_card_is_listed_heard_and_written_and_one_that_cannot_be_opened_is_told(tmp_path, capsys):
    loud = np.full((20 * RATE, 2), [8000, 1], np.int16)  # for longer than a slow machine needs
    once = FindMicrophonesConfig(seconds=0.5, output_dir=tmp_path)
    with (
        started(bench=2, table=1) as server,
        Player(server.fifo("bench"), 2) as bench,
        Player(server.fifo("table"), 1, noise=0),
    ):
        find_microphones(FindMicrophonesConfig(list=True, output_dir=tmp_path))
        assert "bench" in capsys.readouterr().out
        assert not list(tmp_path.iterdir())
        bench.play(loud, time.perf_counter())
        find_microphones(once)
        said = capsys.readouterr().out
        assert "0: bench, ALSA (default)" in said
        assert "sample rates: 8000, 16000, 32000, 44100, 48000, 96000 Hz" in said
        assert "--robot.cameras='{mic: {type: microphone, device: \"table, ALSA\", sample_rate: 16000}}'" in said
        assert said.count("nothing but zeros") == 1
        samples, rate = read_audio(tmp_path / "microphone_0.wav")
        assert rate == 16000
        assert len(samples) == 0.5 * rate
        assert np.median(samples, axis=0).tolist() == pytest.approx([8000, 1], abs=3)

        for path in tmp_path.iterdir():
            path.unlink()
        server.remove("bench")
        find_microphones(once)
        assert "bench, ALSA cannot be opened" in capsys.readouterr().out
        assert [path.name for path in tmp_path.iterdir()] == ["microphone_1.wav"]
        server.remove("table")
        with pytest.raises(MicrophoneError, match="None of these"):
            find_microphones(once)


@needs_server
def test_where_there_is_no_card_it_says_what_to_do():
    with started():
        if sound_cards():
            pytest.skip("this machine has a sound card")
        with pytest.raises(MicrophoneError, match="Plug a microphone in"):
            find_microphones(FindMicrophonesConfig())


def plugged_in(*names: str) -> list[SoundCard]:
    return [SoundCard(number, name, 1, 48000, False) for number, name in enumerate(names)]


def test_the_name_that_is_suggested_holds_in_another_order_of_plugging():
    """ALSA numbers cards as they come, and one's name may be a part of another's."""
    before = plugged_in("USB Mic: Audio (hw:1,0), ALSA", "My USB Mic: Audio (hw:2,0), ALSA", "pulse, ALSA")
    after = plugged_in("My USB Mic: Audio (hw:0,0), ALSA", "pulse, ALSA", "USB Mic: Audio (hw:3,0), ALSA")
    suggested = [suggested_device(card, before) for card in before]
    assert suggested == [("USB Mic: Audio", True), ("My USB Mic: Audio", True), ("pulse, ALSA", True)]
    assert [cards_called(name, after) for name, _ in suggested] == [[after[2]], [after[0]], [after[1]]]


def test_the_printed_option_names_one_card_or_says_that_two_cannot_be_told_apart():
    cards = plugged_in("USB Mic, Core Audio", "USB Mic, Core Audio", 'The "good" one', "John's \\")
    *_, option, warning = described(cards[0], (48000,), cards)
    assert 'device: "0"' in option
    assert "may swap after a restart" in warning
    (*_, quoted) = described(cards[2], (44100,), cards)
    assert 'device: "The \\"good\\" one", sample_rate: 44100' in quoted
    (*_, option) = described(cards[3], (44100,), cards)
    (pasted,) = shlex.split(option)
    assert yaml.safe_load(pasted.partition("=")[2])["mic"]["device"] == "John's \\"
