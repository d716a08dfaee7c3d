"""Virtual scanning: a simulated robot drives through the real cloud of a plot, and its true pose is known.

Bark, branches and undergrowth are those of the cloud. The LiDAR, its noise, the wheels and the IMU are those
of all simulated runs.

Beams meet surfels: the cloud as small discs in the surface of the neighbouring points. Returns must be at the
positions of points. Where the surface is curved, as on a trunk, a disc is much smaller than the gaps between
points, so that a trunk does not get thicker; only on flat ground discs are as wide as the gaps. In foliage a
point is a small ball. Each point of a surface also blocks the beams around it, so that no beam passes through
the gaps of a trunk to the bark on its far side.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlencode

import numpy as np

from app.extensions.clouds.drive_address import parse_drive
from app.extensions.clouds.plot_ground import ground_steps
from app.extensions.clouds.records import WholeCloud
from app.extensions.clouds.sources import open_cloud
from app.extensions.clouds.terrain_raster import TerrainRaster
from app.sources.one_step import finish
from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.ground_truth import read_truth_trees
from pipeline.io.readers.base import SourceOptions
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.jit import compiled
from pipeline.simulation import run as simulated
from pipeline.simulation.lidar import SpinningLidar, Sweep, scan_of_returns
from pipeline.simulation.primitives import SolidsBuilder
from pipeline.simulation.ray_casting import Optics
from pipeline.simulation.robot_motion import (
    drive_course,
    inertial_readings,
    lap_time,
    lay_course,
    lay_on_terrain,
)
from pipeline.simulation.run import MOUNTING, SimulatedRun, odometry_of, random_stream
from pipeline.simulation.scenarios import SCHEME, RunRequest
from pipeline.simulation.scene import SimulatedScene
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import Bool, Float, Float32, Int, TruthTrees

NEIGHBOURS = 10
SURFACE, FLAT = 0.35, 0.03  # ratio of smallest to middle eigenvalue of the covariance of the neighbours
WIDE, SMALL = 1.0, 0.6  # radius as a share of the distance to the sixth neighbour
LEAST, WIDEST, SMALLEST, BALL = 0.006, 0.10, 0.025, 0.008  # m; of all, of ground, of other discs, of balls
UPRIGHT = 0.7  # least vertical component of the normal of flat ground
BEHIND = 0.06  # m; surfels farther behind a blocking point are hidden
GRAZING = 0.15  # sine of the angle between beam and disc below which the disc is not met
MELT = 0.04  # m; hits this close together are measured as one
_PART = 1 << 17


class Surfels(NamedTuple):
    """Discs and balls as columns of length N, float32, in the frame of the world.

    Attributes:
        points: Positions, shape (N, 3) [m].
        normals: Unit normals of discs, zero for balls, shape (N, 3).
        radius: Radius of the discs and balls, shape (N,) [m].
        blocks: Radius in which a point hides surfels behind it, 0 in foliage, shape (N,) [m].
    """

    points: Float32
    normals: Float32
    radius: Float32
    blocks: Float32


def lay_surfels(points: Float32) -> Surfels:
    """Return surfels at the points of a cloud, float32, shape (N, 3) [m]; for a cloud of NEIGHBOURS or fewer
    points, balls that block nothing. The array of points is not copied."""
    from scipy.spatial import cKDTree

    n = len(points)
    normals, blocks = np.zeros((n, 3), np.float32), np.zeros(n, np.float32)
    radius = np.full(n, BALL, np.float32)
    if n > NEIGHBOURS:
        tree = cKDTree(points)
        for k in range(0, n, _PART):
            distance, near = tree.query(points[k : k + _PART], k=NEIGHBOURS + 1)
            part = slice(k, k + _PART)
            _lay(points, near, distance, normals[part], radius[part], blocks[part])
    return Surfels(points, normals, radius, blocks)


@compiled
def _lay(
    points: Float32, near: Int, distance: Float, normals: Float32, radius: Float32, blocks: Float32
) -> None:
    """Fill normal, radius and blocking radius of a part of the points, in place. Where the neighbours form no
    surface, the normal stays as it is and the point blocks nothing.

    Args:
        points: All points, shape (N, 3) [m].
        near: Rows of each point of the part and its neighbours, nearest first, shape (M, NEIGHBOURS + 1).
        distance: Distances of these rows from the point, same shape [m].
        normals, radius, blocks: Rows of the part in the columns of `Surfels`, which must be 0 for normals and
            blocks.
    """
    C, mean = np.empty((3, 3)), np.empty(3)
    for i in range(near.shape[0]):
        mean[:] = 0.0
        C[:] = 0.0
        for j in near[i]:
            for a in range(3):
                mean[a] += points[j, a] / near.shape[1]
        for j in near[i]:
            for a in range(3):
                for b in range(3):
                    C[a, b] += (points[j, a] - mean[a]) * (points[j, b] - mean[b])
        spacing = distance[i, 6]
        values, vectors = np.linalg.eigh(C)
        radius[i] = min(max(SMALL * spacing, LEAST), BALL)
        if values[0] < SURFACE * values[1]:
            normals[i, 0], normals[i, 1], normals[i, 2] = vectors[0, 0], vectors[1, 0], vectors[2, 0]
            radius[i] = min(max(SMALL * spacing, LEAST), SMALLEST)
            blocks[i] = min(max(WIDE * spacing, LEAST), WIDEST)
            # The side of a sparsely sampled trunk seems as flat as ground, but wide discs would protrude from
            # it.
            if values[0] < FLAT * values[1] and abs(vectors[2, 0]) > UPRIGHT:
                radius[i] = blocks[i]


@compiled
def first_surfels(surfels: Surfels, R: Float, o: Float, beams: Float, optics: Optics) -> Float:
    """Return the range [m] of each beam of a sweep, shape (C, K); infinite when it meets nothing up to
    `optics.range_max`, or only surfels hidden behind another point.

    Each surfel is seen from the pose of the sensor when the beam passes it, and only the beams within its
    angle are tested. Surfels nearer to the axis of the sensor than twice `radius` or twice `blocks` are
    ignored. The range is the mean of the nearest hit and of those within MELT behind it, weighted towards the
    middle of the discs.

    Args:
        surfels: The surfels.
        R, o: Pose of the sensor at each column, shapes (C, 3, 3) and (C, 3) [m].
        beams: Unit directions of the beams in the sensor frame, shape (C, K, 3); column c has the azimuth pi
            - c 2 pi / C.
        optics: Beams of the sensor.
    """
    points, normals, radius, blocks = surfels.points, surfels.normals, surfels.radius, surfels.blocks
    lowest, ring_step, farthest = optics.lowest, optics.ring_step, optics.range_max
    columns, rings = beams.shape[0], beams.shape[1]
    nearest, hidden = np.full((columns, rings), np.inf), np.full((columns, rings), np.inf)
    beam, met, weight = np.empty(1 << 16, np.int64), np.empty(1 << 16), np.empty(1 << 16)
    n, step, middle = 0, 2.0 * np.pi / columns, columns // 2
    v, m = np.empty(3), np.empty(3)
    for i in range(points.shape[0]):
        c = middle
        for _ in range(2):  # the position in the sweep decides from which pose it is seen
            _turn(points[i], R[c], o[c], v)
            c = int((np.pi - np.arctan2(v[1], v[0])) / step + 0.5) % columns
        _turn(points[i], R[c], o[c], v)
        flat = np.sqrt(v[0] * v[0] + v[1] * v[1])
        reach, s = np.sqrt(flat * flat + v[2] * v[2]), radius[i]
        widest = max(s, blocks[i])
        if reach > farthest or flat < 2.0 * widest:
            continue
        ring, tall = (np.arctan2(v[2], flat) - lowest) / ring_step, widest / reach / ring_step
        first, last = max(int(np.ceil(ring - tall)), 0), min(int(np.floor(ring + tall)), rings - 1)
        if first > last:
            continue
        for a in range(3):
            m[a] = R[c, 0, a] * normals[i, 0] + R[c, 1, a] * normals[i, 1] + R[c, 2, a] * normals[i, 2]
        disc = normals[i, 0] != 0.0 or normals[i, 1] != 0.0 or normals[i, 2] != 0.0
        at, wide = (np.pi - np.arctan2(v[1], v[0])) / step, widest / flat / step
        for column in range(int(np.ceil(at - wide)), int(np.floor(at + wide)) + 1):
            for k in range(first, last + 1):
                d = beams[column % columns, k]
                t = d[0] * v[0] + d[1] * v[1] + d[2] * v[2]
                if reach * reach - t * t < blocks[i] * blocks[i]:
                    hidden[column % columns, k] = min(hidden[column % columns, k], t + BEHIND)
                if disc:
                    facing = d[0] * m[0] + d[1] * m[1] + d[2] * m[2]
                    if abs(facing) < GRAZING:
                        continue
                    t = (v[0] * m[0] + v[1] * m[1] + v[2] * m[2]) / facing
                off2 = (t * d[0] - v[0]) ** 2 + (t * d[1] - v[1]) ** 2 + (t * d[2] - v[2]) ** 2
                if off2 >= s * s or t <= 0.0:
                    continue
                if n == beam.shape[0]:
                    beam = np.append(beam, np.empty_like(beam))
                    met, weight = np.append(met, np.empty_like(met)), np.append(weight, np.empty_like(weight))
                b = (column % columns) * rings + k
                beam[n], met[n], weight[n] = b, t, 1.0 - off2 / (s * s)
                n += 1
                nearest[column % columns, k] = min(nearest[column % columns, k], t)
    ranges = _melt(nearest, beam[:n], met[:n], weight[:n])
    return np.where(nearest <= hidden, ranges, np.inf)


@compiled
def _turn(point: Float32, R: Float, o: Float, v: Float) -> None:
    """Write the position of a point in the sensor frame into v, shape (3,) [m]; R (3, 3) and o (3,) are the
    pose of the sensor in the world."""
    x, y, z = point[0] - o[0], point[1] - o[1], point[2] - o[2]
    for a in range(3):
        v[a] = R[0, a] * x + R[1, a] * y + R[2, a] * z


@compiled
def _melt(nearest: Float, beam: Int, met: Float, weight: Float) -> Float:
    """Return the range of each beam [m], shape (C, K): the weighted mean of its hits up to MELT behind the
    nearest one; infinite without a hit.

    Args:
        nearest: Range of the nearest hit of each beam, shape (C, K) [m].
        beam: Beam of each hit, column * K + ring, shape (N,).
        met: Range of each hit, shape (N,) [m].
        weight: Weight of each hit, shape (N,).
    """
    rings = nearest.shape[1]
    total, share = np.zeros(nearest.shape), np.zeros(nearest.shape)
    for i in range(beam.shape[0]):
        c, k = beam[i] // rings, beam[i] % rings
        if met[i] <= nearest[c, k] + MELT:
            total[c, k] += weight[i] * met[i]
            share[c, k] += weight[i]
    return np.where(share > 0.0, total / np.maximum(share, 1e-12), np.inf)


# Raise it with every change that only changes the bytes of runs through clouds.
VERSION = 4
SLOPE = 35.0  # degrees; of the terrain against the plane of the plot
BAND = (-0.5, 40.0)  # m above the ground; noise below it is not scanned
MOST = 1 << 20  # points after thinning
SPEED = 0.6  # m/s
SHORTEST, LONGEST = 10.0, 600.0  # s; of one loop, unless a duration is planned for
REFLECTANCE = 60.0  # of all returns: intensities of clouds have other scales


@dataclass(frozen=True, slots=True, eq=False)
class PlotGround:
    """The ground of a plot in the frame of the first pose of the robot: a height map in the frame of the
    cloud, and position, shape (3,) [m], and yaw [rad] of the first pose in it."""

    height: TerrainRaster
    start: Float
    yaw: float

    def evaluate(self, x: Float, y: Float) -> Float:
        """Return height [m], dz/dx and dz/dy at positions x, y of shape (N,) each [m] in the frame of the
        first pose; shape (N, 3). Outside of the raster, the values at its border are returned."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        there = self.height.evaluate(self.start[0] + c * x - s * y, self.start[1] + s * x + c * y)
        z, gx, gy = there.T
        return np.stack([z - self.start[2], c * gx + s * gy, c * gy - s * gx], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class CloudRun(SimulatedRun):
    """A run through a real cloud.

    Attributes:
        surfels: The cloud in the frame of the first pose.
        source_digest: SHA-256 of the cloud and of the table of its trees.
        warnings: Messages for the user.
    """

    surfels: Surfels
    source_digest: str
    warnings: tuple[str, ...]

    def sweep(self, k: int) -> Sweep:
        """Simulate scan k, 0 to `scans` - 1; the result does not depend on other scans. Ranges outside of the
        limits of the sensor give no return; all returns have the reflectance REFLECTANCE and no solid (-1).
        """
        lidar = self.lidar
        _, R, o = self.sensor_poses(k)
        ranges = first_surfels(self.surfels, R, o, lidar.beams(), lidar.optics)
        noise = random_stream(simulated.SCAN, self.request, k).standard_normal(ranges.shape)
        reported = ranges + lidar.range_sigma * noise
        reported[~((reported >= lidar.range_min) & (reported <= lidar.range_max))] = 0.0
        reflectance, no_solid = np.full(ranges.shape, REFLECTANCE), np.full(ranges.shape, -1, np.int32)
        stamp_ns = simulated.START_NS + k * lidar.period_ns
        echoes = reported[:, :, None], reflectance[:, :, None], no_solid[:, :, None]
        return scan_of_returns(lidar, stamp_ns, *echoes)

    def digest(self) -> str:
        """Return the SHA-256 (hex) of everything that decides the bytes of the run."""
        request = (self.request.seed, self.request.sigma, self.request.odometry, self.request.duration_s)
        version = f"{simulated.VERSION}.{VERSION}"
        text = f"stemmap cloud {version}; {request}; {self.source_digest}; {self._mounting()}"
        return hashlib.sha256(text.encode()).hexdigest()


def open_drive(uri: str, path: Path, options: SourceOptions) -> SimulatedSource:
    """Open a whole cloud as a run: a simulated robot drives through it.

    Args:
        uri: Path of the cloud, or the address `sim:cloud`, as the user wrote it.
        path: File of the cloud; not used for an address.
        options: Choices of the user, of which seed and extrinsics are used.

    Raises:
        UsageError: See `parse_drive`.
        SourceError: The cloud or the ground truth cannot be read, or the cloud has no path for a robot.
    """
    is_address = uri.startswith(f"{SCHEME}cloud")
    address = uri if is_address else f"{SCHEME}cloud?{urlencode({'file': str(path)})}"
    file, truth, request = parse_drive(address, options.seed)
    trees = read_truth_trees(Path(truth).expanduser()) if truth else None
    cloud = open_cloud(file, options)
    try:
        run = open_cloud_run(request, cloud, trees, options.T_base_lidar)
    except SourceError as error:
        raise SourceError(
            error.what, where=uri, remedy="`stemmap map` maps the cloud as a whole, without a robot"
        ) from None
    kind = f"simulated drive through a whole cloud ({cloud.description.kind})"
    return SimulatedSource(uri, run, knows_trees=trees is not None, kind=kind, warnings=run.warnings)


def open_cloud_run(
    request: RunRequest, cloud: WholeCloud, trees: TruthTrees | None, T_base_lidar: Pose3 | None = None
) -> CloudRun:
    """Plan a path through a cloud and drive it; no scan is simulated yet. The cloud is read three times.

    Args:
        request: Requested options; a duration of 0 means one loop, of SHORTEST to LONGEST seconds. A longer
            loop is cut short with a warning.
        cloud: The cloud of the plot.
        trees: Trees of the plot in the coordinates of the file, i.e. with the offset; None if there is no
            ground truth.
        T_base_lidar: Extrinsics of the LiDAR; None uses those of simulated robots.

    Raises:
        SourceError: The cloud cannot be read, has no points, is too large for a plot, or has no path for a
            robot.
    """
    ground, near, _ = finish(ground_steps(cloud, SLOPE, band=BAND, most=MOST))
    points = near.points
    if len(points) == 0:
        raise SourceError("the cloud has no points", where=cloud.description.uri)
    way = loop_through(points, ground, cloud.description.uri)
    course = lay_course(way, closed=True)
    heading = course.heading
    start = np.append(way[0], ground.at(way[:1, 0], way[:1, 1]))
    lap = float(np.ceil(lap_time(course, SPEED)))
    duration = request.duration_s or min(max(lap, SHORTEST), LONGEST)
    planned = RunRequest(request.name, request.seed, request.sigma, request.odometry, duration, 0)
    drive = drive_course(course, SPEED, duration)
    motion = lay_on_terrain(
        drive, PlotGround(ground, start, heading), random_stream(simulated.SHAKE, planned)
    )
    return CloudRun(
        request=planned,
        T_base_lidar=MOUNTING if T_base_lidar is None else T_base_lidar,
        lidar=SpinningLidar(range_sigma=planned.sigma),
        scene=_scene(trees, cloud.description.offset + start, heading),
        motion=motion,
        odometry=odometry_of(motion, planned),
        inertial=inertial_readings(motion, random_stream(simulated.INERTIAL, planned)),
        scans=round(duration * 1e9) // SpinningLidar().period_ns,
        surfels=lay_surfels(_from(points[:, :3], start, heading)),
        source_digest=cloud.description.digest,
        warnings=_cut_short(course.s[-1], lap) if lap > LONGEST and not request.duration_s else (),
    )


def _cut_short(way: float, lap: float) -> tuple[str]:
    """Return the warning for a loop that is not driven to its end.

    Args:
        way: Length of the loop [m].
        lap: Time that it takes [s].
    """
    drives = f"duration={lap:.0f} drives all of it" if lap <= 3600.0 else "duration=3600 drives most of it"
    return (f"the loop through the plot is {way:.0f} m long, of which {LONGEST:.0f} s are driven: {drives}",)


def _from(points: Float32, start: Float, yaw: float) -> Float32:
    """Return points, shape (N, 3) [m], in the frame of a pose, float32.

    Args:
        points: Points in the frame of the cloud minus its offset.
        start: Position of the pose in this frame, shape (3,) [m].
        yaw: Yaw of the pose [rad].
    """
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    seen: Float32 = ((points - start) @ R.T).astype(np.float32)
    return seen


def _scene(trees: TruthTrees | None, start: Float, yaw: float) -> SimulatedScene:
    """Return a scene that only has a ground truth: its objects are the surfels, so that it has no solids and
    flat ground.

    Args:
        trees: Ground truth in the coordinates of the file; None for an empty one.
        start: Position of the first pose in these coordinates, x, y first [m]; it becomes the origin.
        yaw: Yaw of the first pose [rad].
    """
    none = np.zeros(0)
    truth = TruthTrees(none, none, none, ())
    if trees is not None:
        c, s = np.cos(yaw), np.sin(yaw)
        x, y = trees.x - start[0], trees.y - start[1]
        truth = TruthTrees(c * x + s * y, c * y - s * x, trees.dbh, trees.kind)
    return SimulatedScene(
        terrain=SimulatedTerrain(np.zeros((1, 4))),
        still=SolidsBuilder().build(),
        truth=truth,
    )


CELL = 0.1  # m
LOW, HIGH = 0.25, 1.6  # m above the ground; points in this band are obstacles
# Number of points that makes a cell an obstacle, as a share of that of the densest cells. Stems are dense.
# Where there is no other path, the robot drives through sparse leaves.
DENSITIES = (0.02, 0.1, 0.25, 0.5)
DENSE = 98  # percentile
REACHES = 0.5  # share of the plot, along both axes, that the path must cover
CLEARANCES = (0.6, 0.45, 0.35, 0.25)  # m; the widest with which there is a loop
STATIONS = 16
PART = 0.6  # share of the distance from the middle to the border
SIDE = 0.2  # m; cells of the path search
SPACING = 0.8  # m; between waypoints


def loop_through(points: Float32, ground: TerrainRaster, where: str) -> Float:
    """Return waypoints of a closed loop, shape (N, 2) [m], the first not repeated, in the frame of the
    points; the same cloud gives the same loop. The widest clearance for which there is a loop is used; where
    there is none, sparse vegetation counts as free.

    Args:
        points: Points x, y, z and height above the ground, shape (N, 4) [m].
        ground: Ground of the plot; the loop stays where ground was seen.
        where: Name of the cloud, for the error.

    Raises:
        SourceError: Stems and undergrowth leave no path.
    """
    count = _obstacles(points, ground)
    densest = float(np.percentile(count[count > 0], DENSE)) if (count > 0).any() else 1.0
    for density in DENSITIES:
        clearance = _clearance(count < max(density * densest, 1.0), ground)
        for least in CLEARANCES:
            loop = _loop(clearance, least)
            if loop is not None:
                return ground.low + (loop + 0.5) * SIDE
    raise SourceError("there is no free way for a robot through the plot", where=where)


def _obstacles(points: Float32, ground: TerrainRaster) -> Int:
    """Return the number of points that are obstacles in each cell of side CELL, int64, shape (R, C), over the
    extent of `ground`; points outside of it do not count.

    Args:
        points: Points x, y, z and height above the ground, shape (N, 4) [m]; those with a height between LOW
            and HIGH are obstacles.
        ground: Ground of the plot.
    """
    times = round(ground.cell / CELL)
    shape = (ground.seen.shape[0] * times, ground.seen.shape[1] * times)
    way = points[(points[:, 3] > LOW) & (points[:, 3] < HIGH)]
    cell = np.floor((way[:, :2] - ground.low) / CELL).astype(np.int64)
    inside = ((cell >= 0) & (cell < shape)).all(axis=1)
    count = np.zeros(shape, np.int64)
    np.add.at(count, tuple(cell[inside].T), 1)
    return count


def _clearance(free: Bool, ground: TerrainRaster) -> Float:
    """Return the smallest distance of each cell of side SIDE to obstacles [m], 0 in obstacles; cells more
    than one cell of `ground` from seen ground, and outside of the raster, are obstacles. The shape is half of
    that of `free`, rounded down.

    Args:
        free: Whether each cell of side CELL is free, shape (R, C).
        ground: Ground of the plot, over the same extent.
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt

    seen = binary_dilation(ground.seen, iterations=1)
    times = round(ground.cell / CELL)
    free = free & np.kron(seen, np.ones((times, times), np.bool_))
    distance = distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * CELL
    both = round(SIDE / CELL)
    columns, rows = (n - n % both for n in distance.shape)
    coarse: Float = (
        distance[:columns, :rows].reshape(columns // both, both, rows // both, both).min(axis=(1, 3))
    )
    return coarse


def _loop(clearance: Float, least: float) -> Float | None:
    """Return a closed path over the largest region of cells with at least a clearance [m]: rows and columns
    of cells, float64, shape (N, 2), about SPACING apart. None if there is no such cell, or if the path does
    not lead around a large enough part of the cloud.

    Args:
        clearance: Distance of each cell to obstacles, shape (R, C) [m].
        least: Minimum clearance [m].
    """
    from scipy.ndimage import label

    region, regions = label(clearance >= least)
    if regions == 0:
        return None
    largest = region == 1 + int(np.argmax(np.bincount(region.ravel())[1:]))
    stations = _stations(clearance, largest)
    if len(stations) < 5 or (np.ptp(stations, axis=0) < REACHES * np.array(region.shape)).any():
        return None
    way = _joined(clearance, largest, stations)
    every = max(int(SPACING / SIDE), 1)
    loop: Float = way[::every].astype(np.float64)
    return loop if len(loop) >= 6 else None


def _stations(clearance: Float, region: Bool) -> Int:
    """Return cells around the middle of a region, one in each of STATIONS directions that has any: at about
    the share PART of the way to the border, if possible with much clearance.

    Args:
        clearance: Distance of each cell to obstacles, shape (R, C) [m].
        region: Cells of the region, shape (R, C).

    Returns:
        Rows and columns, shape (S, 2).
    """
    cells = np.argwhere(region)
    middle = cells.mean(axis=0)
    off = cells - middle
    angle = np.arctan2(off[:, 1], off[:, 0])
    away = np.hypot(*off.T)
    chosen = []
    for k in range(STATIONS):
        there = (
            np.abs((angle - 2.0 * np.pi * k / STATIONS + np.pi) % (2.0 * np.pi) - np.pi) < np.pi / STATIONS
        )
        if not there.any():
            continue
        ideal = PART * away[there].max()
        width = clearance[tuple(cells[there].T)]
        cost = np.abs(away[there] - ideal) * SIDE - 1.5 * np.minimum(width, 1.0)
        chosen.append(cells[there][int(np.argmin(cost))])
    return np.array(chosen).reshape(-1, 2)


def _joined(clearance: Float, region: Bool, stations: Int) -> Int:
    """Return the cheapest path from station to station and back to the first; narrow cells are expensive, and
    detours along the same cells are removed.

    Args:
        clearance: Distance of each cell to the next obstacle, shape (R, C) [m], above 0 in the region.
        region: Connected cells that the robot can reach, shape (R, C).
        stations: Rows and columns of the stations, in the region, shape (S, 2).

    Returns:
        Rows and columns of the cells of the path, shape (N, 2).
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    number = np.full(region.shape, -1)
    number[region] = np.arange(int(region.sum()))
    starts, ends, costs = [], [], []
    for step in ((1, 0), (0, 1), (1, 1), (1, -1)):
        a = np.argwhere(region)
        b = a + step
        good = ((b >= 0) & (b < region.shape)).all(axis=1)
        a, b = a[good], b[good]
        good = region[tuple(b.T)]
        a, b = a[good], b[good]
        narrow = 1.0 / np.minimum(clearance[tuple(a.T)], clearance[tuple(b.T)])
        starts.append(number[tuple(a.T)])
        ends.append(number[tuple(b.T)])
        costs.append(np.hypot(*step) * (1.0 + narrow**2))
    n = int(region.sum())
    graph = coo_array((np.concatenate(costs), (np.concatenate(starts), np.concatenate(ends))), shape=(n, n))
    at = number[tuple(stations.T)]
    before = dijkstra(graph.tocsr(), directed=False, indices=at, return_predecessors=True)[1]
    cells = np.argwhere(region)
    way = []
    for k in range(len(at)):
        part, here = [], int(at[(k + 1) % len(at)])
        while here != at[k]:
            part.append(here)
            here = int(before[k, here])
        way += part[::-1]
    # Remove detours into a corner and back along the same cells.
    kept: list[int] = []
    for cell in way:
        if len(kept) >= 2 and kept[-2] == cell:
            kept.pop()
        else:
            kept.append(cell)
    return cells[kept]
