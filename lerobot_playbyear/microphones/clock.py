"""When samples were heard: a sound card's clock beside this machine's."""

from collections import deque

_STEADY_S, _RECENT_S = 1.0, 0.25  # of sound, over which chunks are compared


class CardClock:
    """Follows a card's clock by the times at which its chunks come.

    A chunk may come late and never early. So the earliest of the last second's, as if the card's rate were exact, tells when
    samples come; it follows a clock that is fast or slow, and a chunk that comes late changes nothing. Where all chunks of a
    quarter of a second come late by more than `tolerance_s`, samples were lost.

    Args:
        sample_rate: What the card says [Hz].
        tolerance_s: What is no loss [s].
    """

    def __init__(self, sample_rate: int, tolerance_s: float) -> None:
        self._rate, self._tolerance = sample_rate, tolerance_s
        self._offsets: deque[tuple[int, float]] = deque()  # last sample's number + 1, and when sample 0 came by it [s]

    def note(self, n_written: int, came_s: float) -> int:
        """A chunk came, of which the last sample has the number `n_written - 1`.

        Returns:
            How many samples were lost before; the caller counts them as written.
        """
        self._offsets.append((n_written, came_s - n_written / self._rate))
        while self._offsets[0][0] < n_written - _STEADY_S * self._rate:
            self._offsets.popleft()
        begins = n_written - _RECENT_S * self._rate
        recent = [offset for n, offset in self._offsets if n > begins]
        before = [offset for n, offset in self._offsets if n <= begins]
        if not before or min(recent) - min(before) <= self._tolerance:
            return 0
        lost = round((min(recent) - min(before)) * self._rate)
        shift = lost / self._rate
        self._offsets = deque((n + lost, offset - shift) for n, offset in self._offsets if n > begins)
        return lost

    def restart(self) -> None:
        """Forgets what was: the card begins anew."""
        self._offsets.clear()

    @property
    def is_set(self) -> bool:
        """Whether a chunk has come."""
        return bool(self._offsets)

    def written_at(self, time_s: float) -> float:
        """How many samples had come at a time, or will have [s of time.perf_counter]; a fraction between two."""
        start = min(offset for _, offset in self._offsets)
        return (time_s - start) * self._rate
