"""The scan that a user seeks."""

from __future__ import annotations

from app.worker.run import Run

_NS = 1_000_000_000


class SeekTarget:
    """The scan to which a run goes: given by its number, by a time that it is not later than, or none."""

    def __init__(self) -> None:
        self._index: int | None = None
        self._stamp_ns: int | None = None
        self._under_way = False

    @property
    def sought(self) -> bool:
        """Whether a scan is sought."""
        return self._index is not None or self._stamp_ns is not None

    @property
    def index(self) -> int | None:
        """Number of the sought scan; None where a time is sought."""
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
        """Return to a state before the target, once. This happens when work begins, so that targets that
        another one replaces while the timeline is dragged cost nothing."""
        if self._under_way or not self.sought:
            return
        self._under_way = True
        if self._index is None:
            run.approach(run.known)
        elif self._index != run.standing or not run.is_whole:
            run.approach(self._index)

    def is_at_end(self, run: Run) -> bool:
        """Whether the run has reached the sought scan."""
        if self._index is not None:
            return run.standing >= self._index
        if self._stamp_ns is None or run.standing < 0:
            return False
        following = run.peek_ns()
        return following is not None and following > self._stamp_ns

    def words(self, run: Run | None) -> str:
        """The sought scan in words; empty without one."""
        if run is None or not self.sought:
            return ""
        time_s = self.time_s(run)
        return f"scan {self._index}" if time_s is None else clock(time_s)

    def time_s(self, run: Run | None) -> float | None:
        """Time of the sought scan [s since the first scan]; None without one, or where it is not known."""
        if run is None:
            return None
        if self._stamp_ns is not None:
            return (self._stamp_ns - run.start_ns) / _NS
        if self._index is not None and self._index < run.known:
            return (run.stamp_ns(self._index) - run.start_ns) / _NS
        return None


def clock(seconds: float) -> str:
    """A time in minutes and seconds."""
    whole = int(seconds)
    return f"{whole // 60}:{whole % 60:02d}"
