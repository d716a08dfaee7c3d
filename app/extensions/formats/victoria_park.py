"""The Victoria Park recording: a zip with LASER.txt, DRS.txt (encoders) and GPS.txt.

The base frame is the laser's: x ahead, y left. Dead reckoning starts at the origin with heading 0; GPS (x
east, y north) is the ground truth, in a different frame.
"""

from __future__ import annotations

import heapq
import re
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import takewhile
from operator import attrgetter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import (
    COORDINATE_LIMIT,
    FileSource,
    SourceDescription,
    SourceOptions,
    count_loss,
    digest_of,
)
from pipeline.io.readers.pose_files import parse_table
from pipeline.io.readers.scan_columns import clean_scan
from pipeline.types.records import Float, Int, Odometry, Record, Scan, Sensor, Truth, TruthPath


@dataclass(frozen=True, slots=True)
class Car:
    """Dimensions of a car with steered front wheels, all in metres.

    Attributes:
        L: Wheelbase.
        H: Distance from the left rear wheel, where the speed is measured, to the centre line.
        a: Distance of the laser ahead of the rear axle.
        b: Distance of the laser to the left of the centre line.
    """

    L: float = 2.83
    H: float = 0.76
    a: float = 3.78
    b: float = 0.5


def dead_reckoning(time: Float, speed: Float, steering: Float, car: Car) -> Float:
    """Return the pose x, y [m], yaw [rad, not wrapped] of the laser at each encoder time, shape (N, 3).

    The first pose is (0, 0, 0). Speed and steering are constant between two readings, so the motion is an
    arc, which is integrated exactly. With v_c = v / (1 - tan(s) H / L) the laser moves in its own axes with
    v_c - b w ahead and a w to the left, and turns with w = v_c tan(s) / L.

    Args:
        time: Times of the readings, ascending, shape (N,) [s].
        speed: Speed of the left rear wheel, shape (N,) [m/s].
        steering: Steering angle, positive to the left, with a magnitude well below a right angle, shape (N,)
            [rad].
        car: Dimensions of the car.
    """
    dt = np.diff(time)
    tangent = np.tan(steering[:-1])
    v_c = speed[:-1] / (1.0 - tangent * car.H / car.L)
    w = v_c * tangent / car.L
    ahead, left = v_c - car.b * w, car.a * w
    yaw = np.concatenate([[0.0], np.cumsum(w * dt)])
    half = 0.5 * w * dt
    # The chord of an arc points along the heading half way and is shorter than the arc.
    chord = dt * np.sinc(half / np.pi)
    c, s = np.cos(yaw[:-1] + half), np.sin(yaw[:-1] + half)
    x = np.concatenate([[0.0], np.cumsum(chord * (ahead * c - left * s))])
    y = np.concatenate([[0.0], np.cumsum(chord * (ahead * s + left * c))])
    return np.stack([x, y, yaw], axis=1)


BEAMS = 361
#: The laser writes 81.91 m for a beam without a return.
RANGE_MAX = 80.0
MEMBER_LIMIT = 64 << 20  # bytes; four times the real LASER.txt
LASER = Sensor("SICK LMS 221", 1, 0.0, float(np.radians(0.5)), 0.05, RANGE_MAX)
_STEEPEST, _FASTEST, _LONGEST_S = 1.0, 50.0, 10_000_000.0


