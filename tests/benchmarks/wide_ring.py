"""A wide ring through a stand and over a field without trees, with a systematic error of the wheel odometry.

When the robot returns to the known trees, the error of the path exceeds the distance between trees. The scans
are detected stems, which the mapper processes as usual.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.config import Parameters, preset
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.mapper import Mapper
from pipeline.types.records import Float, Frame, Scan, Sensor, Stems, Step

STRIDE, REACH, SIGMA = 0.4, 15.0, 0.04  # m
HALF = 14.0  # m to both sides of the path
SENSOR = Sensor("stems", rings=0, ring_step=0.0, azimuth_step=0.0, range_sigma=SIGMA)
NS = 100_000_000


@dataclass(frozen=True, slots=True)
class WideRing:
    """Parameters of the drive.

    Attributes:
        radius: Radius [m]; density: trees per square metre; laps: number of laps.
        field: Section without trees, as fractions of a lap.
        longer, bias: Errors of the wheel odometry: excess length per metre, and excess rotation per metre
        [rad].
    """

    radius: float = 45.0
    density: float = 0.02
    laps: float = 1.3
    field: tuple[float, float] = (0.35, 0.85)
    longer: float = 0.02
    bias: float = 0.002

    def trees(self, random: np.random.Generator) -> Float:
        """Positions of the trees, shape (N, 2) [m], none on the path; the first pose is the origin."""
        places: list[Float] = []
        share = 1.0 - (self.field[1] - self.field[0])
        while len(places) < int(share * self.density * 4.0 * np.pi * self.radius * HALF):
            angle = random.uniform(0.0, 2.0 * np.pi)
            r = self.radius + random.uniform(-HALF, HALF)
            place = np.array([r * np.sin(angle), self.radius - r * np.cos(angle)])
            in_field = self.field[0] < angle / (2.0 * np.pi) < self.field[1]
            apart = not in_field and all(np.hypot(*(place - other)) > 1.5 for other in places)
            if apart and abs(r - self.radius) > 0.8:
                places.append(place)
        return np.array(places)

    def steps(self, seed: int) -> Iterator[tuple[Step, Pose2]]:
        """Each scan and the true pose."""
        random = np.random.default_rng([9, seed])
        trees = self.trees(random)
        stride = Pose2(STRIDE, 0.0, STRIDE / self.radius)
        truth, odometry = Pose2(), Pose2()
        for k in range(int(self.laps * 2.0 * np.pi * self.radius / STRIDE)):
            if k:
                truth = truth @ stride
                x, y, yaw = random.standard_normal(3) * [0.02, 0.02, 0.005]
                turn = stride.yaw + self.bias * STRIDE + yaw
                odometry = odometry @ Pose2(STRIDE * (1.0 + self.longer) + x, y, turn)
            centre = truth.inverse().apply(trees)
            centre = centre[np.hypot(centre[:, 0], centre[:, 1]) < REACH]
            n = len(centre)
            points = np.zeros((n, 3), np.float32)
            points[:, :2] = centre + random.normal(0.0, SIGMA, centre.shape)
            stems = Stems(np.tile([0.0, 0.0, 1.0], (n, 1)), np.full(n, 0.3))
            yield (
                Step(
                    k,
                    Scan(1 + k * NS, points, stems=stems),
                    odometry,
                    tilt_known=True,
                    elapsed_ns=k * NS,
                    period_ns=NS,
                ),
                truth,
            )


@dataclass(frozen=True, slots=True, eq=False)
class Mapped:
    """Result: the mapper, all frames, and the true pose, shape (N, 3), at each scan."""

    mapper: Mapper
    frames: list[Frame]
    truth: Float

    def errors(self) -> Float:
        """Position errors of the final path, shape (N,) [m]."""
        path = self.mapper.path
        error: Float = np.hypot(path.x - self.truth[:, 0], path.y - self.truth[:, 1])
        return error

    def told(self) -> Float:
        """Position errors of the pose reported at each scan, shape (N,) [m]."""
        told = np.array([frame.estimate.T_map_base.as_array() for frame in self.frames])
        error: Float = np.hypot(*(told - self.truth)[:, :2].T)
        return error

    def closed(self) -> list[int]:
        """The scans at which a loop was closed."""
        return [f.index for f in self.frames if any("loop closed" in word for word in f.warnings)]


def mapped(ring: WideRing, seed: int, parameters: Parameters | None = None) -> Mapped:
    """Map the drive."""
    p = preset("stems") if parameters is None else parameters
    mapper = Mapper(p, sensor=SENSOR, T_base_lidar=Pose3.identity(), seed=seed)
    frames, truth = [], []
    for step, pose in ring.steps(seed):
        frames.append(mapper.process(step))
        truth.append(pose.as_array())
    return Mapped(mapper, frames, np.array(truth))
