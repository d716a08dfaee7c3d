"""A run of one step: its only scan is the map of the source as a whole.

The map is computed in parts, so that commands are executed between them. Parameters that change the map begin
another one; until it is complete, the map before it is shown.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import replace

import numpy as np

from app.batch.run_folder import NO_PATH
from app.common.timers import Stopwatch
from app.explain.records import ClusterStory, TreeStory
from app.sources.one_step import OneStepMap, OneStepSource, finish
from app.worker.protocol import RunCounts, RunCourse
from app.worker.tree_numbers import TreeNumbers
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.types.records import Float, Float32, Frame, Path, Trees


class OneStepRun:
    """A source that is mapped in one step. It has the interface of `app.worker.run.Run`, as far as a run of
    one scan needs it.

    Args:
        source: The source; `close` closes it.
        parameters: All parameters.

    Attributes:
        frame, confirmed_s: The map as a frame, and 0 for each of its trees [s]; None before it is complete.
        current: 0 if there is a map, else -1.
    """

    odometry = ""
    is_bare = False
    is_whole = True
    start_ns = 0
    path: Path = NO_PATH
    reflectance = None
    has_intensity = False
    odometry_xy: Float = np.zeros((0, 2))
    cache_notice = ""

    def __init__(self, source: OneStepSource, parameters: Parameters) -> None:
        self.source, self.warnings = source, source.description.warnings
        self.stopwatch = Stopwatch()
        self.frame: Frame | None = None
        self.confirmed_s: Float | None = None
        self.current = -1
        self._map: OneStepMap | None = None
        self._parameters = self._mapped_with = parameters
        self._numbers = TreeNumbers()
        self._job: Generator[float, None, OneStepMap] | None = None
        self._share = 0.0

    @property
    def share(self) -> float | None:
        """Share of the map under way that is done, from 0 to 1; None if none is computed."""
        return None if self._job is None else self._share

    def counts(self, index: int) -> RunCounts:
        """Return the counts of the present map; empty before it is complete."""
        del index
        return RunCounts() if self._map is None else self._map.counts()

    def kept(self, index: int) -> None:
        """Return None: the only scan is the current one."""
        del index

    @property
    def accumulated(self) -> Float32:
        """Points at the stems: x, y and height above the ground, shape (N, 3) [m]; none before the map is
        complete."""
        return np.zeros((0, 3), np.float32) if self._map is None else self._map.accumulated

    def course(self, names: Sequence[str], most: int, *, stages: bool) -> RunCourse:
        """Return a course without scans. The arguments are ignored."""
        del names, most, stages
        return RunCourse(np.zeros(0, np.int64), np.zeros(0), {}, {}, [])

    def take_views(self) -> list[tuple[int, Float]]:
        """Return nothing: the covered area does not come from views."""
        return []

    @property
    def known(self) -> int:
        """Number of scans that were read."""
        return self.current + 1

    def peek_ns(self) -> int | None:
        """Return 0 before the map is complete, else None."""
        return 0 if self.current < 0 else None

    def index_at(self, stamp_ns: int) -> int | None:
        """Return 0, the index of the only scan."""
        del stamp_ns
        return 0

    def stamp_ns(self, index: int) -> int:
        """Return the time of the only scan [ns]."""
        del index
        return 0

    def approach(self, index: int) -> None:
        """Do nothing: there is one scan."""

    def map_next(self, *, hurried: bool = False) -> Frame | None:
        """Compute the next part of the first map. Return its frame if this part completed it; None if it is
        not complete yet, or was complete before the call.

        Args:
            hurried: Ignored; it is there because `Run.map_next` has it.

        Raises:
            StemmapError: The source cannot be mapped; the next call begins again.
        """
        del hurried
        if self.current >= 0:
            return None
        if self._job is None:
            self._begin()
        return self.frame if self._advance() else None

    def use(self, parameters: Parameters, index: int) -> bool:
        """Use other parameters. If there is no map yet, or they change it, another map begins in place of one
        that is not complete. Returns False, since no scan is to be mapped again; `index` is ignored."""
        del index
        self._parameters = parameters
        before, now = self._mapped_with.flat(), parameters.flat()
        if self.current < 0 or any(before[name] != now[name] for name in self.source.about.parameters):
            self._begin()
        return False

    def remap(self, parameters: Parameters, on_preview: Callable[[Trees], None]) -> None:
        """Do nothing: `use` maps the whole source."""

    def cancel_remapping(self) -> None:
        """Leave a map that is not complete; the present map does not change."""
        self._job = None

    @property
    def remapped(self) -> float | None:
        """Share of the map that replaces the present one, from 0 to 1; None if there is none."""
        return self.share if self.current >= 0 else None

    def remap_next(self) -> tuple[Frame, dict[int, float]] | None:
        """Compute the next part of the map that replaces the present one.

        Returns:
            The frame of the new map and a dict from each tree number to the confirmation time 0 [s]; None
            while the new map is not complete, and if none is computed.

        Raises:
            StemmapError: The source cannot be mapped with these parameters. The map does not change.
        """
        if self._job is None or not self._advance() or self.frame is None:
            return None
        return self.frame, dict.fromkeys(self.frame.trees.number.tolist(), 0.0)

    def map_again(self) -> Frame | None:
        """Return the present frame; None before the map is complete."""
        return self.frame

    def map_with(self, sets: Sequence[Parameters]) -> list[Frame]:
        """Return the frame of the map with each set of parameters, with tree numbers of its own; the run does
        not change.

        Raises:
            StemmapError: The source cannot be mapped with a set.
        """
        return [finish(self.source.steps(each)).frame for each in sets]

    def parameters_at(self, index: int) -> Parameters:
        """Return the parameters of the present map, which are the same for all scans; `index` is ignored."""
        del index
        return self._mapped_with

    def tree_story(self, number: int) -> TreeStory:
        """Return the explanation of a tree.

        Raises:
            StemmapError: There is no such tree, or no map yet.
        """
        if self._map is None or self.frame is None:
            raise _nothing_mapped()
        rows = np.flatnonzero(self.frame.trees.number == number)
        if not len(rows):
            raise StemmapError(f"there is no tree {number} in the map", remedy="Select another")
        return self._map.tree_story(self.frame, int(rows[0]), self._mapped_with)

    def cluster_story(self, row: int) -> ClusterStory:
        """Return the explanation of a cluster.

        Raises:
            StemmapError: There is no such cluster, or no map yet.
        """
        if self._map is None or self.frame is None:
            raise _nothing_mapped()
        if not 0 <= row < len(self.frame.clusters.size):
            raise StemmapError(f"there is no cluster {row} in the map", remedy="Select another")
        return self._map.cluster_story(self.frame, row, self._mapped_with)

    def close(self) -> None:
        """Close the source."""
        self._job = None
        self.source.close()

    def _begin(self) -> None:
        """Begin a map with the present parameters."""
        self._job, self._share = self.source.steps(self._parameters), 0.0

    def _advance(self) -> bool:
        """Compute the next part of the map.

        Returns:
            Whether this part completed the map, which is then the present one. False if none is computed.

        Raises:
            StemmapError: The source cannot be mapped. As after any other exception, this map is abandoned and
                the present one does not change.
        """
        job = self._job
        if job is None:
            return False
        try:
            with self.stopwatch.aside():
                self._share = next(job)
        except StopIteration as end:
            self._job = None
            self._take(end.value)
            return True
        except BaseException:
            self._job = None
            raise
        return False

    def _take(self, found: OneStepMap) -> None:
        """Make a map the present one; trees that stayed keep their numbers."""
        if self.current >= 0:
            self._numbers.begin_map(found.frame.trees, {})
        self.frame = replace(found.frame, trees=self._numbers.renumber(found.frame.trees))
        self.confirmed_s = np.zeros(len(found.frame.trees.number))
        self._map, self.current, self._mapped_with = found, 0, self._parameters


def _nothing_mapped() -> StemmapError:
    return StemmapError("nothing is mapped yet", remedy="Wait until the stems are shown")