class VictoriaParkSource(FileSource):
    """Source of planar scans (z = 0) and odometry from the Victoria Park zip.

    Args:
        uri: Path as the user wrote it.
        path: The zip.
        options: Choices of the user, of which the extrinsics are used; the default is the identity. The
            odometry is the path of the laser for any extrinsics.

    Raises:
        SourceError: The zip is another one, damaged, or too large when unpacked, or has no valid scan or
            encoder reading.
        OSError: The file becomes unreadable after it was unpacked.
    """

    def __init__(self, uri: str, path: Path, options: SourceOptions) -> None:
        """Read the whole zip; scans are made in `records`.

        Raises:
            SourceError: The zip is another one, damaged, or too large when unpacked, or has no valid scan or
                encoder reading.
            OSError: The file becomes unreadable after it was unpacked.
        """
        super().__init__()
        members = _unpack(path, uri)
        self._scan_ns, self._ranges = self._read_laser(members["laser.txt"], uri)
        self._odometry_ns, self._poses = self._read_encoders(members["drs.txt"], uri)
        self._gps = self._read_gps(members.get("gps.txt", b""))
        bearing = np.radians(0.5) * np.arange(BEAMS) - np.pi / 2
        self._directions = np.stack([np.cos(bearing), np.sin(bearing), np.zeros(BEAMS)], axis=1)
        self._description = SourceDescription(
            uri=uri,
            kind="Victoria Park zip",
            sensor=LASER,
            T_base_lidar=options.T_base_lidar or Pose3.identity(),
            has_odometry=True,
            has_imu=False,
            scans=len(self._scan_ns),
            start_ns=int(self._scan_ns[0]),
            end_ns=int(self._scan_ns[-1]),
            digest=digest_of([path]),
            preset="laser2d",
        )

    def records(self) -> Iterator[Record]:
        """Return the odometry and the scans in the order of time, odometry first at equal times.
        Scans without points are counted in `losses`."""
        self._losses = losses = dict[str, int]()
        streams: list[Iterator[Record]] = [self._odometry(), self._scans(losses)]
        return heapq.merge(*streams, key=attrgetter("stamp_ns"))

    def truth(self) -> Truth | None:
        """Return the path by GPS, without yaw and in another frame than the map; None if the zip has none."""
        return None if self._gps is None else Truth(path=self._gps)

    def _odometry(self) -> Iterator[Record]:
        """Yield the odometry."""
        for index in range(len(self._odometry_ns)):
            x, y, yaw = self._poses[index].tolist()
            yield Odometry(int(self._odometry_ns[index]), Pose3.from_euler([x, y, 0.0], 0.0, 0.0, yaw))

    def _scans(self, losses: dict[str, int]) -> Iterator[Record]:
        """Yield the scans with points; those without are counted in `losses`."""
        for index in range(len(self._scan_ns)):
            scan = self._scan(index)
            if len(scan.points):
                yield scan
            else:
                count_loss(losses, "scans without points")

    def _scan(self, index: int) -> Scan:
        """Return the scan with this index, of the beams with a range between 0 and RANGE_MAX; it may have no
        points."""
        ranges = self._ranges[index]
        with np.errstate(invalid="ignore"):
            seen = (ranges > 0.0) & (ranges < RANGE_MAX)
        points = ranges[seen, None] * self._directions[seen]
        return clean_scan(int(self._scan_ns[index]), points, dropped=int(BEAMS - np.count_nonzero(seen)))

    def _read_laser(self, text: bytes, uri: str) -> tuple[Int, NDArray[np.float32]]:
        """Return times [ns], int64, shape (N,), and ranges [m], shape (N, BEAMS). Scans with impossible times
        or numbers that are not finite, an incomplete one at the end, and words from the first one on that is
        not a number, are left out and counted as damage.

        Raises:
            SourceError: There is no valid scan.
        """
        numbers, left = parse_numbers(text)  # the real file has all scans in one line
        if left:
            count_loss(self._damage, "words of LASER.txt from the first one that is not a number on", left)
        whole = len(numbers) // (BEAMS + 1) * (BEAMS + 1)
        if whole < len(numbers):
            count_loss(
                self._damage, "numbers at the end of LASER.txt that are no whole scan", len(numbers) - whole
            )
        table = numbers[:whole].reshape(-1, BEAMS + 1)
        table = self._ascending(table, "laser scans with impossible times")
        if not len(table):
            raise SourceError("LASER.txt holds no scan", where=uri, remedy="Download the file again.")
        with np.errstate(over="ignore"):  # a number that is too large becomes inf: no return
            return _nanoseconds(table[:, 0]), table[:, 1:].astype(np.float32)

    def _read_encoders(self, text: bytes, uri: str) -> tuple[Int, Float]:
        """Return times [ns], shape (N,), and poses by dead reckoning, x, y [m], yaw [rad], shape (N, 3). If
        the first scan is before the first encoder reading, the first pose is added at the time of this scan.
        Readings with impossible times, or of _FASTEST or _STEEPEST and more, are left out and counted.

        Raises:
            SourceError: There is no valid reading.
        """
        table = self._rows(text, "DRS.txt")
        table = self._ascending(table, "encoder readings with impossible times")
        sound = (np.abs(table[:, 1]) < _FASTEST) & (np.abs(table[:, 2]) < _STEEPEST)
        if not sound.all():
            count_loss(self._damage, "encoder readings out of bounds", int(np.count_nonzero(~sound)))
        table = table[sound]
        if not len(table):
            raise SourceError("DRS.txt holds no reading", where=uri, remedy="Download the file again.")
        poses = dead_reckoning(table[:, 0], table[:, 1], table[:, 2], Car())
        stamp_ns = _nanoseconds(table[:, 0])
        if self._scan_ns[0] < stamp_ns[0]:
            return np.append(self._scan_ns[:1], stamp_ns), np.concatenate([poses[:1], poses])
        return stamp_ns, poses

    def _read_gps(self, text: bytes) -> TruthPath | None:
        """Return the path by GPS, x east, y north [m], with NaN as yaw; None if there are no valid rows.
        Other rows are left out and counted as damage."""
        table = self._ascending(self._rows(text, "GPS.txt"), "GPS rows with impossible times")
        near = (np.abs(table[:, 1:]) < COORDINATE_LIMIT).all(axis=1)
        if not near.all():
            count_loss(self._damage, "GPS rows with impossible positions", int(np.count_nonzero(~near)))
        table = table[near]
        if not len(table):
            return None
        north, east = table[:, 1].copy(), table[:, 2].copy()
        return TruthPath(
            _nanoseconds(table[:, 0]), east, north, np.full(len(table), np.nan), same_frame=False
        )

    def _rows(self, text: bytes, name: str) -> Float:
        """Return the rows of three numbers of a text file, shape (N, 3), and count its damaged lines as
        losses. Numbers may be NaN or infinite; `_ascending` leaves such rows out."""
        table, damaged = parse_table(text, 3)
        if damaged:
            count_loss(self._damage, f"damaged rows of {name}", damaged)
        return table

    def _ascending(self, table: Float, reason: str) -> Float:
        """Return the rows with finite numbers whose times are in [0, _LONGEST_S) and do not go back; there
        may be none.

        Args:
            table: Rows, shape (N, columns), with the time in the first column [s].
            reason: Reason under which the other rows are counted as losses.
        """
        time = table[:, 0]
        with np.errstate(invalid="ignore"):
            sound = (time >= 0.0) & (time < _LONGEST_S) & np.isfinite(table).all(axis=1)
        sound &= np.where(sound, time, -np.inf) >= np.maximum.accumulate(np.where(sound, time, -np.inf))
        if not sound.all():
            count_loss(self._damage, reason, int(np.count_nonzero(~sound)))
        return table[sound]


