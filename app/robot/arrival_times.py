"""Times of arrival that only ever grow, though the machine's own clock may be set meanwhile."""

from __future__ import annotations

import time


class ArrivalTimes:
    """The wall clock at the beginning, and evenly on from there."""

    def __init__(self) -> None:
        self._wall_ns, self._start_ns = time.time_ns(), time.monotonic_ns()
        self._last_ns = 0

    def now_ns(self) -> int:
        """The time [ns since 1970]; never before an earlier one."""
        return self._wall_ns + time.monotonic_ns() - self._start_ns

    def next_ns(self) -> int:
        """The time, later than any that this gave before."""
        self._last_ns = max(self.now_ns(), self._last_ns + 1)
        return self._last_ns
