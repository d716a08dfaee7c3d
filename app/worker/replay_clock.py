"""When the next scan of a replay is due: the time of the data against the clock on the wall."""

from __future__ import annotations

from collections import deque

_NS = 1_000_000_000
_RATE_SCANS = 20


class Pacer:
    """Replays at a factor of real time. It never skips: whoever is late is told how late.

    Times of the clock are seconds from any start; times of the data are nanoseconds.
    """

    def __init__(self) -> None:
        self.speed = 1.0
        self._anchor: tuple[int, float] | None = None
        self._mapped: deque[tuple[int, float]] = deque(maxlen=_RATE_SCANS)

    def anchor(self, stamp_ns: int, now: float) -> None:
        """From here on the scan of `stamp_ns` counts as shown at `now`."""
        self._anchor = (stamp_ns, now)
        self._mapped.clear()

    def release(self) -> None:
        """The next scan anchors anew: after a pause, a jump or a change of speed."""
        self._anchor = None
        self._mapped.clear()

    def delay(self, stamp_ns: int, now: float) -> float:
        """Seconds until the scan of `stamp_ns` is due; 0 when it is late."""
        if self.speed == 0.0:
            return 0.0
        if self._anchor is None:
            self.anchor(stamp_ns, now)
        return max(0.0, self._due(stamp_ns) - now)

    def mapped(self, stamp_ns: int, now: float) -> None:
        """A scan has just been mapped."""
        self._mapped.append((stamp_ns, now))

    def behind(self, now: float) -> int:
        """How many scans are due by the clock and not mapped yet."""
        if self.speed == 0.0 or self._anchor is None or len(self._mapped) < 2:
            return 0
        first, last = self._mapped[0][0], self._mapped[-1][0]
        period_ns = (last - first) / (len(self._mapped) - 1)
        late_ns = (now - self._due(last)) * self.speed * _NS
        return max(0, int(late_ns / period_ns)) if period_ns > 0 else 0

    @property
    def rate_hz(self) -> float:
        """Scans mapped in a second of the clock, over the last scans; 0 when standing."""
        if len(self._mapped) < 2:
            return 0.0
        spent = self._mapped[-1][1] - self._mapped[0][1]
        return (len(self._mapped) - 1) / spent if spent > 0 else 0.0

    def _due(self, stamp_ns: int) -> float:
        if self._anchor is None:
            raise RuntimeError("a pacer without an anchor knows no due time")
        anchor_ns, anchor_s = self._anchor
        return anchor_s + (stamp_ns - anchor_ns) / _NS / self.speed
