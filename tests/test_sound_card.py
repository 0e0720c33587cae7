"""Several microphones on one sound card: one clock, one beginning, the same samples in every frame."""

import threading
import time

import numpy as np
import pytest

from lerobot_playbyear.datasets import MicrophoneBuffer, SoundCardBuffer
from lerobot_playbyear.datasets.microphone import DropOut

RATE, FPS = 48000, 30
SIZE = RATE // FPS
CHUNK = 512  # as a card's buffer has it
CHANNELS = {"observation.audio.left": 0, "observation.audio.right": 2}


def stereo(start: int, n: int) -> np.ndarray:
    """(n, 3) where the outer channels tell which sample it is, and negate each other."""
    left = (np.arange(start, start + n) % 32749 + 1).astype(np.int16)
    return np.stack([left, np.full(n, 99, np.int16), -left], axis=1)


class Card(threading.Thread):
    """A sound card in real time: chunks that come early or late, some lost, and nothing for a while at first."""

    def __init__(self, write, *, seconds: float, late_start: float = 0.0, lost: tuple[int, ...] = ()):
        super().__init__(daemon=True)
        self._write, self._seconds, self._late_start, self._lost = write, seconds, late_start, lost

    def run(self) -> None:
        rng = np.random.default_rng(0)
        time.sleep(self._late_start)
        begun = time.monotonic()
        for i in range(round(self._seconds * RATE / CHUNK)):
            due = begun + (i + 1) * CHUNK / RATE + rng.uniform(0, 0.008)  # jitter of 8 ms
            time.sleep(max(0.0, due - time.monotonic()))
            if i not in self._lost:
                self._write(stereo(i * CHUNK, CHUNK), 1000 + i * CHUNK / RATE)


def record(buffer: SoundCardBuffer, n_frames: int) -> dict[str, np.ndarray]:
    """The blocks of frames at their pace, (n_frames, S) for each microphone."""
    begun, blocks = time.monotonic(), []
    for frame in range(n_frames):
        time.sleep(max(0.0, begun + frame / FPS - time.monotonic()))
        blocks.append(buffer.read_frame())
    return {key: np.stack([block[key] for block in blocks]) for key in CHANNELS}


def assert_alike(blocks: dict[str, np.ndarray]) -> None:
    left, right = blocks.values()
    np.testing.assert_array_equal(left, -right)


@pytest.mark.parametrize(
    ("late_start", "lost"),
    [(0.0, ()), (0.0, (40, 41, 42, 43, 44)), (0.3, ())],
    ids=["jitter", "drop-outs", "late start"],
)
def test_microphones_of_one_card_stay_alike_to_the_sample(late_start, lost):
    buffer = SoundCardBuffer(RATE, FPS, CHANNELS, timeout=0.05)
    card = Card(buffer.write, seconds=1.6, late_start=late_start, lost=lost)
    card.start()
    time.sleep(0.0 if late_start else 0.2)
    blocks = record(buffer, 36)
    card.join()
    assert_alike(blocks)
    heard = blocks["observation.audio.left"].reshape(-1)
    assert (heard != 0).mean() > 0.6
    steps = np.diff(heard.astype(int))
    inside = (
        (heard[1:] != 0) & (heard[:-1] != 0) & (steps > -30000)
    )  # not where silence is, nor where the counter starts again
    n_cuts = sum(drop_out.reason == "skipped" for drop_out in buffer.drop_outs)
    assert (steps[inside] != 1).sum() <= n_cuts, "samples of one microphone are missing or double"
    assert any(drop_out.reason == "lost" for drop_out in buffer.drop_outs) == bool(lost)


def test_an_episode_begins_at_the_same_sample_for_all_whenever_it_begins():
    """Frames are taken while chunks arrive: two buffers of one card begin a chunk apart sooner or later."""
    buffer = SoundCardBuffer(RATE, FPS, CHANNELS, timeout=0.01)
    written = threading.Event()

    def write() -> None:
        for i in range(3000):
            buffer.write(stereo(i * CHUNK, CHUNK))
        written.set()

    threading.Thread(target=write, daemon=True).start()
    while not written.is_set():
        buffer.reset()
        for _ in range(2):
            left, right = buffer.read_frame().values()
            np.testing.assert_array_equal(left, -right)


def test_a_card_that_begins_late_is_not_heard_twice():
    """Fewer samples have come than the reserve: the first block is silent, and they are all in the next."""
    buffer = SoundCardBuffer(16000, 20, {"left": 0, "right": 2}, reserve=0.02, timeout=0.01)
    buffer.write(stereo(0, 200))
    assert not any(block.any() for block in buffer.read_frame().values())
    buffer.write(stereo(200, 1000))
    block = buffer.read_frame()["left"]
    np.testing.assert_array_equal(block[block != 0], stereo(0, 680)[:, 0])


def test_a_card_that_slept_for_an_hour_costs_no_memory():
    buffer = SoundCardBuffer(RATE, FPS, CHANNELS, timeout=0.01)
    buffer.write(stereo(0, RATE), 0.0)
    buffer.read_frame()
    buffer.write(stereo(0, CHUNK), 3600.0)
    assert len(buffer._kept) <= RATE
    assert buffer.drop_outs == [DropOut(1, 3599 * RATE, "lost")]


def test_a_microphone_by_itself_is_a_card_with_one_channel():
    one, card = MicrophoneBuffer(RATE, FPS, reserve=0.0), SoundCardBuffer(RATE, FPS, {"m": 0}, reserve=0.0)
    for i in range(8):
        one.write(stereo(i * CHUNK, CHUNK)[:, 0])
        card.write(stereo(i * CHUNK, CHUNK)[:, :1])
    np.testing.assert_array_equal(one.read_frame(), card.read_frame()["m"])


@pytest.mark.parametrize(
    ("channels", "message"),
    [({}, "channels={}"), ({"left": 0, "right": 0}, "a channel of its own"), ({"left": -1}, "counted from 0")],
)
def test_channels_that_make_no_sense_are_refused(channels, message):
    with pytest.raises(ValueError, match=message):
        SoundCardBuffer(RATE, FPS, channels)


def test_a_chunk_with_too_few_channels_is_refused():
    buffer = SoundCardBuffer(RATE, FPS, CHANNELS)
    with pytest.raises(ValueError, match=r"shape \(512, 2\).*'observation.audio.right': 2"):
        buffer.write(stereo(0, CHUNK)[:, :2])
    with pytest.raises(ValueError, match=r"shape \(512,\)"):
        buffer.write(stereo(0, CHUNK)[:, 0])
