"""Drives with detected stems and faults, as records of a source."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.config import Parameters, preset
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.types.records import Float, Odometry, PoseMeasurement, Record, Scan, Sensor, Stems

MS = 1_000_000
KNOWN, AFTER = 40, 55  # scans before the fault, and since it began
REACH, SIGMA = 9.0, 0.03  # m
SENSOR = Sensor("stems", rings=0, ring_step=0.0, azimuth_step=0.0, range_sigma=SIGMA)
GAP_MS = 60_000


def parameters(**changes: object) -> Parameters:
    """Parameters for stems with a position error of SIGMA, and the odometry noise of the preset forest."""
    forest = preset("forest").slam
    own = {
        "detection.sigma_range": SIGMA,
        "slam.noise_distance": forest.noise_distance,
        "slam.noise_turn_distance": forest.noise_turn_distance,
        "slam.weight_power": forest.weight_power,
    }
    return preset("stems").replace(own | changes)


@dataclass(frozen=True, slots=True)
class Place:
    """A stand and the step of the robot per scan; trees per square metre, at least `apart` [m] from each
    other."""

    stride: Pose2
    density: float
    apart: float = 1.5

    def path(self, push: Pose2 | None = None) -> list[Pose2]:
        """True poses; `push` is the motion of the robot to the scan of the fault."""
        poses = [Pose2()]
        for k in range(1, KNOWN + AFTER):
            poses.append(poses[-1] @ (push if push is not None and k == KNOWN else self.stride))
        return poses

    def trees(self, seed: int) -> Float:
        """Positions of the trees, shape (N, 2) [m]: none on the path, but all around it and around the end of
        a push."""
        rng = np.random.default_rng([5, seed])
        way = np.array([[p.x, p.y] for p in self.path()])
        low, high = way.min(axis=0) - 13.0, way.max(axis=0) + 13.0
        places: list[Float] = []
        while len(places) < int(self.density * np.prod(high - low)):
            place = rng.uniform(low, high)
            apart = all(np.hypot(*(place - other)) > self.apart for other in places)
            if apart and np.hypot(*(way - place).T).min() > 0.8:
                places.append(place)
        return np.array(places)


PLACES = {
    "stand": Place(Pose2(0.1), 0.1),
    "at 3 m/s": Place(Pose2(0.3), 0.1),
    "few trees": Place(Pose2(0.1), 0.03),
    "dense": Place(Pose2(0.1), 0.2, 1.0),
    "a circle": Place(Pose2(0.2, 0.0, 0.025), 0.1),
}


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A drive in a place with a fault: all trees, true poses, and the records."""

    trees: Float
    truth: list[Pose2]
    records: list[Record]

    def error(self, k: int, told: Pose2) -> float:
        """Return the position error at scan k [m]."""
        return float(np.hypot(told.x - self.truth[k].x, told.y - self.truth[k].y))

    def false_trees(self, place: Float, drift: float) -> int:
        """Return the number of positions, shape (T, 2) [m], without a tree, or with a tree that has another
        position already; the offset of the map is at most `drift` [m]."""
        away = np.hypot(*(place[:, None] - self.trees[None]).transpose(2, 0, 1))
        near = away.argmin(axis=1)[away.min(axis=1, initial=np.inf) < 0.3 + drift]
        return len(place) - len(np.unique(near))


Told = Sequence[Pose2 | None]


