"""The way to a scan that a person seeks."""

from __future__ import annotations

from app.worker.run import Run
from app.worker.session_status import clock

_NS = 1_000_000_000


class Way:
    """Where a run is to go: to a scan by its number, to the last one not later than a time, or nowhere."""

    def __init__(self) -> None:
        self._index: int | None = None
        self._stamp_ns: int | None = None
        self._under_way = False

    @property
    def sought(self) -> bool:
        """Whether it leads anywhere."""
        return self._index is not None or self._stamp_ns is not None

    @property
    def index(self) -> int | None:
        """Of the sought scan, where it is sought by its number."""
        return self._index

    def to_scan(self, index: int) -> None:
        """Seek a scan by its number."""
        self._index, self._stamp_ns, self._under_way = index, None, False

    def to_time(self, run: Run, stamp_ns: int) -> None:
        """Seek the last scan not later than a time."""
        index = run.index_at(stamp_ns)
        if index is not None:
            self.to_scan(index)
        else:
            self._index, self._stamp_ns, self._under_way = None, stamp_ns, False

    def forget(self) -> None:
        """Seek nothing."""
        self._index, self._stamp_ns, self._under_way = None, None, False

    def set_out(self, run: Run) -> None:
        """Begin the way, if it was not begun: not before work begins, so that targets that are overtaken by
        another while a person drags the timeline cost nothing and leave no trace."""
        if self._under_way or not self.sought:
            return
        self._under_way = True
        if self._index is None:
            run.approach(run.known)
        elif self._index != run.standing or not run.is_whole:
            run.approach(self._index)

    def is_at_end(self, run: Run) -> bool:
        """Whether the run stands at the sought scan."""
        if self._index is not None:
            return run.standing >= self._index
        if self._stamp_ns is None or run.standing < 0:
            return False
        following = run.peek_ns()
        return following is not None and following > self._stamp_ns

    def words(self, run: Run | None) -> str:
        """The sought scan in words; empty when none is."""
        if run is None or not self.sought:
            return ""
        time_s = self.time_s(run)
        return f"scan {self._index}" if time_s is None else clock(time_s)

    def time_s(self, run: Run | None) -> float | None:
        """Of the sought scan, since the run's first one; None when none is, or nobody knows."""
        if run is None:
            return None
        if self._stamp_ns is not None:
            return (self._stamp_ns - run.start_ns) / _NS
        if self._index is not None and self._index < run.known:
            return (run.stamp_ns(self._index) - run.start_ns) / _NS
        return None
