"""Drives of stems per frame, mapped from any frame with an odometry that drifts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree

from app.extensions.formats.tree_manager import STEM_FINDER
from app.extensions.maps.localisation import StoredMap
from app.extensions.maps.localisation.search import MapIndex
from pipeline.config import preset
from pipeline.geometry.poses import Float, Pose2, Pose3
from pipeline.loop_closure.stem_matching import aligned
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.types.records import Detections, Int, Odometry, Record, Scan, Stems, Trees
from tests.benchmarks.tree_manager_folder import perturbed, read_recorded

#: Errors of the simulated odometry, as in the benchmark `oxford`: fraction of the length of a step,
#: rad/sqrt(m), rad/m.
DISTANCE, TURN, BIAS = 0.02, np.radians(0.5), np.radians(0.02)
SLACK = preset("stems").relocalisation.slack  # m; distortion of a map
NEAR = 25.0  # m around the nearest true pose of the stored drive, which gives the frame of its map at a place


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Stems of each frame in the frame of the sensor, and its true poses in a frame that all drives share.

    Attributes:
        name: Name in tables.
        stamp_ns: Time of each frame, int64, shape (F,).
        poses: True poses, one per frame.
        first: Row of the first stem of each frame, and the number of all stems, shape (F + 1,).
        stems: Positions, shape (N, 3) [m]; axis, shape (N, 3); dbh, shape (N,) [m].
        truth: True x, y [m], yaw [rad] of each frame, shape (F, 3).
        driven: Distance driven at each frame, shape (F,) [m].
    """

    name: str
    stamp_ns: Int
    poses: list[Pose3]
    first: Int
    stems: tuple[Float, Float, Float]
    truth: Float = field(init=False)
    driven: Float = field(init=False)

    def __post_init__(self) -> None:
        truth = np.array([pose.planar().as_array() for pose in self.poses])
        object.__setattr__(self, "truth", truth)
        steps = np.hypot(*np.diff(truth[:, :2], axis=0).T)
        object.__setattr__(self, "driven", np.append(0.0, np.cumsum(steps)))

    def seen(self, k: int, reach: float = 15.0) -> Float:
        """Return the stems of a frame within `reach` [m] by its true pose, shape (S, 2) [m]."""
        xyz = self.stems[0][int(self.first[k]) : int(self.first[k + 1])]
        return self.poses[k].apply(xyz[np.hypot(xyz[:, 0], xyz[:, 1]) <= reach])[:, :2]

    def records(self, begin: int, end: int, rng: np.random.Generator) -> Iterator[Record]:
        """Yield the frames from `begin` to before `end` with a new odometry."""
        told = perturbed(self.poses[begin:end], distance=DISTANCE, turn=TURN, bias=BIAS, rng=rng)
        xyz, axis, dbh = self.stems
        for k, pose in zip(range(begin, end), told, strict=True):
            rows = slice(int(self.first[k]), int(self.first[k + 1]))
            stamp = int(self.stamp_ns[k])
            yield Odometry(stamp, pose)
            yield Scan(stamp, xyz[rows].astype(np.float32), stems=Stems(axis[rows], dbh[rows]))

    def mapped(self, begin: int, end: int, seed: int) -> Iterator[tuple[int, int, Pose2, Trees, Detections]]:
        """Map frames from a new origin; yield the number of each frame, its time, pose, the trees and
        the detections."""
        mapper = Mapper(preset("stems"), sensor=STEM_FINDER, T_base_lidar=Pose3.identity(), seed=seed)
        for step in steps(self.records(begin, end, np.random.default_rng(seed))):
            frame = mapper.process(step)
            T_odom_base = frame.estimate.T_map_base
            yield begin + step.index, frame.stamp_ns, T_odom_base, frame.trees, frame.detections

    def map(self, seed: int) -> Reference:
        """Map the whole drive."""
        mapper = Mapper(preset("stems"), sensor=STEM_FINDER, T_base_lidar=Pose3.identity(), seed=seed)
        frame = None
        for step in steps(self.records(0, len(self.poses), np.random.default_rng(seed))):
            frame = mapper.process(step)
        assert frame is not None
        path = mapper.path
        poses = np.stack([path.x, path.y, path.yaw], axis=1)
        return Reference(self.name, StoredMap.of(frame.trees), self.truth, poses)


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """A stored map and its index, with the true and the estimated poses x, y [m], yaw [rad] of its drive,
    shape (F, 3)."""

    name: str
    stored: StoredMap
    truth: Float
    path: Float
    index: MapIndex = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "index", MapIndex.of(self.stored, SLACK))

    def covers(self, places: Float, within: float = 10.0) -> bool:
        """Return whether the drive passed near each true position, shape (N, 2) [m]."""
        d2 = ((places[:, None] - self.truth[None, :, :2]) ** 2).sum(axis=2)
        return bool(np.all(d2.min(axis=1) <= within**2))

    def there(self, truth: Float) -> Pose2:
        """Return the pose in the stored map at a true pose x, y [m], yaw [rad], by the path of the stored
        drive around its nearest pose, since a map is bent as a whole."""
        place = self.truth[:, :2]
        nearest = place[int(np.argmin(np.hypot(*(place - truth[:2]).T)))]
        near = np.hypot(*(place - nearest).T) <= NEAR
        pose = aligned(place[near], self.path[near, :2], np.ones(np.count_nonzero(near)))
        return Pose2(*(float(v) for v in pose)) @ Pose2(*(float(v) for v in truth))

    def save(self, file: Path) -> None:
        """Write it for another run of a benchmark."""
        content = np.frombuffer(self.stored.as_bytes(), np.uint8)
        np.savez_compressed(file, stored=content, truth=self.truth, path=self.path)

    @classmethod
    def load(cls, name: str, file: Path) -> Reference:
        """Read what `save` wrote."""
        with np.load(file) as kept:
            stored = StoredMap.of_bytes(kept["stored"].tobytes(), str(file))
            return cls(name, stored, kept["truth"], kept["path"])


