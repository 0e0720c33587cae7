"""Blocks follow a card's clock whatever its callbacks do; here time is made up, so that minutes take seconds."""

from collections.abc import Callable

import numpy as np
import pytest

from lerobot_playbyear.microphones.card import CardRecording

RATE, FPS, CHUNK = 48000, 20, 240
SIZE, TICK_S = RATE // FPS, 1 / FPS
ROUND_S = 3.0  # after which the samples' values begin again
STEPS_PER_S = 10_000  # of these values


class Simulation:
    """A card whose samples tell when they were heard, and ticks that read it.

    Args:
        seconds: For how long.
        speed: Of the card's clock beside this machine's.
        came: When a chunk comes that was complete at a time [s]; None: never.
    """

    def __init__(
        self, seconds: float, speed: float = 1.0, came: Callable[[float], float | None] = lambda at: at
    ) -> None:
        rng = np.random.default_rng(0)
        self.recording = CardRecording(RATE, FPS, {"table": 0}, timeout_s=0)
        true_rate, chunks = RATE * speed, []
        for k in range(int((seconds + 1) * true_rate / CHUNK)):
            comes = came((k + 1) * CHUNK / true_rate)
            if comes is not None:
                heard = (k * CHUNK + np.arange(CHUNK)) / true_rate
                values = np.floor(heard % ROUND_S * STEPS_PER_S).astype(np.int16)
                chunks.append((comes + rng.uniform(0, 0.004), values[:, None]))
        first, n_written, last = 1.0, 0, 0.0
        self.errors: list[float] = []  # of the tick's first sample [s]; nan where it is silence
        for tick in range(round((seconds - first) * FPS)):
            until = first + tick * TICK_S
            while chunks[n_written][0] < until + 0.012:  # a read waits for what is still to come
                last = max(last, chunks[n_written][0])  # a thread takes one after the other
                self.recording.write(chunks[n_written][1], last)
                n_written += 1
            if tick == 0:
                self.recording.restart(until)
            block = self.recording.read(until)["table"].astype(np.float64)
            self.errors.append(self._error(block, until - TICK_S))

    @staticmethod
    def _error(block: np.ndarray, begins: float) -> float:
        """How much later than it should the block's first sample was heard [s]."""
        if not block[:10].any():
            return float("nan")
        away = (block[0] / STEPS_PER_S - begins) % ROUND_S
        return float(away - ROUND_S if away > ROUND_S / 2 else away)

    def errors_from(self, seconds: float) -> np.ndarray:
        """Of all ticks from a time on [s]."""
        return np.array(self.errors[round((seconds - 1) * FPS) :])

    @property
    def noted(self) -> dict[str, int]:
        """How many samples are not what was heard, by reason."""
        reasons = {drop.reason for drop in self.recording.drop_outs}
        return {reason: sum(d.n_samples for d in self.recording.drop_outs if d.reason == reason) for reason in reasons}


@pytest.mark.parametrize("speed", [1.0, 1.0001, 1.005, 0.9999, 0.998])
def test_blocks_stay_aligned_for_a_minute_beside_a_clock_that_is_fast_or_slow(speed):
    simulation = Simulation(60, speed)
    assert np.abs(simulation.errors_from(1)).max() < 0.003
    assert simulation.noted == {}


def test_a_steady_card_gives_its_samples_bit_for_bit():
    simulation = Simulation(5)
    assert np.ptp(simulation.errors_from(1.5)) < 2 / STEPS_PER_S


@pytest.mark.parametrize("held_s", [0.06, 0.3, 0.9])
def test_chunks_that_were_held_up_are_late_and_not_lost_and_shift_nothing(held_s):
    simulation = Simulation(9, came=lambda at: max(at, 5 + held_s) if at >= 5 else at)
    assert set(simulation.noted) == {"late"}
    assert simulation.noted["late"] <= (held_s + TICK_S) * RATE
    assert np.abs(simulation.errors_from(5 + held_s + 2 * TICK_S)).max() < 0.003
    assert np.abs(simulation.errors_from(1)[: round(3.9 * FPS)]).max() < 0.003


@pytest.mark.parametrize("lost_s", [0.02, 0.12, 2.0])
def test_samples_that_were_lost_are_noted_and_the_blocks_are_aligned_again(lost_s):
    simulation = Simulation(11, came=lambda at: None if 5 <= at < 5 + lost_s else at)
    assert simulation.noted["lost"] == pytest.approx(lost_s * RATE, abs=CHUNK)
    after = simulation.errors_from(5 + lost_s + 0.25 + 2 * TICK_S)
    assert np.abs(after).max() < 0.003


def test_a_card_that_begins_late_in_an_episode_is_heard_from_then_on():
    simulation = Simulation(6, came=lambda at: None if at < 3 else at)
    assert np.isnan(simulation.errors[: round(1.9 * FPS)]).all()
    assert np.abs(simulation.errors_from(3.1)).max() < 0.003
    assert set(simulation.noted) == {"late"}


def test_zeros_are_counted_for_each_microphone_and_not_for_channels_that_none_uses():
    recording = CardRecording(RATE, FPS, {"left": 0, "right": 2}, timeout_s=0)
    chunk = np.ones((CHUNK, 3), np.int16)
    chunk[:, 1:] = 0  # the middle channel is no microphone's
    for k in range(200):
        recording.write(chunk, (k + 1) * CHUNK / RATE)
    assert recording.zeros_s == {"left": 0.0, "right": 1.0}
    chunk[CHUNK // 2 - 1, 2] = -1
    recording.write(chunk, 201 * CHUNK / RATE)
    assert recording.zeros_s == {"left": 0.0, "right": CHUNK / 2 / RATE}


def test_channels_of_a_card_are_aligned_to_the_sample_whatever_is_lost():
    recording = CardRecording(RATE, FPS, {"left": 0, "right": 2}, timeout_s=0)
    rng, n_blocks = np.random.default_rng(0), 0
    for k in range(2000):
        if 600 <= k < 640 or rng.uniform() < 0.01:
            continue
        values = rng.integers(-30000, 30000, (CHUNK, 1)).astype(np.int16) * np.array([[1, 0, -1]], np.int16)
        recording.write(values, (k + 1) * CHUNK / RATE * 1.003 + rng.uniform(0, 0.01))
        if k % 10 == 9:
            block = recording.read((k + 1) * CHUNK / RATE)
            np.testing.assert_array_equal(block["left"], -block["right"])
            n_blocks += bool(block["left"].any())
    assert n_blocks > 150
