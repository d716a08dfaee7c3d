"""Saved maps: the state of the mapper, from which a run continues with the same bytes.

The state to revert scans after a kidnapping is not saved, so scans before the checkpoint are not reverted. A
search for the lost robot is saved.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pipeline.classification import ColumnClassifierState, PackedVoxelMap, no_columns
from pipeline.config import Parameters
from pipeline.geometry.poses import Float, Pose2
from pipeline.ground.terrain_map import PackedHeightMap
from pipeline.loop_closure.kidnapped_robot import RelocaliserState
from pipeline.map_faults import MapFaults
from pipeline.mapper import Mapper, MapperState
from pipeline.slam import SlamState
from pipeline.slam.frame_uncertainty import FrameUncertainty
from pipeline.slam.keyframe_graph import KEYFRAMES_MAX, Keyframe, LoopEdge, ScanDetections
from pipeline.slam.particle_ancestry import BLOCK
from pipeline.slam.particle_maps import is_sound
from pipeline.slam.places import Places
from pipeline.tracking import Tracker
from pipeline.tracking.track_table import TrackTable
from pipeline.types.records import Columns, Int, Trees


@dataclass(frozen=True, slots=True, eq=False)
class SavedSearch:
    """Search for a lost robot, see RelocaliserState."""

    local: SlamState
    driven: float
    since: int


@dataclass(frozen=True, slots=True, eq=False)
class SavedMap:
    """State of a mapper, see MapperState; `stamp_ns`, `sigma_xy` and `motion` are those of the path, one per
    scan."""

    slam: SlamState
    memory: PackedVoxelMap
    columns: Columns
    ground: PackedHeightMap
    tracks: TrackTable
    next_number: int
    odometry: Pose2 | None
    stamp_ns: Int
    sigma_xy: Float
    motion: Float
    placed: int
    closed: int
    search: SavedSearch | None = None
    faults: MapFaults = MapFaults()  # noqa: RUF009

    @classmethod
    def of(cls, mapper: Mapper) -> SavedMap:
        """Return the state of a mapper, which later scans do not change, without the states to which a lost
        robot could return."""
        state, path = mapper.snapshot(), mapper.path
        slam, lost = state.slam, state.recovery
        return cls(
            slam,
            PackedVoxelMap.of(state.gathering.folded()),
            state.gathering.columns,
            PackedHeightMap.of(state.ground),
            state.tracks,
            state.next_number,
            state.odometry,
            path.stamp_ns,
            path.sigma_xy,
            mapper.motion,
            state.placed,
            state.closed,
            None if lost.local is None else SavedSearch(lost.local, lost.driven, lost.since),
            state.faults,
        )

    def state(self) -> MapperState:
        """Return the state for a mapper, checked; it shares arrays with this record.

        Raises:
            ValueError: Parts of the record contradict each other, or a number is not finite.
        """
        _check_slam(self.slam)
        n = len(self.slam.genealogy)
        if not self.stamp_ns.shape == self.sigma_xy.shape == (n,) or np.any(np.diff(self.stamp_ns) <= 0):
            raise ValueError("the stamps are not those of the path")
        if (
            self.motion.shape != (n, 3)
            or not 0 <= min(self.placed, self.closed) <= max(self.placed, self.closed) <= n
        ):
            raise ValueError("the odometry is not that of the path")
        _check_columns(self.tracks, TrackTable.empty(), len(self.tracks))
        _check_columns(self.columns, no_columns(), len(self.columns.axis))
        _check_finite(self.tracks.x, self.tracks.P, self.tracks.shared, self.columns.axis, self.motion)
        if (
            len(self.tracks)
            and not 0 < self.tracks.number.min() <= self.tracks.number.max() < self.next_number
        ):
            raise ValueError("the numbers of the trees are out of order")
        gathering = ColumnClassifierState(self.memory.checked(), (), self.columns)
        return MapperState(
            self.slam, gathering, self.ground.unpacked(), self.tracks, self.next_number, self.odometry, n,
            self.placed, self.closed, self._recovery(n), faults=self.faults,
        )  # fmt: skip

    def _recovery(self, scans: int) -> RelocaliserState[MapperState]:
        """Return the state of the relocaliser: that of the saved search, or an empty one.

        Raises:
            ValueError: The search does not fit a path of this number of scans.
        """
        if self.search is None:
            return RelocaliserState()
        local, driven, since = self.search.local, self.search.driven, self.search.since
        _check_slam(local)
        if not (np.isfinite(driven) and driven >= 0.0 and 0 <= since <= scans):
            raise ValueError("the search does not fit the path")
        return RelocaliserState(local=local, driven=driven, since=since)

    def trees(self, parameters: Parameters) -> Trees:
        """Return the trees of the map, confirmed or not, with attributes by `parameters.tracking`, see
        `Tracker.trees`."""
        tracker = Tracker(parameters.tracking)
        tracker.tracks, tracker.next_number = self.tracks, self.next_number
        return tracker.trees()


def _check_slam(slam: SlamState) -> None:
    """Check shapes, indices and finiteness of a state of SLAM from a file.

    Raises:
        ValueError: Its parts contradict each other.
    """
    P = len(slam.pose)
    _check_columns(slam, SlamState.at_origin(max(P, 1)), P)
    if not is_sound(slam.maps, P) or not 0 <= slam.best < P:
        raise ValueError("the particles' maps do not fit")
    _check_finite(slam.pose, slam.motion, slam.motion_covariance, slam.maps.mean, slam.maps.covariance)
    past = slam.genealogy
    after = P
    for generation in reversed(past.recent):
        size, ancestors = len(generation.pose), generation.ancestors
        fits = size == after if ancestors is None else len(ancestors) == after and _within(ancestors, size)
        if not fits or generation.pose.shape != (size, 3):
            raise ValueError("the particles have another past")
        after = size
    blocks = (*past.settled, *slam.path.blocks)
    if any(b.shape != (BLOCK, 3) for b in blocks) or slam.path.newest.shape != (len(past) % BLOCK, 3):
        raise ValueError("the path has other columns")
    if len(slam.path) != len(past):
        raise ValueError("the path is not that of the particles")
    _check_finite(slam.path.poses())
    if past.founders is not None and any(len(f) != P or not _within(f, 1 << 20) for f in past.founders):
        raise ValueError("the particles have other founders")
    _check_frame(slam.frame, len(past))
    _check_graph(slam, len(past))
    _check_places(slam.places)


def _check_frame(frame: FrameUncertainty, scans: int) -> None:
    """Check shapes, order and finiteness of the reference poses of a path with this number of scans.

    Raises:
        ValueError: The reference poses do not fit.
    """
    marks = len(frame.serial)
    _check_columns(frame, FrameUncertainty(), marks)
    if np.any(np.diff(frame.serial) < 0) or np.any(np.diff(frame.scan) < 0):
        raise ValueError("the marks of the frame are out of order")
    if marks and not 0 <= frame.scan[0] <= frame.scan[-1] < scans:
        raise ValueError("the marks of the frame are of no scan")
    _check_finite(frame.pose, frame.covariance, frame.hidden, frame.at)


def _check_graph(slam: SlamState, scans: int) -> None:
    """Check the keyframe graph of a state with this number of scans: order, shapes, finite numbers, and
    covariances that are positive definite or (of motions) infinite.

    Raises:
        ValueError: The graph does not fit.
    """
    graph, K = slam.graph, len(slam.graph.keyframes)
    if graph.pose.shape != (K, 3) or K > KEYFRAMES_MAX or not 0 <= graph.solved <= K:
        raise ValueError("the keyframes have no poses")
    for numbers in (graph.scans, np.array([s.scan for s in slam.since_keyframe], np.int64)):
        if len(numbers) and not (0 <= numbers[0] <= numbers[-1] < scans and np.all(np.diff(numbers) > 0)):
            raise ValueError("the keyframes are out of order")
    _check_finite(graph.pose, slam.keyframe_motion, np.array(slam.distance))
    parts: list[Keyframe | ScanDetections] = [*graph.keyframes, *slam.since_keyframe]
    for part in parts:
        D = len(part.birth)
        if not (part.birth.shape == (D,) and part.centre.shape == (D, 2) and part.R.shape == (D, 3)):
            raise ValueError("the detections of a keyframe do not fit")
        if np.any(part.birth < 0):
            raise ValueError("a detection of a keyframe has no landmark")
        xx, xy, yy = part.R.T
        positive = np.all((xx > 0.0) & (yy > 0.0)) and np.all(np.abs(xy) < np.sqrt(xx) * np.sqrt(yy))
        if not np.isfinite(part.distance) or not positive:
            raise ValueError("a covariance of a keyframe is not positive definite")
        _check_finite(part.centre, part.R)
    edges: list[Keyframe | LoopEdge] = [*graph.keyframes, *graph.loops]
    for edge in edges:
        if edge.motion.shape != (3,) or edge.covariance.shape != (3, 3):
            raise ValueError("a motion between keyframes has another shape")
        C = edge.covariance
        if np.isfinite(C).all() and not (np.allclose(C, C.T) and np.linalg.eigvalsh(C)[0] > -1e-9):
            raise ValueError("the covariance of a motion between keyframes is not positive definite")
        _check_finite(edge.motion)
    for loop in graph.loops:
        _check_finite(loop.covariance)
    if any(not np.isin(loop.scans, graph.scans).all() for loop in graph.loops):
        raise ValueError("a loop has no keyframe")


def _check_places(places: Places) -> None:
    """Check shapes, order and finiteness of the places.

    Raises:
        ValueError: The places do not fit.
    """
    _check_columns(places, Places(), len(places.birth))
    _check_finite(places.distance, places.seen)
    if np.any(np.diff(places.birth) < 0) or np.any(np.diff(places.distance) < 0.0):
        raise ValueError("the places of the path are out of order")


def _check_finite(*columns: Float) -> None:
    """Check that all numbers are finite, because compiled code converts them to rows of tables.

    Raises:
        ValueError: A number is not finite.
    """
    if not all(np.isfinite(column).all() for column in columns):
        raise ValueError("a place or a covariance is not finite")


def _within(rows: Int, size: int) -> bool:
    """Return whether rows have one dimension and are all in [0, size)."""
    return rows.ndim == 1 and bool(np.all((rows >= 0) & (rows < size)))


def _check_columns(record: Any, template: Any, rows: int) -> None:  # noqa: ANN401 - a dataclass of arrays
    """Check the shapes of the arrays of a record: an array without rows in the template must have `rows` rows
    and the same further dimensions, any other array the shape of that in the template.

    Raises:
        ValueError: An array has another shape.
    """
    for f in fields(template):
        column, wanted = getattr(record, f.name), getattr(template, f.name)
        if isinstance(wanted, np.ndarray):
            shape = wanted.shape if len(wanted) else (rows, *wanted.shape[1:])
            if column.shape != shape:
                raise ValueError(f"{f.name} of {type(record).__name__} has another shape")