def frame_offsets(live: Drive, stored: Drive, begin: int, end: int) -> Float:
    """Return the pose x, y [m], yaw [rad] of a drive among the stems of another one less its true pose, at
    the frames from `begin` to before `end`, shape (F, 3); NaN where they are far apart.

    The common frame of recorded drives has errors that differ from place to place. They are measured in the
    frames alone, by the stems around each place at the true poses of both drives, and interpolated.
    """
    after = min(end + OFFSET_EVERY - 1, len(live.poses))
    rows = np.arange(begin - begin % OFFSET_EVERY, after, OFFSET_EVERY)
    known = [(k, offset) for k in rows.tolist() if (offset := _frame_offset(live, stored, k)) is not None]
    if not known:
        return np.full((end - begin, 3), np.nan)
    at, found = np.array([k for k, _ in known]), np.array([offset for _, offset in known])
    frames = np.arange(begin, end)
    offsets = np.column_stack([np.interp(frames, at, found[:, c]) for c in range(3)])
    offsets[np.abs(frames[:, None] - at).min(axis=1) > OFFSET_EVERY] = np.nan
    return offsets


OFFSET_EVERY = 12  # frames, about 20 m: the offset changes by 2 cm
AROUND = 6  # frames before and after a place whose stems are compared
LARGEST = 1.5  # m; the offset is below it


@cache
def _frame_offset(live: Drive, stored: Drive, k: int) -> Float | None:
    """Return `frame_offsets` at a frame: the most frequent shift of the stems, then pairs and alignments."""
    at = live.truth[k, :2]
    near = np.flatnonzero(np.hypot(*(stored.truth[:, :2] - at).T) <= 8.0)
    if len(near) < 3:
        return None
    frames = range(max(k - AROUND, 0), min(k + AROUND + 1, len(live.poses)))
    here = np.concatenate([live.seen(m) for m in frames]) - at
    here = here[np.hypot(*here.T) <= 20.0]
    there = np.concatenate([stored.seen(m) for m in near.tolist()]) - at
    tree = cKDTree(there)
    pairs = tree.query_ball_point(here, LARGEST)
    shift = np.concatenate([there[rows] - stem for rows, stem in zip(pairs, here, strict=True)])
    if len(shift) < 50:
        return None
    counts, x, y = np.histogram2d(
        shift[:, 0], shift[:, 1], bins=60, range=((-LARGEST, LARGEST), (-LARGEST, LARGEST))
    )
    i, j = np.unravel_index(np.argmax(uniform_filter(counts, 5, mode="constant")), counts.shape)
    pose = np.array([0.5 * (x[i] + x[i + 1]), 0.5 * (y[j] + y[j + 1]), 0.0])
    for gate in (0.5, 0.4, 0.3, 0.3, 0.3):
        distance, row = tree.query(Pose2(*pose.tolist()).apply(here), distance_upper_bound=gate)
        paired = np.isfinite(distance)
        if np.count_nonzero(paired) < 30:
            return None
        pose = aligned(here[paired], there[row[paired]], np.ones(np.count_nonzero(paired)))
    return pose


def recorded_drive(name: str, file: Path) -> Drive:
    """Return a drive of Wild-Places or Oxford."""
    recorded = read_recorded(file)
    s = recorded.stems
    order = np.argsort(s["frame"], kind="stable")
    first = np.searchsorted(s["frame"][order], np.arange(len(recorded.poses) + 1))
    xyz, axis, dbh = (np.asarray(s[key][order], np.float64) for key in ("xyz", "axis_z", "dbh"))
    return Drive(name, recorded.stamp_ns, recorded.poses, first, (xyz, axis, dbh))


