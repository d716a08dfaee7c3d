"""Replay clock: when the next scan is due, by the time of the data and the time of the computer."""

from __future__ import annotations

from collections import deque

NS = 1_000_000_000
RATE_SCANS = 20  # scans over which the rate is measured
SLOWEST = 1e-3  # factor of real time; a smaller one would give times that no clock can wait for
LONGEST_DELAY_S = 3600.0


class ReplayClock:
    """Replays at a factor of real time. No scan is skipped; `behind` counts the scans that are late.

    Times of the computer are seconds from any start; times of the data are nanoseconds.
    """

    def __init__(self) -> None:
        self._speed = 1.0
        self._anchor: tuple[int, float] | None = None
        self._mapped: deque[tuple[int, float]] = deque(maxlen=RATE_SCANS)

    @property
    def speed(self) -> float:
        """Factor of real time, at least `SLOWEST`; 0 is as fast as possible."""
        return self._speed

    @speed.setter
    def speed(self, factor: float) -> None:
        self._speed = 0.0 if factor == 0.0 else max(factor, SLOWEST)

    def anchor(self, stamp_ns: int, now: float) -> None:
        """Count the scan of `stamp_ns` as shown at `now`; later scans follow from there."""
        self._anchor = (stamp_ns, now)
        self._mapped.clear()

    def release(self) -> None:
        """Let the next scan be the anchor: after a pause, a jump or a change of speed."""
        self._anchor = None
        self._mapped.clear()

    def delay(self, stamp_ns: int, now: float) -> float:
        """Seconds until the scan of `stamp_ns` is due, at most `LONGEST_DELAY_S`; 0 when it is late."""
        if self.speed == 0.0:
            return 0.0
        if self._anchor is None:
            self.anchor(stamp_ns, now)
        return min(max(0.0, self._due(stamp_ns) - now), LONGEST_DELAY_S)

    def mapped(self, stamp_ns: int, now: float) -> None:
        """Note that a scan was mapped now."""
        self._mapped.append((stamp_ns, now))

    def behind(self, now: float) -> int:
        """Number of scans that are due and not mapped yet."""
        if self.speed == 0.0 or self._anchor is None or len(self._mapped) < 2:
            return 0
        first, last = self._mapped[0][0], self._mapped[-1][0]
        period_ns = (last - first) / (len(self._mapped) - 1)
        late_ns = (now - self._due(last)) * self.speed * NS
        return max(0, int(late_ns / period_ns)) if period_ns > 0 else 0

    @property
    def rate_hz(self) -> float:
        """Scans mapped per second of the computer's time, over the last scans; 0 when the run stands."""
        if len(self._mapped) < 2:
            return 0.0
        spent = self._mapped[-1][1] - self._mapped[0][1]
        return (len(self._mapped) - 1) / spent if spent > 0 else 0.0

    def _due(self, stamp_ns: int) -> float:
        if self._anchor is None:
            raise RuntimeError("the replay clock has no anchor")
        anchor_ns, anchor_s = self._anchor
        return anchor_s + (stamp_ns - anchor_ns) / NS / self.speed
