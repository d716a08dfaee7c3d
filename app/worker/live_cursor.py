"""Reads the steps of a robot that is heard live: each once, and never waiting for one."""

from __future__ import annotations

from array import array
from collections import Counter, deque

from app.robot.source import LiveSource
from app.sources.opening import Chosen
from pipeline.errors import SourceError
from pipeline.io.readers.base import Source
from pipeline.odometry.odometry_override import WithMotion
from pipeline.odometry.synchroniser import Joiner
from pipeline.types.records import Step


class LiveCursor:
    """Stands before the next step, as `app.worker.cursor.Cursor` does; where that finds none, none came yet.

    Args:
        source: The robot. The cursor does not close it.
        chosen: What tells the motion.
        moving: The robot with that motion.
    """

    def __init__(self, source: LiveSource, chosen: Chosen, moving: Source) -> None:
        self._source = source
        self.losses = Counter[str]()
        self._moving = moving if isinstance(moving, WithMotion) else None
        self._joiner = Joiner(use_odometry=chosen.steps != "static", index=0, losses=self.losses)
        self._ready: deque[Step] = deque()
        self._stamps = array("q")

    @property
    def known(self) -> int:
        """How many steps were read so far."""
        return len(self._stamps)

    def stamp_ns(self, index: int) -> int:
        """Time of a step that was read before."""
        return self._stamps[index]

    def index_at(self, stamp_ns: int) -> None:
        """Nobody can go to a time of a live run."""
        del stamp_ns

    def peek(self) -> Step | None:
        """The next step without taking it; None when it has not come.

        Raises:
            SourceError: What comes cannot be read.
        """
        while not self._ready:
            records = self._source.take()
            if not records:
                return None
            for record in records:
                for told in (record,) if self._moving is None else self._moving.pass_on(record):
                    self._joiner.add(told)
                self._ready.extend(self._joiner.ready())
        return self._ready[0]

    def take(self) -> Step | None:
        """The next step; None when it has not come.

        Raises:
            SourceError: What comes cannot be read.
        """
        step = self.peek()
        if step is None:
            return None
        self._ready.popleft()
        self._stamps.append(step.scan.stamp_ns)
        return step

    def go_to(self, index: int) -> None:
        """Stand before the next step, which is where it stands.

        Raises:
            SourceError: Another is asked for.
        """
        if index != self.known:
            raise SourceError(
                "a live run cannot be read again",
                where=self._source.uri,
                remedy="Open its recording",
            )