def stand(seed: int, side: float, density: float, *, rows: bool = False) -> tuple[Float, Float]:
    """Return positions, shape (N, 2) [m], and diameters, shape (N,) [m], of the stems of a square stand with
    its corner at the origin: natural, at least 1 m apart, or planted in rows 3 m apart every 2 m."""
    rng = np.random.default_rng([seed, 1])
    if rows:
        grid = np.stack(np.meshgrid(np.arange(0.0, side, 3.0), np.arange(0.0, side, 2.0)), axis=-1)
        place = grid.reshape(-1, 2) + rng.normal(0.0, 0.15, (grid.size // 2, 2))
        place = place[rng.random(len(place)) < 0.85]  # some were felled
    else:
        place = np.zeros((0, 2))
        for at in rng.uniform(0.0, side, (int(1.3 * density * side**2), 2)):
            if not len(place) or np.min(np.hypot(*(place - at).T)) >= 1.0:
                place = np.vstack([place, at])
    return place, rng.uniform(0.12, 0.5, len(place)) ** 1.2


def stand_drive(name: str, place: Float, dbh: Float, way: Float, seed: int, *, felled: float = 0.0) -> Drive:
    """Return a drive through a stand: a frame each 1.5 m, with 0.8 of the stems within 15 m, 0.05 m noise,
    and 3 false stems.

    Args:
        name: For tables.
        place, dbh: The stems, see `stand`.
        way: Waypoints, shape (W, 2) [m].
        seed: Of the noise.
        felled: Share of the stems that are missing at this drive.
    """
    rng = np.random.default_rng([seed, 2])
    there = rng.random(len(place)) >= felled
    place, dbh = place[there], dbh[there]
    length = np.append(0.0, np.cumsum(np.hypot(*np.diff(way, axis=0).T)))
    at = np.arange(0.0, length[-1], 1.5)
    x, y = (np.interp(at, length, way[:, k]) for k in range(2))
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    poses = [Pose3.from_euler(np.array([a, b, 0.0]), 0.0, 0.0, c) for a, b, c in zip(x, y, yaw, strict=True)]
    frames, first = [], [0]
    for a, b, c in zip(x, y, yaw, strict=True):
        seen = np.flatnonzero(
            (np.hypot(place[:, 0] - a, place[:, 1] - b) < 15.0) & (rng.random(len(place)) < 0.8)
        )
        local = Pose2(float(a), float(b), float(c)).inverse().apply(place[seen])
        local = np.vstack([local + rng.normal(0.0, 0.05, local.shape), rng.uniform(-15.0, 15.0, (3, 2))])
        width = np.append(dbh[seen] + rng.normal(0.0, 0.015, len(seen)), rng.uniform(0.1, 0.5, 3))
        width[rng.random(len(width)) < 0.5] = np.nan
        frames.append((local, width))
        first.append(first[-1] + len(local))
    xy = np.concatenate([f[0] for f in frames])
    axis = np.tile([0.0, 0.0, 1.0], (len(xy), 1))
    columns = (np.column_stack([xy, np.full(len(xy), 1.3)]), axis, np.concatenate([f[1] for f in frames]))
    stamp = np.arange(len(poses), dtype=np.int64) * 1_500_000_000
    return Drive(name, stamp, poses, np.array(first), columns)


def sweep(side: float, lane: float) -> Float:
    """Return waypoints up and down a stand, `lane` [m] apart, shape (W, 2) [m]."""
    xs = np.arange(0.5 * lane, side, lane)
    low, high = 8.0, side - 8.0
    return np.array([p for k, x in enumerate(xs) for p in ([(x, low), (x, high)][:: 1 if k % 2 else -1])])


def wander(side: float, length: float, rng: np.random.Generator) -> Float:
    """Return waypoints of a random way of a length inside of a stand, shape (W, 2) [m]."""
    at, yaw = rng.uniform(0.25 * side, 0.75 * side, 2), rng.uniform(-np.pi, np.pi)
    way = [at]
    for _ in range(int(length / 2.0)):
        yaw += rng.normal(0.0, 0.12)
        step = at + 2.0 * np.array([np.cos(yaw), np.sin(yaw)])
        if not np.all((step > 6.0) & (step < side - 6.0)):
            to = 0.5 * side - at
            yaw += np.clip((np.arctan2(to[1], to[0]) - yaw + np.pi) % (2 * np.pi) - np.pi, -0.6, 0.6)
            step = at + 2.0 * np.array([np.cos(yaw), np.sin(yaw)])
        at = step
        way.append(at)
    return np.array(way)
