"""Runs that are opened once, then mapped and scored with one parameter set after another. Grid comparisons,
sensitivity curves and searches use them.

The front end of the mapper depends on few parameters. Its results are cached on disk under a key of those
parameters, so that most sets need neither the recording nor the points again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Protocol

import numpy as np

from app.batch.run_folder import as_written
from app.sources.opening import with_odometry
from app.sources.request import SourceRequest
from app.training.learned_forests import kept_forests
from app.worker.mapper_factory import mapper_of
from pipeline.config import Parameters
from pipeline.errors import SourceError
from pipeline.evaluation import MapScores, evaluate
from pipeline.io.readers import open_source
from pipeline.io.readers.clouds import is_cloud, open_cloud
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.remapping import ScanCache, ScanCaches
from pipeline.types.records import Frame, Path, Step, Trees, TruthTrees

#: Points of the scans that are held in memory [bytes]; a longer run is read again when the front end runs.
_STEPS_LIMIT = 512 << 20
# The temporary folder of the system may be in memory. The file has no name.
_CACHE_FOLDER = FilePath("/var/tmp")  # noqa: S108

Tick = Callable[[], None]


@dataclass(frozen=True, slots=True, eq=False)
class MappedRun:
    """The map of a run, with values as they are written to its files.

    Attributes:
        trees: The confirmed trees.
        path: One row per scan; empty for a whole cloud.
        scans: Number of scans.
        front_end_ran: Whether the front end ran; False where its cached results were used.
    """

    trees: Trees
    path: Path
    scans: int
    front_end_ran: bool

    def evaluate(self, truth: TruthTrees, parameters: Parameters) -> MapScores:
        """Return the scores of the map, as `stemmap map` and `stemmap evaluate` compute them.

        Args:
            truth: True trees in the frame of the map.
            parameters: Parameters, of which those of the stage `evaluation` are used.
        """
        path = np.stack([self.path.x, self.path.y], axis=1) if self.scans else None
        return evaluate(self.trees, truth, parameters.evaluation, path)


class OpenRun(Protocol):
    """A run that can be mapped repeatedly.

    Attributes:
        digest: Digest of the source with its odometry; recording_digest: without.
        own_truth: True trees of the source; None if it has none.
    """

    digest: str
    recording_digest: str
    own_truth: TruthTrees | None

    def map(self, parameters: Parameters, tick: Tick = lambda: None) -> MappedRun:
        """Map the run with these parameters, as `stemmap map` does.

        Args:
            tick: Called after each scan; it may raise to stop.
        """

    def close(self) -> None:
        """Close the source and delete the caches."""


def open_run(source: SourceRequest) -> OpenRun:
    """Open a source.

    Raises:
        StemmapError: It cannot be read.
    """
    return OpenCloud(source) if is_cloud(source.uri) else OpenDrive(source)


class OpenDrive:
    """Scans of a robot or a simulated run.

    Args:
        source: What is mapped, and how.

    Attributes:
        preset: Name of the preset that suits the source.

    Raises:
        StemmapError: It cannot be read.
    """

    def __init__(self, source: SourceRequest) -> None:
        self._uri, self._seed = source.uri, source.seed
        opened = open_source(source.uri, source.options())
        try:
            truth = opened.truth()
            self.own_truth = None if truth is None else truth.trees
            self._source, self._odometry = with_odometry(opened, source.odometry)
        except BaseException:
            opened.close()
            raise
        self.recording_digest = opened.description.digest
        self.digest = self._source.description.digest
        self.preset = self._source.description.preset
        self._steps: list[Step] | None = None
        self._caches = ScanCaches(_CACHE_FOLDER if _CACHE_FOLDER.is_dir() else None)
        self._scans = -1  # unknown before the first mapping

    def map(self, parameters: Parameters, tick: Tick = lambda: None) -> MappedRun:
        """Map the run with these parameters, see `OpenRun.map`.

        Raises:
            SourceError: There is no scan.
        """
        cache, mapper = self._caches.of(parameters), self._mapper(parameters)
        if self._scans > 0 and cache.has_all(self._scans):
            with suppress(_DamagedCacheError):
                return self._mapped(mapper, self._from_cache(mapper, cache), tick, front_end_ran=False)
            mapper = self._mapper(parameters)
        mapped = self._mapped(mapper, self._from_scans(mapper, cache), tick, front_end_ran=True)
        self._scans = mapped.scans
        return mapped

    def close(self) -> None:
        """Close the source and delete the caches."""
        self._caches.close()
        self._source.close()

    def _mapper(self, parameters: Parameters) -> Mapper:
        return mapper_of(self._source.description, parameters, self._seed)

    def _mapped(
        self, mapper: Mapper, frames: Iterator[Frame], tick: Tick, *, front_end_ran: bool
    ) -> MappedRun:
        start_ns, frame = 0, None
        for frame in frames:
            if frame.index == 0:
                start_ns = frame.stamp_ns
            tick()
        if frame is None:
            raise SourceError("there is no scan in it", where=self._uri)
        trees, path = as_written(frame.trees, mapper.path, start_ns)
        return MappedRun(trees, path, frame.index + 1, front_end_ran)

    def _from_cache(self, mapper: Mapper, cache: ScanCache) -> Iterator[Frame]:
        for index in range(self._scans):
            cached = cache.read(index)
            if cached is None:  # the source still has the scan
                raise _DamagedCacheError
            yield mapper.process(*cached)

    def _from_scans(self, mapper: Mapper, cache: ScanCache) -> Iterator[Frame]:
        held: list[Step] | None = []
        size = 0
        for step in self._read_steps():
            scan = mapper.segment(step)
            cache.put(step, scan)
            size += step.scan.points.nbytes
            if held is not None:
                held.append(step)
            if size > _STEPS_LIMIT:
                held = None
            yield mapper.process(step, scan)
        self._steps = held

    def _read_steps(self) -> Iterator[Step]:
        if self._steps is not None:
            return iter(self._steps)
        return steps(self._source.records(), odometry=self._odometry.steps)


class OpenCloud:
    """A whole cloud of a plot. It has no path, so all true trees count.

    Args:
        source: The file.

    Raises:
        StemmapError: It cannot be read.
    """

    own_truth: TruthTrees | None = None

    def __init__(self, source: SourceRequest) -> None:
        self._uri = source.uri
        self.digest = self.recording_digest = open_cloud(source.uri).description.digest

    def map(self, parameters: Parameters, tick: Tick = lambda: None) -> MappedRun:
        """Map the cloud with these parameters, as `stemmap map` does."""
        from pipeline.inventory import map_plot

        cloud = open_cloud(self._uri)
        found = map_plot(cloud, parameters, kept_forests()).trees
        tick()
        placed = replace(found, position=found.position + cloud.description.offset[:2])
        trees, path = as_written(placed, _NO_PATH, 0)
        return MappedRun(trees, path, 0, True)

    def close(self) -> None:
        """Do nothing: no file is open."""


class _DamagedCacheError(Exception):
    """A cached scan cannot be read."""


_EMPTY = np.zeros(0)
_NO_PATH = Path(_EMPTY.astype(np.int64), _EMPTY, _EMPTY, _EMPTY, _EMPTY)
