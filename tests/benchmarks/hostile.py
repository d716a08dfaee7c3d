"""Faulty recordings: simulated drives whose records or description are wrong, without any indication."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import Source, SourceDescription
from pipeline.types.records import Imu, Odometry, Record, Scan, Truth

S = 1_000_000_000
BEGIN_S = 15.0  # start of a fault that does not begin with the drive
Change = Callable[[list[Record]], list[Record]]


@dataclass(frozen=True, slots=True)
class Variant:
    """A fault of a recording.

    Attributes:
        records: Returns the faulty records from the correct ones; they arrive in the order of the list.
        mounting: Reported mounting T_base_lidar in place of the true one; None for the true one.
        kinds: What moves the robot: "wheels" (with an IMU), "imu" (LiDAR and IMU), "lidar" (LiDAR alone).
    """

    records: Change = lambda records: records
    mounting: Pose3 | None = None
    kinds: tuple[str, ...] = ("wheels", "imu", "lidar")


class HostileSource:
    """A source with a fault. Its records are stored in memory."""

    def __init__(self, source: Source, records: Sequence[Record], variant: Variant, *, kind: str) -> None:
        """Make the faulty records.

        Args:
            source: Source of the right records; stays open.
            records: Its records.
            variant: The fault.
            kind: Data of the recording besides scans, see `Variant`.
        """
        wheels, imu = kind == "wheels", kind != "lidar"
        absent = tuple(each for each, there in ((Odometry, wheels), (Imu, imu)) if not there)
        kept = [r for r in records if not isinstance(r, absent)]
        self._records = variant.records(kept)
        self._source = source
        known = source.description
        self.description: SourceDescription = replace(
            known,
            T_base_lidar=variant.mounting or known.T_base_lidar,
            has_odometry=wheels and known.has_odometry,
            has_imu=imu and known.has_imu,
            scans=None,
        )
        self.losses: dict[str, int] = {}

    def records(self) -> Iterator[Record]:
        """Yield the faulty records."""
        yield from self._records

    def truth(self) -> Truth | None:
        """Return the truth of the right source."""
        return self._source.truth()

    def close(self) -> None:
        """Do nothing: the right source stays open."""


def _scans(change: Callable[[Scan], Scan]) -> Change:
    """Return the change of all scans."""
    return lambda records: [change(r) if isinstance(r, Scan) else r for r in records]


def _odometry(change: Callable[[Odometry], Odometry]) -> Change:
    """Return the change of all readings of the odometry."""
    return lambda records: [change(r) if isinstance(r, Odometry) else r for r in records]


def _imu(R: np.ndarray, factor: float = 1.0) -> Change:
    """Return the change of all readings of the IMU: turned by R, shape (3, 3), turn rates times a factor."""
    turned = Pose3(R, np.zeros(3))

    def change(records: list[Record]) -> list[Record]:
        changed = list[Record]()
        for r in records:
            if isinstance(r, Imu):
                q = r.orientation
                if q is not None:
                    own = Pose3.from_quaternion(np.zeros(3), q) @ turned.inverse()
                    q = quaternion(own.R)
                r = replace(
                    r,
                    angular_velocity=factor * (R @ r.angular_velocity),
                    linear_acceleration=R @ r.linear_acceleration,
                    orientation=q,
                )
            changed.append(r)
        return changed

    return change


def quaternion(R: np.ndarray) -> np.ndarray:
    """Return the quaternion w, x, y, z of a rotation, shape (4,), in the order of `Imu.orientation`."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return np.array([w, x, y, z])


def _start_ns(records: Sequence[Record]) -> int:
    return min(r.stamp_ns for r in records)


def _later(kinds: type | tuple[type, ...], offset_s: float, begin_s: float = 0.0) -> Change:
    """Return the change of the stamps of some kinds of records, from a time on."""

    def change(records: list[Record]) -> list[Record]:
        begin = _start_ns(records) + round(begin_s * S)
        shift = round(offset_s * S)
        return [
            replace(r, stamp_ns=r.stamp_ns + shift) if isinstance(r, kinds) and r.stamp_ns >= begin else r
            for r in records
        ]

    return change


def _scaled(factor: float) -> Change:
    """Return the change of wheels that count a wrong distance."""
    return _odometry(lambda r: replace(r, T_odom_base=Pose3(r.T_odom_base.R, factor * r.T_odom_base.t)))


def _mirrored(records: list[Record]) -> list[Record]:
    """Wheels that turn the wrong way: y and yaw with the other sign."""
    mirror = np.diag([1.0, -1.0, 1.0])
    return _odometry(
        lambda r: replace(r, T_odom_base=Pose3(mirror @ r.T_odom_base.R @ mirror, mirror @ r.T_odom_base.t))
    )(records)


def _frozen(records: list[Record], seconds: float = 10.0) -> list[Record]:
    """The last reading is repeated for a time, and the odometry continues from there."""
    begin = _start_ns(records) + round(BEGIN_S * S)
    end, changed = begin + round(seconds * S), list[Record]()
    held: Pose3 | None = None
    T: Pose3 | None = None
    for r in records:
        if isinstance(r, Odometry):
            if begin <= r.stamp_ns < end:
                held = held or r.T_odom_base
                r = replace(r, T_odom_base=held)
            elif r.stamp_ns >= end and held is not None:
                T = T or held @ r.T_odom_base.inverse()
                r = replace(r, T_odom_base=T @ r.T_odom_base)
        changed.append(r)
    return changed


