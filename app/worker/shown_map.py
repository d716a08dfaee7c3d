"""The map that a session shows: that of the current scan of a run, or of a stored scan, with the repairs."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable

import numpy as np

from app.worker.one_step_run import OneStepRun
from app.worker.protocol import RunCounts, Shown, UInt8
from app.worker.run import Run
from pipeline.config import Parameters
from pipeline.repairs.record import Repair
from pipeline.repairs.repaired import MapOfRun, RepairedMap, Repairer, loops_of
from pipeline.slam.keyframe_graph import KeyframeGraph
from pipeline.types.records import Float, Float32, Frame, Int, Path
from pipeline.types.units import SECOND_NS

AnyRun = Run | OneStepRun


class ShownMap:
    """The map of a run at the scan that is shown, after the repairs.

    Args:
        is_on_way: Returns whether the run plays or a scan is sought; loops are then repaired by an earlier
            solution.

    Attributes:
        run: The open run, or None.
        repairs: The repairs of the map.
    """

    def __init__(self, is_on_way: Callable[[], bool]) -> None:
        self.run: AnyRun | None = None
        self.repairs: tuple[Repair, ...] = ()
        self._is_on_way = is_on_way
        self._kept: Shown | None = None  # the sought scan, as long as the mapper is on its way to it
        self._repairer = Repairer()
        #: Frame before the repairs, whether its loops were repaired by an earlier solution, and the map.
        self._repaired: tuple[Frame, bool, RepairedMap] | None = None
        self._faults: dict[str, None] = {}  # of the repairs, that were printed

    @property
    def _unrepaired(self) -> Shown | AnyRun | None:
        """The map of the sought scan if it was mapped, else of the current scan, before the repairs."""
        return self._kept or self.run

    @property
    def frame(self) -> Frame | None:
        """Frame of the current scan, or of the sought scan if it was mapped, with the repairs; None if there
        is no run, or before its first scan."""
        shown = self.repaired or self._unrepaired
        return shown.frame if shown else None

    @property
    def repaired(self) -> RepairedMap | None:
        """The map with the repairs; None without repairs, and without a map. While the run plays or a scan is
        sought, loops are repaired by an earlier solution. If the repairs fail, the map is without them, and
        the error is the problem of each."""
        shown, run = self._unrepaired, self.run
        if not self.repairs or shown is None or shown.frame is None or run is None:
            return None
        hurried = self.is_hurried
        if self._repaired is not None and self._repaired[0] is shown.frame and self._repaired[1] <= hurried:
            return self._repaired[2]
        graph, landmarks = KeyframeGraph(), np.full(len(shown.frame.trees.number), -1)
        if isinstance(run, Run) and self._kept is None:
            graph, landmarks = run.graph, run.tree_landmarks
        of_run = MapOfRun(shown.frame, shown.path, graph, landmarks)
        try:
            found = self._repairer.repaired(of_run, self.repairs, hurried=hurried)
        except (ValueError, ArithmeticError, IndexError) as error:  # LinAlgError is a ValueError
            fault = f"this is a fault in stemmap: {type(error).__name__}: {error}"
            if fault not in self._faults:
                self._faults[fault] = None
                traceback.print_exc(file=sys.stderr)
            problems = (fault,) * len(self.repairs)
            numbers = ((),) * len(problems)
            found = RepairedMap(shown.frame, shown.path, problems, numbers, numbers, loops_of(graph), None)
        self._repaired = (shown.frame, hurried, found)
        return found

    @property
    def reflectance(self) -> UInt8 | None:
        """Reflectance of the raw points of `frame`, see `reflectance_of`; None where it is unknown."""
        shown = self._unrepaired
        return None if shown is None else shown.reflectance

    @property
    def is_hurried(self) -> bool:
        """Whether loops are repaired by an earlier solution."""
        return self._is_on_way() and any(repair.is_of_loop for repair in self.repairs)

    def set_repairs(self, repairs: tuple[Repair, ...]) -> Frame | None:
        """Set the repairs of the map and return the frame of the current scan with them; None before the
        first scan."""
        self.repairs, self._repaired, self._faults = repairs, None, {}
        if any(repair.is_of_loop for repair in repairs):
            self._kept = None  # its graph is not stored, see `show_stored`
        return self.frame

    @property
    def loops(self) -> Int:
        """Numbers of the scans of both ends of each loop of the path, int64, shape (L, 2)."""
        repaired = self.repaired
        if repaired is not None:
            return repaired.loops
        return loops_of(self.run.graph if isinstance(self.run, Run) else KeyframeGraph())

    @property
    def accumulated(self) -> Float32:
        """Points of all scans up to the current one, see `Run.accumulated`, after the repairs of loops; none
        without a run."""
        run, repaired = self.run, self.repaired
        points = np.zeros((0, 3), np.float32) if run is None else run.accumulated
        if not isinstance(run, Run) or repaired is None or repaired.correction is None:
            return points
        scans = run.voxels.latest[: len(points)].astype(np.int64)
        place, _ = repaired.correction.moved(points[:, :2].astype(np.float64), scans)
        return np.column_stack([place, points[:, 2]]).astype(np.float32)

    def mapped_place(self, number: int) -> Float | None:
        """Return the position of a tree in the map before the repairs, shape (2,) [m]; None if that map has
        no tree of this number."""
        shown = self._unrepaired
        if shown is None or shown.frame is None:
            return None
        rows = np.flatnonzero(shown.frame.trees.number == number)
        return shown.frame.trees.position[rows[0]] if len(rows) else None

    @property
    def path(self) -> Path | None:
        """Path up to the scan of `frame`, without rows before its first scan; None if there is no run."""
        shown = self.repaired or self._unrepaired
        return shown.path if shown else None

    @property
    def odometry_xy(self) -> Float:
        """Positions x, y of the robot by odometry alone, of all mapped scans, shape (N, 2) [m]; no rows if
        they are unknown."""
        return np.zeros((0, 2)) if self.run is None else self.run.odometry_xy

    @property
    def confirmed_s(self) -> Float | None:
        """Confirmation time of each tree of `frame`, shape (T,) [s since the first scan], NaN for trees that
        never were confirmed; None if there is no frame."""
        shown, frame = self._unrepaired, self.frame
        known = shown.confirmed_s if shown else None
        if shown is None or known is None or shown.frame is None or frame is None or frame is shown.frame:
            return known
        of = dict(zip(shown.frame.trees.number.tolist(), known.tolist(), strict=True))
        return np.array([of.get(number, np.nan) for number in frame.trees.number.tolist()], np.float64)

    @property
    def counts(self) -> RunCounts | None:
        """Counts of the run up to the scan of `frame`; None if there is no frame."""
        frame = self.frame
        return None if self.run is None or frame is None else self.run.counts(frame.index)

    @property
    def time_s(self) -> float:
        """Time of the scan of `frame` since the first scan of the run [s]; 0 before the first scan."""
        frame = self.frame
        return 0.0 if self.run is None or frame is None else (frame.stamp_ns - self.run.start_ns) / SECOND_NS

    @property
    def is_stored(self) -> bool:
        """Whether the sought scan is shown from its stored results, while the mapper is on its way to it."""
        return self._kept is not None

    def show_stored(self, index: int | None, parameters: Parameters) -> Frame | None:
        """Show a scan of the run from its stored results, and return it. Otherwise the current scan is shown,
        and None is returned: the index is None or that of the current scan, the scan is not stored, or it
        would be mapped with other parameters."""
        self._kept, run = None, self.run
        if run is None or index is None or (index == run.current and run.is_whole):
            return None
        loops = any(repair.is_of_loop for repair in self.repairs)  # the graph of that scan is not stored
        if run.parameters_at(index) == parameters and not loops:
            self._kept = run.kept(index)
        return self.frame if self.is_stored else None

    def show_current(self) -> None:
        """Show the current scan of the run."""
        self._kept = None

    def begin(self, run: AnyRun) -> None:
        """Show a run before its first scan, with the repairs that were set while it was awaited."""
        self.run, self._kept = run, None
        self.forget_repaired()

    def close(self) -> None:
        """Show nothing, and forget the repairs."""
        self.run, self._kept = None, None
        self.repairs, self._faults = (), {}
        self.forget_repaired()

    def forget_repaired(self) -> None:
        """Forget the solution of the repairs; call it when the run has another map."""
        self._repairer, self._repaired = Repairer(), None