def _unpack(path: Path, uri: str) -> dict[str, bytes]:
    """Return a dict from the names "laser.txt", "drs.txt" and, if it exists, "gps.txt" to the contents of
    these files, from any folder of the zip and with names in any case. Sizes are checked before unpacking.

    Raises:
        SourceError: The zip cannot be read or is damaged, has no LASER.txt or no DRS.txt, or a file in it is
            too large.
    """
    wanted = {"laser.txt", "drs.txt", "gps.txt"}
    try:
        # A damaged zip may point before the start of the file, which raises an OSError.
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            found = {Path(entry.filename).name.lower(): entry for entry in archive.infolist()}
            if not {"laser.txt", "drs.txt"} <= found.keys():
                raise SourceError(
                    "the zip holds no LASER.txt and DRS.txt",
                    where=uri,
                    remedy="Only the zip of Victoria Park can be read; unpack other zips first.",
                )
            chosen = {name: entry for name, entry in found.items() if name in wanted}
            large = [name for name, entry in chosen.items() if entry.file_size > MEMBER_LIMIT]
            if large:
                raise SourceError(f"{large[0]} unpacks to more than {MEMBER_LIMIT >> 20} MB", where=uri)
            return {name: archive.read(entry) for name, entry in chosen.items()}
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, OSError, ValueError) as error:
        raise SourceError(
            f"the zip is damaged: {error}", where=uri, remedy="Download the file again."
        ) from error


def _nanoseconds(seconds: Float) -> Int:
    """Return seconds as nanoseconds, rounded, int64 of the same shape."""
    return np.rint(seconds * 1e9).astype(np.int64)


_BLOCK = 4 << 20  # bytes of text that are split into words at once, which takes ten times as much memory
_GAP = re.compile(rb"\s")


def parse_numbers(text: bytes) -> tuple[Float, int]:
    """Return the numbers between blanks or line ends, up to the first word that is not a number, shape (N,),
    and the number of words from that one on, which are left out; "nan" and "inf" are numbers."""
    parts, at, left = [np.zeros(0)], 0, 0
    while at < len(text):
        gap = _GAP.search(text, at + _BLOCK)
        end = len(text) if gap is None else gap.end()
        words = text[at:end].split()
        try:
            numbers = np.array([] if left else words, np.float64)
        except ValueError:
            numbers = np.array(list(takewhile(_is_number, words)), np.float64)
        parts.append(numbers)
        left += len(words) - len(numbers)
        at = end
    return np.concatenate(parts), left


def _is_number(word: bytes) -> bool:
    """Return whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True
