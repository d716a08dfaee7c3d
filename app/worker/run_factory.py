"""A run from a source that was opened: its odometry, its cursor and a fresh mapper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from app.common.timers import Stopwatch
from app.robot.source import LiveSource
from app.sources.opening import with_odometry
from app.worker.cursor import Cursor, Synchroniser
from app.worker.live_cursor import LiveCursor
from app.worker.run import MakeMapper, Run
from app.worker.scan_cache import Keep
from pipeline.config import Parameters
from pipeline.errors import SourceError
from pipeline.io.readers.base import Source

MakeSynchroniser = Callable[[str], Synchroniser]


@dataclass(frozen=True, slots=True)
class Beginning:
    """Makes runs.

    Attributes:
        make_mapper: A fresh mapper for a source, from parameters, seed and a stopwatch.
        make_synchroniser: From the choice of odometry.
        keep: Where what the scans show is kept.
    """

    make_mapper: MakeMapper
    make_synchroniser: MakeSynchroniser
    keep: Keep

    def __call__(
        self, source: Source | LiveSource, odometry: str, seed: int, parameters: Parameters
    ) -> tuple[Run, tuple[str, ...]]:
        """A run at its beginning, and what is to be warned of.

        Raises:
            SourceError: There is no such odometry; the source is closed.
        """
        try:
            moving, chosen = with_odometry(source, odometry)
        except SourceError:
            source.close()
            raise
        stopwatch, synchronise = Stopwatch(), self.make_synchroniser(chosen.steps)
        is_live = isinstance(source, LiveSource)
        run = Run(
            moving,
            self.make_mapper(moving, parameters, seed, stopwatch),
            LiveCursor(source, chosen, moving)
            if isinstance(source, LiveSource)
            else Cursor(moving, synchronise),
            parameters,
            stopwatch,
            chosen.words,
            remake=lambda parameters: self.make_mapper(moving, parameters, seed, stopwatch),
            reread=None if is_live else lambda: synchronise(moving.records(None)),
            kept=self.keep(source, chosen.words, seed),
        )
        return run, (*source.description.warnings, *([chosen.warning] if chosen.warning else []))
