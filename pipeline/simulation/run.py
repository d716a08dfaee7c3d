"""A simulated run: the readings of every sensor at any time; each scan is independent of the others. With the
option of the scenario, the robot slows down and stops for obstacles in its path, by the obstacle detection of
the pipeline."""

from __future__ import annotations

import hashlib
import zlib
from dataclasses import dataclass, replace

import numpy as np

from pipeline.config import Parameters
from pipeline.front_end import segment
from pipeline.geometry.poses import Pose2, Pose3, wrap_angle
from pipeline.simulation.lidar import SpinningLidar, Sweep, sweep_scene
from pipeline.simulation.lidar_models import LIDARS
from pipeline.simulation.robot_motion import (
    IMU_HZ,
    ODOMETRY_HZ,
    RATE_HZ,
    Course,
    Drive,
    Inertial,
    TerrainModel,
    TrueMotion,
    drive_course,
    inertial_readings,
    lay_course,
    lay_on_terrain,
    on_course,
    speed_limit,
    wheel_odometry,
)
from pipeline.simulation.scenarios import EXACT, QUALITIES, WILD, RunRequest
from pipeline.simulation.scene import SimulatedScene, build_scene
from pipeline.simulation.terrain import WheelContact
from pipeline.simulation.wild_scenes import build_wild_scene, truth_in_view
from pipeline.types.records import Float, Imu, Odometry, Step, TruthPath, TruthTrees, Zone

