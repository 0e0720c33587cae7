"""A card's samples follow its clock whatever its callbacks do; here time is made up, so that minutes take seconds."""

import re
from collections.abc import Callable

import numpy as np
import pytest

from lerobot_playbyear.microphones.card import CardRecording

RATE, FPS, CHUNK = 48000, 20, 144
TICK_S = 1 / FPS
ROUND_S = 3.0  # after which the samples' values begin again
STEPS_PER_S = 10_000  # of these values


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
        self.errors: list[
            float
        ] = []  # how long before the step its newest sample was heard [s]; nan where it is silence
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


@pytest.mark.parametrize("speed", [1.0, 1.0001, 1.005, 0.9999, 0.998])
def test_the_newest_sample_is_a_chunk_old_for_a_minute_beside_a_clock_that_is_fast_or_slow(speed):
    simulation = Simulation(60, speed)
    errors = simulation.errors_from(2)
    assert errors.min() > 0
    assert errors.max() < 0.012
    assert np.ptp(errors) < 0.007  # and steps have the same length, whatever the chunks do


@pytest.mark.parametrize("period_s", [0.01, 0.0213, 0.0427, 0.1])
def test_steps_have_the_length_that_they_have_in_time_where_a_sound_server_sends_bursts(period_s):
    simulation = Simulation(20, came=lambda at: float(np.ceil(at / period_s) * period_s))
    lengths = np.diff(simulation.counters)[3 * FPS :]
    assert np.abs(lengths / RATE * FPS - 1).max() < 0.1  # the made-up chunks come up to 4 ms late
    assert simulation.errors_from(4).max() < period_s + 0.012


@pytest.mark.parametrize("held_s", [0.06, 0.3, 0.9])
def test_chunks_that_were_held_up_are_late_and_not_lost_and_shift_nothing(held_s, caplog):
    simulation = Simulation(9, came=lambda at: max(at, 5 + held_s) if at >= 5 else at)
    assert "lost" not in caplog.text
    assert np.abs(simulation.errors_from(5 + held_s + 2 * TICK_S)).max() < 0.012
    assert np.abs(simulation.errors_from(1)[: round(3.9 * FPS)]).max() < 0.012
    assert np.diff(simulation.counters).min() >= 0


@pytest.mark.parametrize("lost_s", [0.02, 0.12, 2.0])
def test_samples_that_were_lost_are_told_and_are_silence_so_that_numbers_follow_the_time(lost_s, caplog):
    simulation = Simulation(11, came=lambda at: None if 5 <= at < 5 + lost_s else at)
    (told,) = (float(n) for n in re.findall(r"the card lost (\d+) ms", caplog.text))
    assert told == pytest.approx(1000 * lost_s, abs=6)
    assert np.abs(simulation.errors_from(5 + lost_s + 0.25 + 2 * TICK_S)).max() < 0.012


def test_zeros_are_counted_for_each_channel():
    recording = CardRecording("the card", RATE, 3)
    chunk = np.ones((CHUNK, 3), np.int16)
    chunk[:, 1:] = 0
    for k in range(200):
        recording.write(chunk, (k + 1) * CHUNK / RATE)
    assert [recording.zeros_s(channel) for channel in range(3)] == [0, 0.6, 0.6]
    chunk[CHUNK // 2 - 1, 2] = -1
    recording.write(chunk, 201 * CHUNK / RATE)
    assert recording.zeros_s(2) == CHUNK / 2 / RATE


def test_a_card_that_lost_an_hour_costs_no_memory_and_the_last_seconds_are_kept():
    recording = CardRecording("the card", RATE, 1)
    for k in range(1000):
        chunk = np.full((CHUNK, 1), k % 100 + 1, np.int16)
        recording.write(chunk, (k + 1) * CHUNK / RATE + (3600 if k >= 500 else 0))
    assert recording.written == pytest.approx(3603 * RATE, abs=CHUNK)
    newest = recording.samples(recording.written - 2 * CHUNK, recording.written + 5)[:, 0]
    np.testing.assert_array_equal(newest, np.repeat([99, 100, 0], [CHUNK, CHUNK, 5]))
