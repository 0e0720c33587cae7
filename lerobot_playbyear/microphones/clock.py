"""When samples were heard: a sound card's clock beside this machine's."""

from collections import deque

_STEADY_S = 1.0  # of sound, over which chunks are compared
_PATIENCE_S = 0.25  # for how long chunks may come late before samples are taken for lost


class CardClock:
    """Follows a card's clock by the times at which its chunks come.

    A chunk may come late and never early. So the earliest of the last second's, as if the card's rate were exact, tells when
    samples come; it follows a clock that is fast or slow, and a chunk that comes late changes nothing. A burst of chunks that
    were held up ends with one that is not late. Where all chunks of a quarter of a second come late by more than
    `tolerance_s`, samples were lost.

    Args:
        sample_rate: What the card says [Hz].
        tolerance_s: What is no loss [s].
    """

    def __init__(self, sample_rate: int, tolerance_s: float) -> None:
        self._rate, self._tolerance = sample_rate, tolerance_s
        # Last sample's number + 1, and when sample 0 came by it [s]: only those that no later one undercuts, so the first is
        # the earliest of the last second.
        self._offsets: deque[tuple[int, float]] = deque()
        self._late: list[tuple[int, float]] = []  # those since the last one in time
        self._late_since_s = 0.0

    def note(self, n_written: int, came_s: float) -> int:
        """A chunk came, of which the last sample has the number `n_written - 1`.

        Returns:
            How many samples were lost before; the caller counts them as written.
        """
        offset = came_s - n_written / self._rate
        if self._offsets and offset - self._start > self._tolerance:
            return self._note_late(n_written, offset, came_s)
        self._late = []
        self._keep(n_written, offset)
        while self._offsets[0][0] < n_written - _STEADY_S * self._rate:
            self._offsets.popleft()
        return 0

    def _note_late(self, n_written: int, offset: float, came_s: float) -> int:
        if not self._late:
            self._late_since_s = came_s
        self._late.append((n_written, offset))
        if came_s - self._late_since_s < _PATIENCE_S:
            return 0
        lost = round((min(late for _, late in self._late) - self._start) * self._rate)
        shift = lost / self._rate
        late, self._late = self._late, []
        self._offsets.clear()
        for n, offset_of_late in late:
            self._keep(n + lost, offset_of_late - shift)
        return lost

    def _keep(self, n_written: int, offset: float) -> None:
        while self._offsets and self._offsets[-1][1] >= offset:
            self._offsets.pop()
        self._offsets.append((n_written, offset))

    @property
    def is_set(self) -> bool:
        """Whether a chunk has come."""
        return bool(self._offsets)

    def written_at(self, time_s: float) -> float:
        """How many samples had come at a time, or will have [s of time.perf_counter]; a fraction between two."""
        return (time_s - self._start) * self._rate

    @property
    def _start(self) -> float:
        return self._offsets[0][1]
