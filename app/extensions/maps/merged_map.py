"""Merging of two maps of one stand; the first keeps its frame and its numbers."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from pipeline.classification import PackedVoxelMap
from pipeline.classification.column_classifier import SAME
from pipeline.classification.voxel_map import TILE
from pipeline.config import Parameters
from pipeline.geometry.gaussian import spread_by_pose
from pipeline.geometry.hash_grid import nearest_other
from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.ground.terrain_map import PackedHeightMap, merged_terrain
from pipeline.io.checkpoints.saved_map import SavedMap
from pipeline.slam import SlamState
from pipeline.slam.association import associate
from pipeline.slam.frame_uncertainty import FrameUncertainty, transported_covariance
from pipeline.slam.keyframe_graph import KeyframeGraph
from pipeline.slam.particle_ancestry import EstimatedPath, Genealogy
from pipeline.slam.particle_maps import MapColumns, shared_map
from pipeline.slam.places import Places
from pipeline.tracking.observation import SECTORS, limits_of, table_figures
from pipeline.tracking.track_table import NO_LANDMARK, TrackTable, join
from pipeline.types.records import Columns, Int, Verdict

GATE = 5.0  # sigma; largest distance of observations of one tree
MOST_RETURNS = 20  # of a voxel of the second map


@dataclass(frozen=True, slots=True, eq=False)
class MergedMap:
    """Result of merging.

    Attributes:
        map: Trees, landmarks and paths of both maps.
        number_of: Number of each tree of the second map in the merged map, shape (T,).
        distance: Distance of each tree of the second map from the tree of the first map with which it was
            joined, NaN if it was not joined, shape (T,) [m].
    """

    map: SavedMap
    number_of: Int
    distance: Float


def merge_maps(
    a: SavedMap, b: SavedMap, T_a_b: Pose2, covariance: Float, stamp_shift_ns: int, parameters: Parameters
) -> MergedMap:
    """Merge map b into map a; both are unchanged. Trees that `associate` pairs within GATE sigma (with
    `relocalisation.slack` added) and `slam.distance_max` become one with the number in a; other trees of b
    get new numbers. The run continues at the end of b, in the frame of a, without graph, places, odometry
    and a search for a lost robot. The terrain of b is left out if the runs have too little ground in common,
    see `merged_terrain`.

    Args:
        a, b: The maps.
        T_a_b: Pose of the frame of b in that of a.
        covariance: Covariance of T_a_b, x, y [m], yaw [rad], shape (3, 3).
        stamp_shift_ns: Added to the times of b [ns], which must then be after those of a; this is not
            checked.
        parameters: Parameters of all stages.

    Raises:
        ValueError: The terrain of a map contradicts itself, see `PackedHeightMap.unpacked`.
    """
    moved = _moved_tracks(b.tracks, T_a_b, covariance, stamp_shift_ns)
    moved.landmark[moved.landmark != NO_LANDMARK] += a.slam.detections
    slack = parameters.relocalisation.slack**2
    row_of, _ = associate(
        moved.x[:, :2], _flat(moved.P) + np.array([slack, 0.0, slack]), a.tracks.x[:, :2], _flat(a.tracks.P),
        GATE, parameters.slam.distance_max,
    )  # fmt: skip
    fresh = row_of < 0
    number_of = np.zeros(len(moved), np.int64)
    distance = np.full(len(moved), np.nan)
    number_of[fresh] = a.next_number + np.arange(np.count_nonzero(fresh))
    number_of[~fresh] = a.tracks.number[row_of[~fresh]]
    gap = moved.x[~fresh, :2] - a.tracks.x[row_of[~fresh], :2]
    distance[~fresh] = np.hypot(gap[:, 0], gap[:, 1])
    both = a.tracks.extended(moved)
    for k in np.flatnonzero(~fresh):
        join(both, int(row_of[k]), len(a.tracks) + int(k))
    matched = row_of[~fresh]
    shown = (moved.verdict < 0) & table_figures(moved.as_rows(), limits_of(parameters.tracking))[-1]
    hidden = ((a.tracks.verdict[matched] < 0) | shown[~fresh]) & (both.verdict[matched] != Verdict.TREE)
    both.verdict[matched[hidden]] = -1  # a tree that one of the runs confirmed by its hits stays confirmed
    both.number[len(a.tracks) :] = number_of
    tracks = both.take(np.concatenate([np.ones(len(a.tracks), np.bool_), fresh]))
    path = np.concatenate([a.slam.path.poses(), _moved_path(b, T_a_b)])
    merged = replace(
        a,
        slam=_slam(a.slam, b.slam, T_a_b, covariance, path, parameters.slam.distance_max),
        memory=_memory(a.memory, b.memory, T_a_b, len(path), 1 << parameters.classification.voxels_log2),
        columns=_columns(a.columns, b.columns, T_a_b),
        ground=PackedHeightMap.of(merged_terrain(a.ground.unpacked(), b.ground.unpacked(), T_a_b)),
        tracks=tracks,
        next_number=a.next_number + int(np.count_nonzero(fresh)),
        odometry=None,
        search=None,  # a robot lost at the end of a is at the end of b
        stamp_ns=np.concatenate([a.stamp_ns, b.stamp_ns + stamp_shift_ns]),
        sigma_xy=np.concatenate(
            [a.sigma_xy, np.hypot(b.sigma_xy, np.sqrt(np.trace(covariance[:2, :2]) / 2))]
        ),
        motion=np.concatenate([a.motion, b.motion]),
        placed=len(a.stamp_ns) + b.placed,
        closed=len(a.stamp_ns) + b.closed,
    )
    return MergedMap(merged, number_of, distance)


def _flat(P: Float) -> Float:
    """Return xx, xy, yy, shape (N, 3), of covariances, shape (N, 2 or more, 2 or more)."""
    flat: Float = P[:, [0, 0, 1], [0, 1, 1]]
    return flat


def _moved_tracks(tracks: TrackTable, T: Pose2, covariance: Float, shift_ns: int) -> TrackTable:
    """Return a copy of tracks in another frame, at later times.

    Args:
        tracks: The tracks.
        T: Pose of the frame of the tracks in the new frame.
        covariance: Covariance of T, shape (3, 3); it is added to that of the positions, as a shared part.
        shift_ns: Added to all times [ns].
    """
    moved = tracks.copy()
    C = np.kron(np.eye(2), T.rotation())
    moved.x[:] = tracks.x @ C.T
    moved.x[:, :2] += [T.x, T.y]
    moved.P[:] = C @ tracks.P @ C.T
    of_the_frame = spread_by_pose(moved.x[:, :2].copy(), T.as_array(), covariance)
    moved.P[:, :2, :2] += of_the_frame
    moved.shared[:] = C[:2, :2] @ tracks.shared @ C[:2, :2].T + of_the_frame
    moved.stamp_ns[:] += shift_ns
    moved.first_ns[:] += shift_ns
    turn = round(T.yaw / (2.0 * np.pi / SECTORS)) % SECTORS
    all_sides = (1 << SECTORS) - 1
    moved.sides[:] = ((tracks.sides << turn) | (tracks.sides >> (SECTORS - turn))) & all_sides
    return moved


def _moved_path(b: SavedMap, T: Pose2) -> Float:
    """Return the path of a map in another frame, x, y [m], yaw [rad, wrapped], shape (N, 3); T is the pose of
    the frame of the map in the new frame."""
    poses = b.slam.path.poses()
    return np.column_stack([T.apply(poses[:, :2]), wrap_angle(poses[:, 2] + T.yaw)])


def _slam(a: SlamState, b: SlamState, T: Pose2, covariance: Float, path: Float, reach: float) -> SlamState:
    """Return the state of SLAM of the merged map: all particles have the best map of a and those landmarks of
    the best map of b that no landmark of a is associated with, and the last pose of `path`.

    Args:
        a, b: States of SLAM of the two maps.
        T: Pose of the frame of b in that of a.
        covariance: Covariance of T, shape (3, 3).
        path: Path of the merged map.
        reach: Distance within which landmarks of both maps are the same [m].
    """
    P = len(a.pose)
    known, other = a.map_of(a.best), b.map_of(b.best)
    C = T.rotation()
    full = other.covariance[:, [[0, 1], [1, 2]]]
    mean = T.apply(other.mean)
    R = _flat(C @ full @ C.T + spread_by_pose(mean, T.as_array(), covariance))
    row_of, _ = associate(mean, R, known.mean, known.covariance, np.inf, reach)
    new = row_of < 0
    moved = MapColumns(mean, R, other.hits, other.score, other.birth + a.detections)
    landmarks = MapColumns(
        *(np.concatenate([getattr(known, name), getattr(moved, name)[new]]) for name in MapColumns._fields)
    )
    return replace(
        a.placed(np.tile(path[-1], (P, 1))),
        frame=_frame(a, b, T, covariance),
        maps=shared_map(P, landmarks),
        detections=a.detections + b.detections,
        genealogy=Genealogy.of_path(path, P),
        path=EstimatedPath.of(path),
        graph=KeyframeGraph(),  # no odometry connects the two runs
        places=Places(),  # all landmarks are active
        since_keyframe=(),
        keyframe_motion=np.zeros(3),
        keyframe_covariance=np.zeros((3, 3)),
    )


def _frame(a: SlamState, b: SlamState, T: Pose2, covariance: Float) -> FrameUncertainty:
    """Return the uncertainty of the frame of the merged map: the records of both runs. Those of b are moved
    by T and the uncertainty of T is added. If b has no records, those of a are returned.

    Args:
        a, b: States of the runs.
        T: Pose of the frame of b in the frame of a.
        covariance: Covariance of T, x, y [m], yaw [rad], shape (3, 3).
    """
    own, other = a.frame.without_hidden(), b.frame
    if not len(other.serial):
        return own
    pose = np.column_stack([T.apply(other.pose[:, :2]), wrap_angle(other.pose[:, 2] + T.yaw)])
    C = np.eye(3)
    C[:2, :2] = T.rotation()
    moved = C @ other.covariance @ C.T
    for k, (x, y, _) in enumerate(pose):
        moved[k] += transported_covariance(covariance, x - T.x, y - T.y)
    return replace(
        own,
        serial=np.concatenate([own.serial, other.serial + a.detections]),
        scan=np.concatenate([own.scan, other.scan + len(a.genealogy)]),
        pose=np.concatenate([own.pose, pose]),
        covariance=np.concatenate([own.covariance, moved]),
        smoothed=np.concatenate([own.smoothed, other.smoothed]),
        at=pose[-1],
    )


def _memory(a: PackedVoxelMap, b: PackedVoxelMap, T: Pose2, scan: int, most: int) -> PackedVoxelMap:
    """Return the voxels of a, to which the mean of each voxel of b is added as often as the voxel has
    returns, at most MOST_RETURNS times. No tile of the result is due for classification; a and b are
    unchanged.

    Args:
        a, b: Voxel maps.
        T: Pose of the frame of b in that of a.
        scan: Index of the scan at which the means of b are added.
        most: Maximum number of voxels.
    """
    memory = a.unpacked()
    points = b.mean.copy()
    points[:, :2] = T.apply(b.mean[:, :2].astype(np.float64))
    memory.add(np.repeat(points, np.minimum(b.returns, MOST_RETURNS), axis=0), scan, most)
    memory.added += b.added - 1
    while len(memory.due_tiles(1.0)):  # the columns of both are kept until there are new returns
        pass
    return PackedVoxelMap.of(memory)


def _columns(a: Columns, b: Columns, T: Pose2) -> Columns:
    """Return the columns of a, and those of b that are more than SAME from all of a, moved into the
    frame of a; T is the pose of the frame of b in the frame of a."""
    axis = b.axis.copy()
    axis[:, :2] = T.apply(b.axis[:, :2])
    axis[:, 2:4] = b.axis[:, 2:4] @ T.rotation().T
    new = nearest_other(axis, a.axis, SAME) < 0
    names = [f.name for f in fields(Columns) if f.name not in ("tile", "axis")]
    joined = {name: np.concatenate([getattr(a, name), getattr(b, name)[new]]) for name in names}
    tile = np.floor(axis[new, :2] / TILE).astype(np.int64)
    return Columns(tile=np.concatenate([a.tile, tile]), axis=np.concatenate([a.axis, axis[new]]), **joined)
