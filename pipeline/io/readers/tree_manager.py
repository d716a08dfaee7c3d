"""Folders of `TreeManagerState_<i>.csv` with `trajectory.txt` as a source (see `tree_manager_writer`): stems
that another program found, and its trajectory as odometry. Of the columns only the place is needed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import SourceDescription, SourceOptions, count_loss, digest_of
from pipeline.io.readers.number_text import parse_table
from pipeline.io.readers.pose_files import TextError, read_table
from pipeline.io.tree_manager_writer import AXIS, DBH, PLACE, TRAJECTORY
from pipeline.types.records import Float, Int, Odometry, Record, Scan, Sensor, Stems, Truth

NAME = re.compile(r"TreeManagerState_(\d{1,9})\.csv")
#: Along the stem: the third column of its rotation.
STEM_AXIS = AXIS[2::3]
#: A frame of 100 stems has 40 kB.
CSV_LIMIT = 16 << 20
PLACE_LIMIT, DBH_LIMIT = 1e4, 10.0
_TIME_LIMIT = 9e9  # s; what nanoseconds since 1970 hold in 64 bits
STEM_FINDER = Sensor("stems of another program", 0, 0.0, 0.0035, 0.1, 100.0)


class TreeManagerSource:
    """The folder as a source of scans with stems, and of odometry.

    Args:
        uri: As the user wrote it.
        path: The folder.
        options: Extrinsics; the trajectory is that of the sensor.

    Raises:
        SourceError: The trajectory is missing, damaged or too short, or no file has stems.
        OSError: The folder cannot be read.
    """

    def __init__(self, uri: str, path: Path, options: SourceOptions) -> None:
        numbered = sorted(
            (int(match.group(1)), file) for file in path.iterdir() if (match := NAME.fullmatch(file.name))
        )
        if not numbered:
            raise SourceError("no file in the folder is named TreeManagerState_<i>.csv", where=uri)
        self._uri = uri
        self._files = [file for _, file in numbered]
        self._losses: dict[str, int] = {}
        self._T_base_lidar = options.T_base_lidar or Pose3.identity()
        self._stamp, self._poses = _read_trajectory(path / TRAJECTORY, uri)
        number = np.array([n for n, _ in numbered], dtype=np.int64)
        self._row, warnings = _rows(number, len(self._stamp), uri)
        _check_sizes(self._files, uri)
        _columns(_header(self._files[0]), self._files[0], uri)
        self._description = SourceDescription(
            uri=uri,
            kind="folder of TreeManagerState files",
            sensor=STEM_FINDER,
            T_base_lidar=self._T_base_lidar,
            has_odometry=True,
            has_imu=False,
            scans=len(self._files),
            start_ns=int(self._stamp[self._row[0]]),
            end_ns=int(self._stamp[self._row[-1]]),
            digest=digest_of([path / TRAJECTORY, *self._files]),
            preset="stems",
            warnings=warnings,
        )

    @property
    def description(self) -> SourceDescription:
        """Description that is known before reading."""
        return self._description

    @property
    def losses(self) -> dict[str, int]:
        """Records left out in the latest reading, by reason."""
        return dict(self._losses)

    def records(self, start_ns: int | None = None) -> Iterator[Record]:
        """Yield odometry and scans from `start_ns` on; earlier files are not opened."""
        self._losses = losses = dict[str, int]()
        file_of = dict(zip(self._row.tolist(), self._files, strict=True))
        begin = 0 if start_ns is None else int(np.searchsorted(self._stamp, start_ns))
        for row in range(begin, len(self._stamp)):
            stamp_ns = int(self._stamp[row])
            yield Odometry(stamp_ns, self._poses[row] @ self._T_base_lidar.inverse())
            if row in file_of:
                scan = self._scan(file_of[row], stamp_ns, losses)
                if scan is not None:
                    yield scan

    def truth(self) -> Truth | None:
        """Return None: the trajectory is odometry, and the ground truth is unknown."""
        return None

    def close(self) -> None:
        """Nothing is held open."""

    def _scan(self, file: Path, stamp_ns: int, losses: dict[str, int]) -> Scan | None:
        """Return the scan of a frame, which may have no stems; None when the file cannot be read."""
        try:
            frame = _read_frame(file, self._uri)
        except (SourceError, OSError):
            count_loss(losses, "TreeManagerState files that cannot be read")
            return None
        if frame.damaged:
            count_loss(losses, "damaged rows of TreeManagerState files", frame.damaged)
        points = frame.place.astype(np.float32)
        return Scan(stamp_ns, points, dropped=frame.damaged, stems=Stems(frame.axis, frame.dbh))


@dataclass(frozen=True, slots=True, eq=False)
class _FrameTable:
    """Stems of one file: places (N, 3), axes (N, 3), DBH (N,), and the number of damaged rows."""

    place: Float
    axis: Float
    dbh: Float
    damaged: int


def _read_frame(file: Path, uri: str) -> _FrameTable:
    """Read the stems of a file.

    Raises:
        SourceError: It is too large, or its header lacks a column.
        OSError: It cannot be read.
    """
    with file.open("rb") as opened:
        text = opened.read(CSV_LIMIT + 1)
    if len(text) > CSV_LIMIT:
        raise SourceError(f"{file.name} is larger than {CSV_LIMIT >> 20} MB", where=uri)
    head, _, body = text.partition(b"\n")
    names = _names(head)
    at = _columns(names, file, uri)
    table, damaged = _numbers(body, len(names))
    place = table[:, [at[name] for name in PLACE]]
    with np.errstate(invalid="ignore"):
        sound = (np.abs(place) < PLACE_LIMIT).all(axis=1)
    table, place = table[sound], place[sound]
    return _FrameTable(place, _axes(table, at), _dbh(table, at), damaged + int(np.count_nonzero(~sound)))


def _axes(table: Float, at: dict[str, int]) -> Float:
    """Return unit vectors along the stems, upwards, shape (N, 3); NaN for invalid ones."""
    if not all(name in at for name in STEM_AXIS):
        return np.full((len(table), 3), np.nan)
    axis = table[:, [at[name] for name in STEM_AXIS]]
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        upwards: Float = axis / np.where(np.abs(length - 1.0) < 0.1, length, np.nan)
        return upwards * np.where(upwards[:, 2:] < 0.0, -1.0, 1.0)


def _dbh(table: Float, at: dict[str, int]) -> Float:
    """Return diameters [m], shape (N,); NaN for missing or impossible ones."""
    if DBH not in at:
        return np.full(len(table), np.nan)
    dbh = table[:, at[DBH]]
    with np.errstate(invalid="ignore"):
        return np.where((dbh > 0.0) & (dbh < DBH_LIMIT), dbh, np.nan)


def _numbers(body: bytes, columns: int) -> tuple[Float, int]:
    """Return the rows of numbers, NaN for an empty field, and the number of damaged rows."""
    text = (b"\n" + body + b"\n").replace(b"\r", b"").replace(b"True", b"1").replace(b"False", b"0")
    for gap, filled in ((b",,", b",nan,"), (b",,", b",nan,"), (b",\n", b",nan\n"), (b"\n,", b"\nnan,")):
        text = text.replace(gap, filled)
    return parse_table(text.replace(b",", b" "), columns)


def _names(head: bytes) -> list[str]:
    return [name.strip() for name in head.decode("utf-8", "replace").lstrip("\ufeff").split(",")]


def _header(file: Path) -> list[str]:
    with file.open("rb") as opened:
        return _names(opened.readline(4096))


def _columns(names: list[str], file: Path, uri: str) -> dict[str, int]:
    """Return the index of each column.

    Raises:
        SourceError: The place is missing.
    """
    at = {name: k for k, name in enumerate(names)}
    missing = [name for name in PLACE if name not in at]
    if missing:
        raise SourceError(
            f"{file.name} has no column {missing[0]}",
            where=uri,
            remedy=f"Its first line must name the columns, among them {', '.join(PLACE)}.",
        )
    return at


def _check_sizes(files: list[Path], uri: str) -> None:
    for file in files:
        if file.stat().st_size > CSV_LIMIT:
            raise SourceError(
                f"{file.name} is larger than {CSV_LIMIT >> 20} MB",
                where=uri,
                remedy="It is not a frame of stems.",
            )


def _read_trajectory(file: Path, uri: str) -> tuple[Int, list[Pose3]]:
    """Read stamps [ns], ascending, and poses."""
    remedy = "It needs a row `time x y z qx qy qz qw` for each TreeManagerState file."
    try:
        table = read_table(file, 8)
        stamp = table[:, 0]
        if not (np.all(np.abs(stamp) < _TIME_LIMIT) and np.all(np.diff(stamp) > 0.0)):
            raise TextError("its times do not ascend")
        poses = [Pose3.from_quaternion(row[1:4], row[[7, 4, 5, 6]]) for row in table]
    except FileNotFoundError:
        raise SourceError(f"there is no {TRAJECTORY} in the folder", where=uri, remedy=remedy) from None
    except (TextError, ValueError) as error:
        raise SourceError(f"{TRAJECTORY} cannot be used: {error}", where=uri, remedy=remedy) from error
    return np.rint(stamp * 1e9).astype(np.int64), poses


def _rows(number: Int, count: int, uri: str) -> tuple[Int, tuple[str, ...]]:
    """The row of each file in a trajectory of `count` rows."""
    files = len(number)
    if int(number[-1]) < count and len(np.unique(number)) == files:
        unseen = count - files
        said = f"{unseen} rows of {TRAJECTORY} have no TreeManagerState file: no stems are seen there"
        return number, (said,) if unseen else ()
    if files == count:
        return np.arange(count, dtype=np.int64), ()
    raise SourceError(
        f"{TRAJECTORY} has {count} rows, but the TreeManagerState files are numbered up to {int(number[-1])}",
        where=uri,
        remedy="The number of a file is its row, counted from 0.",
    )