def drive(place: Place, seed: int, trouble: Trouble) -> Drive:
    """Return a drive through a place with a fault."""
    rng = np.random.default_rng([6, seed])
    trees, truth = place.trees(seed), place.path(trouble.push)
    told = trouble.wheels(_wheels(truth, rng, trouble.push))
    records: list[Record] = []
    for k, (pose, odometry) in enumerate(zip(truth, told, strict=True)):
        stamp = k * 100 + (trouble.pause_ms if k >= KNOWN else 0)
        if odometry is not None:
            records.append(reading(stamp, odometry))
        found = pose.inverse().apply(trees)
        found = found[np.hypot(*found.T) < REACH]
        n = len(found)
        points = np.zeros((n, 3), np.float32)
        points[:, :2] = found + rng.normal(0.0, SIGMA, found.shape)
        stems = Stems(np.tile([0.0, 0.0, 1.0], (n, 1)), np.full(n, 0.3))
        records.append(Scan(stamp * MS, points, stems=stems))
    return Drive(trees, truth, trouble.arrival(records))


def reading(stamp_ms: int, pose: Pose2) -> Odometry:
    """Return an odometry reading."""
    place = np.array([pose.x, pose.y, 0.0])
    T = Pose3(np.eye(3), place) if np.isnan(pose.x) else Pose3.from_euler(place, 0.0, 0.0, pose.yaw)
    return Odometry(stamp_ms * MS, T)


def _wheels(truth: list[Pose2], rng: np.random.Generator, push: Pose2 | None) -> list[Pose2]:
    """Return the readings of odometry without faults; they do not contain a push."""
    told = [Pose2()]
    for k in range(1, len(truth)):
        step = truth[k - 1].inverse() @ truth[k]
        if push is not None and k == KNOWN:
            step = Pose2()
        way = np.hypot(step.x, step.y) ** 0.5
        noise = rng.standard_normal(3) * [0.02 * way, 0.02 * way, np.radians(0.3) * way]
        told.append(told[-1] @ Pose2(step.x + noise[0], step.y + noise[1], step.yaw + noise[2]))
    return told


def _as_they_are(told: Sequence[Pose2]) -> Told:
    return told


def _in_order(records: list[Record]) -> list[Record]:
    return records


@dataclass(frozen=True, slots=True)
class Trouble:
    """A fault from scan KNOWN on.

    Attributes:
        wheels: Returns the readings with the fault from those without faults; None for no reading.
        push: Motion of the robot that the odometry does not report, or None.
        pause_ms: Time without records before the scan of the fault [ms].
        arrival: Returns the records as they arrive from those in order.
        said: Part of a warning at the scan of the fault or soon after; without `once`, of all scans since
        then.
        state: State of the pose quality then; "good" if the fault does not affect the map.
        soon: Number of scans within which both are reported.
        from_start: Whether the fault begins at the first scan.
        may_be_lost: Whether the robot may be lost at the end.
    """

    wheels: Callable[[Sequence[Pose2]], Told] = _as_they_are
    push: Pose2 | None = None
    pause_ms: int = 0
    arrival: Callable[[list[Record]], list[Record]] = _in_order
    said: str = ""
    once: bool = True
    state: str = "weak"
    soon: int = 1
    from_start: bool = False
    may_be_lost: bool = False


def _from(change: Callable[[Pose2], Pose2 | None]) -> Callable[[Sequence[Pose2]], Told]:
    """Return the change of all readings since scan KNOWN."""
    return lambda told: [p if k < KNOWN else change(p) for k, p in enumerate(told)]


def _stuck(first: int, scans: int) -> Callable[[Sequence[Pose2]], Told]:
    """Readings that do not change for a number of scans, and continue from there."""

    def stuck(told: Sequence[Pose2]) -> Told:
        last = min(first + scans, len(told)) - 1
        T = told[first] @ told[last].inverse()
        return [*told[:first], *([told[first]] * scans), *(T @ p for p in told[last + 1 :])][: len(told)]

    return stuck


def _restarted(told: Sequence[Pose2]) -> Told:
    T = told[KNOWN].inverse()
    return [*told[:KNOWN], *(T @ p for p in told[KNOWN:])]


def _again(records: list[Record]) -> list[Record]:
    """Every fifth scan arrives twice."""
    return [r for k, one in enumerate(records) for r in ([one, one] if k % 10 == 1 else [one])]


