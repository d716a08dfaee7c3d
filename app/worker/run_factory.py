"""A run of a source that was opened: its odometry, its cursor, its scan caches and a fresh mapper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from app.common.timers import Stopwatch
from app.robot.source import LiveSource
from app.sources.opening import with_odometry
from app.worker.cursor import Cursor, LiveCursor, StepsFunction
from app.worker.run import MakeMapper, Run
from pipeline.config import Parameters
from pipeline.config.model import validated
from pipeline.errors import ParameterError, SourceError
from pipeline.io.readers.base import Source, SourceDescription
from pipeline.remapping import ScanCaches

MakeSynchroniser = Callable[[str], StepsFunction]
OpenCaches = Callable[[Source | LiveSource, str, int], ScanCaches]

_LARGE = Path("/var/tmp")  # noqa: S108 - the default may be in memory; the file has no name


def unnamed_caches(_source: Source | LiveSource, _odometry: str, _seed: int) -> ScanCaches:
    """Scan caches for as long as the run is open."""
    return ScanCaches(_LARGE if _LARGE.is_dir() else None)


def caches_in(folder: Path) -> OpenCaches:
    """Opens scan caches that the next opening of a recording finds again.

    A live source, and a source without a digest, get caches for as long as the run is open.

    Args:
        folder: Folder of all recordings; it is made when it is needed.
    """

    def open_caches(source: Source | LiveSource, odometry: str, seed: int) -> ScanCaches:
        digest = source.description.digest
        if not digest or isinstance(source, LiveSource):
            return unnamed_caches(source, odometry, seed)
        return ScanCaches(folder, f"{digest}\n{source.description.uri}\n{odometry}\n{seed}")

    return open_caches


@dataclass(frozen=True, slots=True)
class RunFactory:
    """Makes runs.

    Attributes:
        make_mapper: Returns a fresh mapper for a source, from parameters, seed and a stopwatch.
        make_synchroniser: Returns the synchroniser for a choice of odometry.
        open_caches: Opens the scan caches of a source, for its odometry and seed.
    """

    make_mapper: MakeMapper
    make_synchroniser: MakeSynchroniser
    open_caches: OpenCaches

    def __call__(
        self, source: Source | LiveSource, odometry: str, seed: int, parameters: Parameters
    ) -> tuple[Run, tuple[str, ...]]:
        """A run before its first scan, and warnings.

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
            caches=self.open_caches(source, chosen.words, seed),
        )
        return run, (*source.description.warnings, *([chosen.warning] if chosen.warning else []))


def recorded_parameters(description: SourceDescription) -> tuple[tuple[int, Parameters], ...]:
    """The sets of parameters that a recorded live run was mapped with, each with its first scan, in order.

    A set that the whole run was mapped again with replaces those before it. The result is empty where no
    parameters are recorded, or parameters of another version of stemmap.
    """
    sets: list[tuple[int, Parameters]] = []
    try:
        for each in description.revisions:
            values = validated(each.values)
            sets = [known for known in sets if known[0] < each.from_scan]
            sets.append((each.from_scan, values))
    except ParameterError:
        return ()
    return tuple(sets)