# Raise it with every change that changes the bytes of a run.
VERSION = 1
START_NS = 1_700_000_000_000_000_000
MOUNTING = Pose3(np.eye(3), np.array([0.1, 0.0, 0.8]))
SCENE, SHAKE, WHEELS, INERTIAL, SCAN, SENSE = range(6)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRun:
    """An open simulated run; it does not change.

    Attributes:
        request: Requested scenario and options.
        T_base_lidar: Extrinsics of the LiDAR; the base is on the ground.
        lidar: The sensor.
        scene: SimulatedScene through which the robot drives.
        motion: True motion of the robot.
        odometry: Pose x, y [m], yaw [rad, not wrapped] by the wheels at 50 Hz, shape (N, 3).
        inertial: Readings of the IMU at 100 Hz.
        scans: Number of scans.
    """

    request: RunRequest
    T_base_lidar: Pose3
    lidar: SpinningLidar
    scene: SimulatedScene
    motion: TrueMotion
    odometry: Float
    inertial: Inertial
    scans: int

    def sensor_poses(self, k: int) -> tuple[Float, Float, Float]:
        """Return the poses of the LiDAR in scan k (from 0): time of each column since the start of the run,
        shape (C,) [s], rotations, shape (C, 3, 3), and positions, shape (C, 3) [m], in the world."""
        times = (k * self.lidar.period_ns + self.lidar.column_offsets_ns().astype(np.int64)) / 1e9
        return times, *self.motion.sensor_at(times, self.T_base_lidar)

    def sweep(self, k: int) -> Sweep:
        """Simulate scan k, 0 to `scans` - 1; the result does not depend on other scans, and is the same in
        each call."""
        times, R, o = self.sensor_poses(k)
        rng, stamp_ns = random_stream(SCAN, self.request, k), START_NS + k * self.lidar.period_ns
        solids = self.scene.solids_at(times, R, o)
        return sweep_scene(self.lidar.at_scan(k), solids, self.scene.terrain, R, o, stamp_ns, rng)

    def odometry_record(self, n: int) -> Odometry:
        """Return reading n of the odometry (50 Hz, from 0): the planar pose by the wheels, or, with the
        quality "exact", the true pose with height and tilt. A reading after the end of the motion raises an
        IndexError, with "exact" a ValueError."""
        t_ns = n * (1_000_000_000 // ODOMETRY_HZ)
        if self.request.odometry == EXACT:
            R, p = self.motion.at(np.array([t_ns / 1e9]))
            return Odometry(START_NS + t_ns, Pose3(R[0], p[0]))
        x, y, yaw = self.odometry[n]
        return Odometry(START_NS + t_ns, Pose3.from_euler(np.array([x, y, 0.0]), 0.0, 0.0, yaw))

    def imu_record(self, n: int) -> Imu:
        """Return reading n of the IMU (100 Hz, from 0), with its orientation. IndexError for a reading after
        the motion."""
        stamp = START_NS + n * (1_000_000_000 // IMU_HZ)
        unit = self.inertial
        return Imu(stamp, unit.angular_velocity[n], unit.linear_acceleration[n], unit.orientation(n))

    def true_trees(self) -> TruthTrees:
        """Return the objects of the ground truth in the frame of the map. In `sim:wild`, trees out of view
        are HIDDEN; this casts the rays of one scan per second of the run in each call."""
        if self.request.name != WILD:
            return self.scene.truth
        poses = (self.sensor_poses(k) for k in range(0, self.scans, 1_000_000_000 // self.lidar.period_ns))
        return truth_in_view(self.lidar, self.scene, poses)

    def true_path(self) -> TruthPath:
        """Return the true pose of the base at the stamp of each scan, in the frame of the map, with the yaw
        in [-pi, pi)."""
        since_ns = np.arange(self.scans, dtype=np.int64) * self.lidar.period_ns
        rows = np.arange(self.scans) * (RATE_HZ * self.lidar.period_ns // 1_000_000_000)
        d = self.motion.drive
        yaw = wrap_angle(d.yaw[rows])
        return TruthPath(START_NS + since_ns, d.x[rows], d.y[rows], yaw, same_frame=True)

    def digest(self) -> str:
        """Return the SHA-256 (hex) of everything that decides the bytes of the run."""
        request, scenario = self.request, self.request.scenario
        # Annotations are stored under the digest, so its text has the two fields that a request once had.
        words = str(request).removesuffix(")") + ", file='', truth='')"
        text = f"stemmap simulation {VERSION}; {words}; {scenario}; {self._mounting()}"
        text += f"; drive {request.drive}" if request.drive else ""
        text += f"; lidar {request.lidar}" if request.lidar else ""
        text += "; obeys" if scenario.obeys else ""
        text += f"; crossings {scenario.crossings}" if scenario.crossings else ""
        return hashlib.sha256(text.encode()).hexdigest()

    def _mounting(self) -> list[float]:
        """Return the rotation (row by row) and the translation of the extrinsics as twelve numbers."""
        return [*self.T_base_lidar.R.ravel().tolist(), *self.T_base_lidar.t.tolist()]


def open_run(request: RunRequest, T_base_lidar: Pose3 | None = None) -> SimulatedRun:
    """Build the scene and drive through it; no scan is simulated yet.

    Args:
        request: A scenario with its options; not a run through a cloud (KeyError).
        T_base_lidar: Extrinsics of the LiDAR; None uses MOUNTING.

    Raises:
        SourceError: The scene has no space for so many trees or other objects.
    """
    scenario = request.scenario
    lidar = SpinningLidar(range_sigma=request.sigma)
    course = lay_course(np.array(scenario.waypoints), scenario.closed)
    ground: TerrainModel
    if request.name == WILD:
        lidar, scene = build_wild_scene(scenario, course, request.sigma, random_stream(SCENE, request))
        ground = WheelContact(scene.terrain)
    else:
        scene = build_scene(scenario, course, random_stream(SCENE, request))
        ground = scene.terrain
    if request.lidar:
        # The scene is that of the scenario with any sensor; two echoes are of spinning sensors.
        lidar = replace(LIDARS[request.lidar], range_sigma=request.sigma, dual=lidar.dual)
    mounting = MOUNTING if T_base_lidar is None else T_base_lidar
    if scenario.obeys:
        seed = int(random_stream(SENSE, request).integers(2**31))
        drive = obstacle_aware_drive(course, scenario.speed, scene, mounting, seed, request.duration_s)
    else:
        drive = drive_course(course, scenario.speed, request.duration_s)
    motion = lay_on_terrain(drive, ground, random_stream(SHAKE, request))
    return SimulatedRun(
        request=request,
        T_base_lidar=mounting,
        lidar=lidar,
        scene=scene,
        motion=motion,
        odometry=odometry_of(motion, request),
        inertial=inertial_readings(motion, random_stream(INERTIAL, request)),
        scans=round(request.duration_s * 1e9) // lidar.period_ns,
    )


def odometry_of(motion: TrueMotion, request: RunRequest) -> Float:
    """Return x, y [m] and yaw [rad, not wrapped] by wheels of the requested quality at 50 Hz, shape (N, 3);
    with "exact" the true planar pose."""
    if request.odometry == EXACT:
        drive = motion.drive
        return np.stack([drive.x, drive.y, drive.yaw], axis=1)[:: RATE_HZ // ODOMETRY_HZ]
    return wheel_odometry(motion, QUALITIES[request.odometry], random_stream(WHEELS, request))


def random_stream(part: int, request: RunRequest, k: int = 0) -> np.random.Generator:
    """Return a new random generator of a part of the run, or of scan k of that part.

    Each part, scan and drive has its own generator, so that none shifts the numbers of another. The part
    SCENE is equal for all drives.

    Args:
        part: SCENE, SHAKE, WHEELS, INERTIAL, SCAN or SENSE.
        request: Request, of which name, seed and drive are used.
        k: Number of the scan.
    """
    drive = [request.drive] if request.drive and part != SCENE else []
    return np.random.default_rng([part, zlib.crc32(request.name.encode()), request.seed, k, *drive])


#: Share of the speed in each zone.
SPEED = {Zone.CLEAR: 1.0, Zone.SLOW: 0.4, Zone.STOP: 0.0, Zone.UNKNOWN: 0.0}
_GAIN, _BRAKE = 0.5, 1.5  # m/s^2
#: A coarse sensor; it still sees obstacles within a few metres.
_LIDAR = SpinningLidar(columns=225)
_TICKS = RATE_HZ * _LIDAR.period_ns // 1_000_000_000  # per sweep


def obstacle_aware_drive(
    course: Course, speed: float, scene: SimulatedScene, T_base_lidar: Pose3, seed: int, duration_s: float
) -> Drive:
    """Drive a course one sweep at a time from rest; the clearance after a sweep, by the default parameters,
    decides the share SPEED of the speed in the next one. The robot stands during the first sweep. Each sweep
    is simulated with a coarse LiDAR.

    Args:
        course: The course, which is open; the robot stops at its end.
        speed: Speed on the straight [m/s].
        scene: The scene.
        T_base_lidar: Extrinsics of the LiDAR.
        seed: Random seed of the sensor.
        duration_s: Duration [s]; the result is a little longer.
    """
    limit, step = speed_limit(course, speed), 1.0 / RATE_HZ
    speeds, along = [0.0], [0.0]
    zone = Zone.STOP
    for k in range(int(np.ceil((duration_s + 0.5) * 1e9 / _LIDAR.period_ns)) + 1):
        share = SPEED[zone]
        v, s = speeds[-1], along[-1]
        for _ in range(_TICKS):
            wanted = share * float(np.interp(s, course.s, limit))
            wanted = min(wanted, float(np.sqrt(2.0 * _GAIN * max(course.s[-1] - s, 0.0))))
            v = min(max(wanted, v - _BRAKE * step), v + _GAIN * step)
            s += v * step
            speeds.append(v)
            along.append(s)
        latest = _drive(course, along, speeds, k * _TICKS)
        zone = _zone(latest, scene, T_base_lidar, seed, k)
    return _drive(course, along, speeds, 0)


def _drive(course: Course, along: list[float], speeds: list[float], first: int) -> Drive:
    """Return the drive along a course from tick `first` onwards, at RATE_HZ.

    Args:
        course: The course.
        along: Distance driven at each tick since the start [m].
        speeds: Speed at each tick [m/s].
        first: First tick.
    """
    t = np.arange(first, len(along)) / RATE_HZ
    return on_course(course, t, np.array(along[first:]), np.array(speeds[first:]))


def _zone(drive: Drive, scene: SimulatedScene, T_base_lidar: Pose3, seed: int, k: int) -> Zone:
    """Return the zone of obstacle detection, by the default parameters, after sweep k; CLEAR if there is no
    clearance.

    Args:
        drive: Motion during the sweep.
        scene: The scene.
        T_base_lidar: Pose of the sensor on the robot.
        seed: Random seed of vibration and noise.
        k: Number of the sweep.
    """
    # The same phases in each sweep, so that the pieces belong to one vibration.
    motion = lay_on_terrain(drive, scene.terrain, np.random.default_rng(seed))
    offsets = _LIDAR.column_offsets_ns() * 1e-9
    times = drive.t[0] + offsets
    R, o = motion.sensor_at(times - drive.t[0], T_base_lidar)
    solids = scene.solids_at(times, R, o)
    sweep = sweep_scene(_LIDAR, solids, scene.terrain, R, o, 0, np.random.default_rng([seed, k]))
    twist = (float(drive.speed[-1]), 0.0, float(drive.yaw_rate[-1]))
    tilt = (float(motion.roll[0]), float(motion.pitch[0]))
    step = Step(k, sweep.scan, Pose2(), *tilt, tilt_known=True, twist=twist)
    clearance = segment(step, _LIDAR.sensor, T_base_lidar, Parameters()).clearance
    return Zone.CLEAR if clearance is None else clearance.zone
