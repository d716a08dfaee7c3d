"""Virtual scanning: a simulated robot drives through the real cloud of a plot, with exact truth of its pose.

Bark, branches and undergrowth are those that a scanner saw; the LiDAR, its noise, the wheels and the
inertial unit are those of every simulated run.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.inventory import find_ground
from pipeline.inventory.cloud import Cloud
from pipeline.inventory.terrain_raster import HeightMap
from pipeline.simulation import run as simulated
from pipeline.simulation.inertial import inertial_readings
from pipeline.simulation.lidar import SpinningLidar, Sweep
from pipeline.simulation.motion import lay_on_terrain
from pipeline.simulation.primitives import SolidsBuilder
from pipeline.simulation.receiver import pack_returns
from pipeline.simulation.route_planning import loop_through
from pipeline.simulation.run import MOUNTING, SimulatedRun, odometry_of, stream
from pipeline.simulation.scene import Scene
from pipeline.simulation.surfels import Surfels, first_surfels, lay_surfels
from pipeline.simulation.terrain import Terrain
from pipeline.simulation.trajectory import drive_course, lap_time, lay_course
from pipeline.simulation.uri import RunRequest
from pipeline.types.records import Float, Float32, Scan, TruthTrees

# Raise it with every change that changes the bytes of runs through clouds and of no others.
VERSION = 3
SLOPE = 35.0  # degrees; of the terrain against the plane of the plot
BAND = (-0.5, 40.0)  # m above the ground; noise below it is not scanned
MOST = 1 << 20  # points after thinning
SPEED = 0.6  # m/s
SHORTEST, LONGEST = 10.0, 600.0  # s; of one loop, unless a duration is asked for
SHADE = 60.0  # reflectance of all returns: clouds have none that means the same


@dataclass(frozen=True, slots=True, eq=False)
class PlotGround:
    """The ground of a plot in the frame of the robot's first pose (see `Terrain.evaluate`)."""

    height: HeightMap
    start: Float
    yaw: float

    def evaluate(self, x: Float, y: Float) -> Float:
        """Height, dz/dx and dz/dy at places of shape (N,) [m]; shape (N, 3)."""
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
        warnings: What a person should know.
    """

    surfels: Surfels
    source_digest: str
    warnings: tuple[str, ...]

    def sweep(self, k: int) -> Sweep:
        """Scan k (from 0), the same whether or not others were made before it."""
        lidar = self.lidar
        begin = k * lidar.period_ns
        times = (begin + lidar.column_offsets_ns().astype(np.int64)) / 1e9
        R, o = self.motion.sensor_at(times, self.T_base_lidar)
        beams = lidar.beams()
        ranges = first_surfels(
            self.surfels.points,
            self.surfels.normals,
            self.surfels.radius,
            self.surfels.blocks,
            R,
            o,
            beams,
            lidar.lowest,
            lidar.ring_step,
            lidar.range_max,
        )
        noise = stream(simulated.SCAN, self.request, k).standard_normal(ranges.shape)
        reported = ranges + lidar.range_sigma * noise
        reported[~((reported >= lidar.range_min) & (reported <= lidar.range_max))] = 0.0
        shade, nobody = np.full(ranges.shape, SHADE), np.full(ranges.shape, -1, np.int32)
        points, reflectance, ring, offset_ns, solid = pack_returns(
            reported, shade, nobody, beams, lidar.column_offsets_ns()
        )
        return Sweep(Scan(simulated.START_NS + begin, points, reflectance, ring, offset_ns), solid)

    def digest(self) -> str:
        """SHA-256 (hex) of all that decides the run's bytes."""
        mounting = [*self.T_base_lidar.R.ravel().tolist(), *self.T_base_lidar.t.tolist()]
        asked = (self.request.seed, self.request.sigma, self.request.odometry, self.request.duration_s)
        version = f"{simulated.VERSION}.{VERSION}"
        text = f"stemmap cloud {version}; {asked}; {self.source_digest}; {mounting}"
        return hashlib.sha256(text.encode()).hexdigest()


def open_cloud_run(
    request: RunRequest, cloud: Cloud, trees: TruthTrees | None, T_base_lidar: Pose3 | None = None
) -> CloudRun:
    """Lay a way through a cloud and drive it; no scan is made yet.

    Args:
        request: What was asked for; a duration of 0 means one loop.
        cloud: Of the plot.
        trees: That stand in it, in the coordinates of the cloud.
        T_base_lidar: Mounting; None means that of every simulated robot.

    Raises:
        SourceError: It cannot be read, or leaves no way for a robot.
    """
    ground, near, _ = find_ground(cloud, SLOPE, band=BAND, most=MOST)
    points = near.points
    if len(points) == 0:
        raise SourceError("the cloud has no points", where=cloud.description.uri)
    way = loop_through(points, ground, cloud.description.uri)
    course = lay_course(way, closed=True)
    heading = _heading(way)
    start = np.append(way[0], ground.at(way[:1, 0], way[:1, 1]))
    lap = float(np.ceil(lap_time(course, SPEED)))
    duration = request.duration_s or min(max(lap, SHORTEST), LONGEST)
    asked = RunRequest(request.name, request.seed, request.sigma, request.odometry, duration, 0)
    drive = drive_course(course, SPEED, duration)
    motion = lay_on_terrain(drive, PlotGround(ground, start, heading), stream(simulated.SHAKE, asked))
    return CloudRun(
        request=asked,
        T_base_lidar=MOUNTING if T_base_lidar is None else T_base_lidar,
        lidar=SpinningLidar(range_sigma=asked.sigma),
        scene=_scene(trees, cloud.description.offset + start, heading),
        motion=motion,
        odometry=odometry_of(motion, asked),
        inertial=inertial_readings(motion, stream(simulated.INERTIAL, asked)),
        scans=round(duration * 1e9) // SpinningLidar().period_ns,
        surfels=lay_surfels(_from(points[:, :3], start, heading)),
        source_digest=cloud.description.digest,
        warnings=_cut_short(course.s[-1], lap) if lap > LONGEST and not request.duration_s else (),
    )


def _cut_short(way: float, lap: float) -> tuple[str]:
    drives = f"duration={lap:.0f} drives all of it" if lap <= 3600.0 else "duration=3600 drives most of it"
    return (f"the loop through the plot is {way:.0f} m long, of which {LONGEST:.0f} s are driven: {drives}",)


def _heading(way: Float) -> float:
    """Direction in which the smooth line through a closed row of waypoints leaves the first [rad]."""
    from scipy.interpolate import CubicSpline

    knots = np.vstack([way, way[:1]])
    chord = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(knots, axis=0).T))])
    ahead = CubicSpline(chord, knots, bc_type="periodic")(0.0, 1)
    return float(np.arctan2(ahead[1], ahead[0]))


def _from(points: Float32, start: Float, yaw: float) -> Float32:
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    seen: Float32 = ((points - start) @ R.T).astype(np.float32)
    return seen


def _scene(trees: TruthTrees | None, start: Float, yaw: float) -> Scene:
    """Nothing but the truth: what stands there is in the surfels."""
    none = np.zeros(0)
    truth = TruthTrees(none, none, none, ())
    if trees is not None:
        c, s = np.cos(yaw), np.sin(yaw)
        x, y = trees.x - start[0], trees.y - start[1]
        truth = TruthTrees(c * x + s * y, c * y - s * x, trees.dbh, trees.kind)
    return Scene(
        terrain=Terrain(np.zeros((1, 4))),
        still=SolidsBuilder().build(),
        persons=(),
        trees=(),
        truth=truth,
        kinds=(),
    )
