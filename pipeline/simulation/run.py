"""A whole simulated run: every sensor at any time, each scan alone as well as in order."""

from __future__ import annotations

import hashlib
import zlib
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.simulation.inertial import IMU_HZ, Inertial, inertial_readings
from pipeline.simulation.lidar import SpinningLidar, Sweep, sweep_scene
from pipeline.simulation.motion import Motion, lay_on_terrain
from pipeline.simulation.obstacle_aware_driver import ObeyingDrive
from pipeline.simulation.odometry_quality import QUALITIES
from pipeline.simulation.scene import Scene, build_scene
from pipeline.simulation.trajectory import RATE_HZ, drive_course, lay_course
from pipeline.simulation.uri import EXACT, RunRequest
from pipeline.simulation.wheels import ODOMETRY_HZ, wheel_odometry
from pipeline.types.records import Float, Imu, Int, Odometry, TruthPath

# Raise it with every change that changes a run's bytes.
VERSION = 1
START_NS = 1_700_000_000_000_000_000
MOUNTING = Pose3(np.eye(3), np.array([0.1, 0.0, 0.8]))
SCENE, SHAKE, WHEELS, INERTIAL, SCAN, SENSE = range(6)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRun:
    """A run that was opened; nothing in it changes.

    Attributes:
        request: What was asked for.
        T_base_lidar: Mounting of the LiDAR on the base, which lies on the ground.
        lidar: The sensor.
        scene: What the robot drives through.
        motion: Where it truly is.
        odometry: x, y [m], yaw [rad] by the wheels at 50 Hz, shape (N, 3).
        inertial: The inertial unit at 100 Hz.
        scans: Number of scans.
    """

    request: RunRequest
    T_base_lidar: Pose3
    lidar: SpinningLidar
    scene: Scene
    motion: Motion
    odometry: Float
    inertial: Inertial
    scans: int

    def scan_stamps(self) -> Int:
        """Stamps of all scans [ns], int64, shape (N,)."""
        return START_NS + np.arange(self.scans, dtype=np.int64) * self.lidar.period_ns

    def sweep(self, k: int) -> Sweep:
        """Scan k (from 0), the same whether or not others were made before it."""
        begin = k * self.lidar.period_ns
        times = (begin + self.lidar.column_offsets_ns().astype(np.int64)) / 1e9
        R, o = self.motion.sensor_at(times, self.T_base_lidar)
        rng = stream(SCAN, self.request, k)
        solids = self.scene.solids_at(times, R, o)
        return sweep_scene(self.lidar, solids, self.scene.terrain, R, o, START_NS + begin, rng)

    def odometry_record(self, n: int) -> Odometry:
        """Reading n of the odometry."""
        t_ns = n * (1_000_000_000 // ODOMETRY_HZ)
        if self.request.odometry == EXACT:
            R, p = self.motion.at(np.array([t_ns / 1e9]))
            return Odometry(START_NS + t_ns, Pose3(R[0], p[0]))
        x, y, yaw = self.odometry[n]
        return Odometry(START_NS + t_ns, Pose3.from_euler(np.array([x, y, 0.0]), 0.0, 0.0, yaw))

    def imu_record(self, n: int) -> Imu:
        """Reading n of the inertial unit."""
        stamp = START_NS + n * (1_000_000_000 // IMU_HZ)
        unit = self.inertial
        return Imu(stamp, unit.angular_velocity[n], unit.linear_acceleration[n], unit.orientation(n))

    def true_path(self) -> TruthPath:
        """The true pose of the base at the stamp of each scan, in the frame of the map."""
        rows = np.arange(self.scans) * (RATE_HZ * self.lidar.period_ns // 1_000_000_000)
        d = self.motion.drive
        yaw = (d.yaw[rows] + np.pi) % (2.0 * np.pi) - np.pi
        return TruthPath(self.scan_stamps(), d.x[rows], d.y[rows], yaw, same_frame=True)

    def digest(self) -> str:
        """SHA-256 (hex) of all that decides the run's bytes."""
        mounting = [*self.T_base_lidar.R.ravel().tolist(), *self.T_base_lidar.t.tolist()]
        text = f"stemmap simulation {VERSION}; {self.request}; {self.request.scenario}; {mounting}"
        text += f"; drive {self.request.drive}" if self.request.drive else ""  # the first is as it was before
        text += "; obeys" if self.request.obeys else ""
        crossings = self.request.scenario.crossings
        text += f"; crossings {crossings}" if crossings else ""
        return hashlib.sha256(text.encode()).hexdigest()


def open_run(request: RunRequest, T_base_lidar: Pose3 | None = None) -> SimulatedRun:
    """Build the scene and drive through it; no scan is made yet.

    Raises:
        SourceError: The scene has no place for so many trees.
    """
    scenario = request.scenario
    lidar = SpinningLidar(range_sigma=request.sigma)
    course = lay_course(np.array(scenario.waypoints), scenario.closed)
    scene = build_scene(scenario, course, stream(SCENE, request))
    mounting = MOUNTING if T_base_lidar is None else T_base_lidar
    if request.obeys:
        own = stream(SENSE, request)
        obeying = ObeyingDrive(course, scenario.speed, scene, mounting, int(own.integers(2**31)))
        drive = obeying.run(request.duration_s)
    else:
        drive = drive_course(course, scenario.speed, request.duration_s)
    motion = lay_on_terrain(drive, scene.terrain, stream(SHAKE, request))
    return SimulatedRun(
        request=request,
        T_base_lidar=mounting,
        lidar=lidar,
        scene=scene,
        motion=motion,
        odometry=odometry_of(motion, request),
        inertial=inertial_readings(motion, stream(INERTIAL, request)),
        scans=round(request.duration_s * 1e9) // lidar.period_ns,
    )


def odometry_of(motion: Motion, request: RunRequest) -> Float:
    """x, y [m] and yaw [rad] by wheels of the quality that was asked for, at 50 Hz, shape (N, 3)."""
    if request.odometry == EXACT:
        drive = motion.drive
        return np.stack([drive.x, drive.y, drive.yaw], axis=1)[:: RATE_HZ // ODOMETRY_HZ]
    return wheel_odometry(motion, QUALITIES[request.odometry], stream(WHEELS, request))


def stream(part: int, request: RunRequest, k: int = 0) -> np.random.Generator:
    """A generator of its own for each part, scan and drive, so that none shifts the numbers of another; the
    scene is the same for all drives."""
    drive = [request.drive] if request.drive and part != SCENE else []
    return np.random.default_rng([part, zlib.crc32(request.name.encode()), request.seed, k, *drive])