def _half_dropped(records: list[Record]) -> list[Record]:
    """Every second scan, by chance, is missing."""
    rng = np.random.default_rng(7)
    return [r for r in records if not isinstance(r, Scan) or rng.random() < 0.5]


def _twice(records: list[Record]) -> list[Record]:
    """Each scan arrives twice with the same stamp."""
    return [r for one in records for r in ([one, one] if isinstance(one, Scan) else [one])]


def _twice_restamped(records: list[Record]) -> list[Record]:
    """Each scan arrives again 50 ms later with a new stamp."""
    changed = list[Record]()
    for r in records:
        changed.append(r)
        if isinstance(r, Scan):
            changed.append(replace(r, stamp_ns=r.stamp_ns + S // 20))
    return sorted(changed, key=lambda r: r.stamp_ns)


def _shuffled(records: list[Record]) -> list[Record]:
    """Scans arrive in another order within windows of 1 s."""
    rng = np.random.default_rng(8)
    late = [r.stamp_ns + (round(rng.uniform(0.0, 1.0) * S) if isinstance(r, Scan) else 0) for r in records]
    return [records[k] for k in np.argsort(late, kind="stable")]


def _two_robots(records: list[Record]) -> list[Record]:
    """Two robots under the same topics: every second scan and reading is that of 20 s later."""
    other = [
        replace(r, stamp_ns=r.stamp_ns - 20 * S + S // 200)
        for r in records
        if r.stamp_ns >= _start_ns(records) + 20 * S
    ]
    return sorted([*records, *other], key=lambda r: r.stamp_ns)


def _points(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Return the change of the points of all scans."""
    return _scans(lambda r: replace(r, points=change(r.points).astype(np.float32)))


def _times(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Return the change of the point times of all scans that have them."""
    return _scans(
        lambda r: r if r.offset_ns is None else replace(r, offset_ns=change(r.offset_ns).astype(np.int32))
    )


def _after_each_other(*changes: Change) -> Change:
    def change(records: list[Record]) -> list[Record]:
        for each in changes:
            records = each(records)
        return records

    return change


_ABOUT_X_90 = Pose3.from_euler(np.zeros(3), np.pi / 2, 0.0, 0.0).R
_ABOUT_Z_90 = Pose3.from_euler(np.zeros(3), 0.0, 0.0, np.pi / 2).R
_UPSIDE_DOWN = np.array([1.0, -1.0, -1.0])
_AT = np.array([0.1, 0.0, 0.8])  # position of the LiDAR of simulated robots
ALL = (Scan, Odometry, Imu)

#: The variants by name. "none" is the run without a fault.
VARIANTS: dict[str, Variant] = {
    "none": Variant(),
    "wheel scale 1.1": Variant(_scaled(1.1), kinds=("wheels",)),
    "wheel scale 0.9": Variant(_scaled(0.9), kinds=("wheels",)),
    "odometry in mm": Variant(_scaled(1000.0), kinds=("wheels",)),
    "odometry mirrored": Variant(_mirrored, kinds=("wheels",)),
    "odometry frozen for 10 s": Variant(_frozen, kinds=("wheels",)),
    "gyro of the other sign": Variant(_imu(np.eye(3), -1.0), kinds=("wheels", "imu")),
    "gyro in degrees": Variant(_imu(np.eye(3), 180.0 / np.pi), kinds=("wheels", "imu")),
    "IMU turned by 90 degrees about x": Variant(_imu(_ABOUT_X_90), kinds=("wheels", "imu")),
    "IMU turned by 90 degrees about z": Variant(_imu(_ABOUT_Z_90), kinds=("wheels", "imu")),
    "odometry 0.5 s late": Variant(_later(Odometry, 0.5), kinds=("wheels",)),
    "odometry 0.5 s early": Variant(_later(Odometry, -0.5), kinds=("wheels",)),
    "LiDAR pitched by 10 degrees": Variant(mounting=Pose3.from_euler(_AT, 0.0, np.radians(10.0), 0.0)),
    "LiDAR turned by 10 degrees": Variant(mounting=Pose3.from_euler(_AT, 0.0, 0.0, np.radians(10.0))),
    "LiDAR turned by 90 degrees": Variant(mounting=Pose3.from_euler(_AT, 0.0, 0.0, np.pi / 2)),
    "LiDAR upside down": Variant(_points(lambda p: p * _UPSIDE_DOWN)),
    "LiDAR spinning the other way": Variant(_points(lambda p: p * np.array([1.0, -1.0, 1.0]))),
    "points in mm": Variant(_points(lambda p: p * 1000.0)),
    "point times from the end": Variant(_times(lambda t: t - t.max(initial=0))),
    "point times reversed": Variant(_times(lambda t: t.max(initial=0) - t)),
    "half of the scans dropped": Variant(_half_dropped),
    "scans twice": Variant(_twice),
    "scans twice, restamped": Variant(_twice_restamped),
    "scans out of order": Variant(_shuffled),
    "two robots": Variant(_two_robots),
    **{
        f"clock step of {step:+g} s": Variant(_later(ALL, step, BEGIN_S))
        for step in (0.2, 1.0, 5.0, -0.2, -1.0, -5.0)
    },
    **{
        f"clock of the LiDAR steps by {step:+g} s": Variant(_later(Scan, step, BEGIN_S), kinds=("wheels",))
        for step in (0.2, 1.0, 5.0, -0.2, -1.0, -5.0)
    },
}