def _late(records: list[Record]) -> list[Record]:
    """One scan arrives half a second late, after five others."""
    at = 2 * KNOWN + 1
    return [*records[:at], *records[at + 1 : at + 11], records[at], *records[at + 11 :]]


def _swapped(records: list[Record]) -> list[Record]:
    """Two scans arrive in the wrong order."""
    at = 2 * KNOWN + 1
    return [*records[:at], records[at + 2], records[at + 1], records[at], *records[at + 3 :]]


def _back_in_time(records: list[Record]) -> list[Record]:
    """An odometry reading with a stamp one second earlier and a position error of 9 m."""
    at = 2 * KNOWN + 2
    return [*records[:at], reading(KNOWN * 100 - 1000, Pose2(9.0)), *records[at:]]


def _bad_covariance(records: list[Record]) -> list[Record]:
    """A pose of another source with an error of 9 m and an invalid covariance."""
    at = 2 * KNOWN
    pose = PoseMeasurement(KNOWN * 100 * MS, Pose2(9.0, 9.0, 1.0), np.diag([1.0, 1.0, -1.0]))
    return [*records[:at], pose, *records[at:]]


LEFT_OUT_SCANS = "scans that were not later than the one before"
TROUBLES = {
    "odometry ends": Trouble(_from(lambda _: None), said="there is no odometry", once=False, soon=4),
    "no odometry at all": Trouble(
        lambda told: [None] * len(told), said="there is no odometry", once=False, soon=3, from_start=True
    ),
    "stuck": Trouble(_stuck(KNOWN, 2 * AFTER), said="it is stuck", once=False, soon=4),
    "stuck for two seconds": Trouble(_stuck(KNOWN, 20), said="it is stuck", soon=4),
    "stuck from the start": Trouble(
        _stuck(0, KNOWN + AFTER), said="it is stuck", once=False, soon=3, from_start=True
    ),
    "jump of 0.5 m": Trouble(
        _from(lambda p: Pose2(p.x + 0.5, p.y, p.yaw)), said="the trees contradict the odometry"
    ),
    "jump of 5 m": Trouble(_from(lambda p: Pose2(p.x + 5.0, p.y, p.yaw)), said="the odometry jumped by"),
    "jump of 50 m": Trouble(_from(lambda p: Pose2(p.x + 50.0, p.y, p.yaw)), said="the odometry jumped by"),
    "flip of the yaw": Trouble(
        _from(lambda p: Pose2(-p.x, -p.y, p.yaw + np.pi)), said="degrees; the jump is not used as motion"
    ),
    "NaN": Trouble(_from(lambda p: Pose2(float("nan"), p.y, p.yaw)), said="without finite numbers", soon=6),
    "negative time step": Trouble(
        arrival=_back_in_time, said="odometry readings that were not later", state="good", soon=2
    ),
    "covariance not positive definite": Trouble(
        arrival=_bad_covariance, said="positive definite", state="good", soon=2
    ),
    "scans twice": Trouble(arrival=_again, said=LEFT_OUT_SCANS, state="good", soon=6),
    "a late scan": Trouble(arrival=_late, said=LEFT_OUT_SCANS, state="good", soon=8),
    "scans out of order": Trouble(arrival=_swapped, said=LEFT_OUT_SCANS, state="good", soon=3),
    "gap, driven on": Trouble(pause_ms=GAP_MS, said="no scan for 60 s"),
    "gap, pushed": Trouble(push=Pose2(2.0, 0.3, 0.1), pause_ms=GAP_MS, said="no scan for 60 s"),
    "gap, odometry restarts": Trouble(_restarted, pause_ms=GAP_MS, said="no scan for 60 s", may_be_lost=True),
    "kidnapped": Trouble(
        push=Pose2(3.0, 3.0, 2.0),
        said="the robot is lost",
        state="lost",
        soon=5,
        may_be_lost=True,
    ),
}
