"""Folders of `TreeManagerState_<i>.csv` with `trajectory.txt`, the format of programs for relocalisation
among stems.

`TreeManagerState_<i>.csv` has the stems of frame i in the sensor frame: a rotation whose third column is
along the stem, a position and a diameter in metres. Row i of `trajectory.txt`, counted from 0, is the pose of
the sensor: time [s], x y z [m], quaternion qx qy qz qw. An empty field is unknown. The reader needs only the
columns of the position, and uses the trajectory as odometry.
"""

from __future__ import annotations

import math
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np

from pipeline.errors import SourceError, StemmapError
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.io.atomic_files import UNFINISHED
from pipeline.io.readers.base import FileSource, SourceDescription, SourceOptions, count_loss, digest_of
from pipeline.io.readers.pose_files import TextError, parse_table, read_any_poses
from pipeline.types.records import Float, Int, Odometry, Record, Scan, Sensor, Stems, Trees
from pipeline.types.records import Path as MapPath

TRAJECTORY = "trajectory.txt"
AXIS = tuple(f"axis_{row}{column}" for row in range(3) for column in range(3))
PLACE = ("location_x", "location_y", "location_z")
DBH = "dbh"
COLUMNS = (*AXIS, *PLACE, DBH, "dbh_approximation", "score", "reconstructed", "number_clusters")


def state_name(frame: int) -> str:
    """Return the name of the file of a frame, "TreeManagerState_12.csv" for the number 12."""
    return f"TreeManagerState_{frame}.csv"


def state_text(rows: Iterable[Sequence[float | bool]]) -> str:
    """Return the text of the file of a frame.

    Args:
        rows: One row per stem, in the order of COLUMNS; NaN is written as an empty field.
    """
    lines = [",".join(_field(value) for value in row) for row in rows]
    return "\n".join([",".join(COLUMNS), *lines]) + "\n"


def trajectory_text(stamp_ns: Int, poses: Iterable[Pose3]) -> str:
    """Return the text of the file of poses, one row per pose, with times [ns], int64, shape (N,).

    Raises:
        ValueError: There are not as many poses as times.
    """
    lines = []
    for stamp, pose in zip(stamp_ns.tolist(), poses, strict=True):
        w, x, y, z = pose.quaternion().tolist()
        seconds = f"{Decimal(stamp).scaleb(-9):f}"  # a float has too few digits
        lines.append(" ".join([seconds, *(f"{v:.9f}" for v in (*pose.t.tolist(), x, y, z, w))]))
    return "\n".join(lines) + "\n"


def write_tree_manager(folder: Path, path: MapPath, trees: Trees, reach: float) -> int:
    """Write a mapped run to a folder, which appears when it is complete; parent folders are created.

    A frame has the trees that were seen until then and are within `reach` of its pose, at their positions in
    the final map. The map is planar: poses have no tilt, and stems are vertical at height 0.

    Args:
        folder: The folder, which must be new or empty.
        path: Poses and times.
        trees: The map; only confirmed trees are written.
        reach: Radius of a frame [m].

    Returns:
        Number of confirmed trees that are in no frame.

    Raises:
        StemmapError: The folder is not empty, or cannot be written.
    """
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise StemmapError("it is not empty", where=str(folder), remedy="Name a new folder")
        folder.parent.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=folder.parent))
        try:
            left_out = _write(staging, path, trees, reach)
            staging.chmod(0o755)  # like other new folders; only the owner may read a temporary one
            if folder.exists():
                folder.rmdir()
            staging.rename(folder)
        except BaseException:
            shutil.rmtree(staging, ignore_errors=True)
            raise
    except OSError as error:
        raise StemmapError(f"cannot write: {error.strerror}", where=str(folder)) from error
    return left_out


def _write(folder: Path, path: MapPath, trees: Trees, reach: float) -> int:
    """Write the files of a mapped run into an existing folder: the trajectory, and for each pose a frame with
    the confirmed trees that were seen until then within `reach` [m]. Return the number of confirmed trees
    that are in no frame.

    Raises:
        OSError: A file cannot be written.
    """
    poses = [Pose2(x, y, yaw) for x, y, yaw in zip(path.x, path.y, path.yaw, strict=True)]
    known = np.flatnonzero(trees.confirmed)
    position, first_ns = trees.position[known], trees.first_seen_ns[known]
    written = np.zeros(len(known), np.bool_)
    for frame, (pose, stamp_ns) in enumerate(zip(poses, path.stamp_ns.tolist(), strict=True)):
        place = pose.inverse().apply(position)
        here = (np.hypot(place[:, 0], place[:, 1]) <= reach) & (first_ns <= stamp_ns)
        written |= here
        rows = [_row(trees, known[k], place[k]) for k in np.flatnonzero(here)]
        (folder / state_name(frame)).write_text(state_text(rows), encoding="utf-8", newline="")
    full = [Pose3.from_euler(np.array([p.x, p.y, 0.0]), 0.0, 0.0, p.yaw) for p in poses]
    text = trajectory_text(path.stamp_ns, full)
    (folder / TRAJECTORY).write_text(text, encoding="utf-8", newline="")
    return int(np.count_nonzero(~written))


def _row(trees: Trees, k: int, place: Float) -> list[float | bool]:
    """Return the row of tree k in a frame, in the order of COLUMNS; `place` is its position in the frame,
    shape (2,) [m]. The stem is vertical at height 0. "dbh_approximation" is the dbh, "score" is 1,
    "reconstructed" is whether the dbh is known, and "number_clusters" is the number of observations."""
    dbh, upright = float(trees.dbh[k]), np.eye(3).ravel().tolist()
    fit = [dbh, dbh, 1.0, math.isfinite(dbh), int(trees.observations[k])]
    return [*upright, float(place[0]), float(place[1]), 0.0, *fit]


def _field(value: float | bool) -> str:
    """Return a value as text: "True" or "False", a number with nine digits, or "" if it is not finite."""
    if isinstance(value, bool):
        return str(value)
    return f"{value:.9g}" if math.isfinite(value) else ""


NAME = re.compile(r"TreeManagerState_(\d{1,9})\.csv")
#: Along the stem: the third column of its rotation.
STEM_AXIS = AXIS[2::3]
#: A frame of 100 stems has 40 kB.
CSV_LIMIT = 16 << 20
PLACE_LIMIT, DBH_LIMIT = 1e4, 10.0
STEM_FINDER = Sensor("stems of another program", 0, 0.0, 0.0035, 0.1, 100.0)


class TreeManagerSource(FileSource):
    """The folder as a source of scans with stems, and of odometry.

    Args:
        uri: Path as the user wrote it.
        path: The folder.
        options: Extrinsics; the trajectory is that of the sensor.

    Raises:
        SourceError: See `__init__`.
        OSError: The folder cannot be read.
    """

    def __init__(self, uri: str, path: Path, options: SourceOptions) -> None:
        """Read the trajectory and the first frame, and check the sizes of all files.

        Raises:
            SourceError: There is no TreeManagerState file, the trajectory is missing, damaged or too short,
                the first file lacks a column of positions, or a file is too large.
            OSError: The folder cannot be read.
        """
        super().__init__()
        numbered = sorted(
            (int(match.group(1)), file) for file in path.iterdir() if (match := NAME.fullmatch(file.name))
        )
        if not numbered:
            raise SourceError("no file in the folder is named TreeManagerState_<i>.csv", where=uri)
        self._uri = uri
        self._files = [file for _, file in numbered]
        self._T_base_lidar = options.T_base_lidar or Pose3.identity()
        self._stamp, self._poses = _read_trajectory(path / TRAJECTORY, uri)
        number = np.array([n for n, _ in numbered], dtype=np.int64)
        self._row, warnings = _rows(number, len(self._stamp), uri)
        too_large = next((file for file in self._files if file.stat().st_size > CSV_LIMIT), None)
        if too_large is not None:
            raise _too_large(too_large, uri)
        _read_frame(self._files[0], uri)
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

    def records(self) -> Iterator[Record]:
        """Yield odometry for each row of the trajectory, then the scan of the same time, if the row has a
        file that can be read; a scan without stems is yielded. Files and rows that cannot be read are counted
        in `losses`."""
        self._losses = losses = dict[str, int]()
        file_of = dict(zip(self._row.tolist(), self._files, strict=True))
        for row in range(len(self._stamp)):
            stamp_ns = int(self._stamp[row])
            yield Odometry(stamp_ns, self._poses[row] @ self._T_base_lidar.inverse())
            if row in file_of:
                scan = self._scan(file_of[row], stamp_ns, losses)
                if scan is not None:
                    yield scan

    def _scan(self, file: Path, stamp_ns: int, losses: dict[str, int]) -> Scan | None:
        """Return the scan of a frame, with the positions of its stems as points; it may have no stems. None,
        which is counted, if the file cannot be read.

        Args:
            file: The file of the frame.
            stamp_ns: Time of the scan [ns].
            losses: Dict from reasons to numbers of files and rows that cannot be read; increased in place.
        """
        try:
            table, at, damaged = _read_frame(file, self._uri)
        except (SourceError, OSError):
            count_loss(losses, "TreeManagerState files that cannot be read")
            return None
        place = table[:, [at[name] for name in PLACE]]
        with np.errstate(invalid="ignore"):
            sound = (np.abs(place) < PLACE_LIMIT).all(axis=1)
        table, place = table[sound], place[sound]
        damaged += int(np.count_nonzero(~sound))
        if damaged:
            count_loss(losses, "damaged rows of TreeManagerState files", damaged)
        stems = Stems(_axes(table, at), _dbh(table, at))
        return Scan(stamp_ns, place.astype(np.float32), dropped=damaged, stems=stems)


def _read_frame(file: Path, uri: str) -> tuple[Float, dict[str, int], int]:
    """Return the rows of a file, shape (N, columns), with NaN for empty fields; a dict from the names of the
    columns to their indices; and the number of damaged rows.

    Raises:
        SourceError: The file is too large, or its header lacks a column of PLACE.
        OSError: The file cannot be read.
    """
    with file.open("rb") as opened:
        text = opened.read(CSV_LIMIT + 1)
    if len(text) > CSV_LIMIT:
        raise _too_large(file, uri)
    head, _, body = text.partition(b"\n")
    names = [name.strip() for name in head.decode("utf-8", "replace").lstrip("\ufeff").split(",")]
    at = {name: k for k, name in enumerate(names)}
    missing = [name for name in PLACE if name not in at]
    if missing:
        raise SourceError(
            f"{file.name} has no column {missing[0]}",
            where=uri,
            remedy=f"Its first line must name the columns, among them {', '.join(PLACE)}.",
        )
    table, damaged = _numbers(body, len(names))
    return table, at, damaged


def _too_large(file: Path, uri: str) -> SourceError:
    """Return the error for a file that is larger than CSV_LIMIT."""
    what = f"{file.name} is larger than {CSV_LIMIT >> 20} MB"
    return SourceError(what, where=uri, remedy="It is not a frame of stems.")


def _axes(table: Float, at: dict[str, int]) -> Float:
    """Return unit vectors along the stems, upwards, shape (N, 3); NaN for a length that differs from 1 by 0.1
    or more, and for all if a column is missing.

    Args:
        table: Rows of the file, shape (N, columns).
        at: Dict from the names of the columns to their indices.
    """
    if not all(name in at for name in STEM_AXIS):
        return np.full((len(table), 3), np.nan)
    axis = table[:, [at[name] for name in STEM_AXIS]]
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        upwards: Float = axis / np.where(np.abs(length - 1.0) < 0.1, length, np.nan)
        return upwards * np.where(upwards[:, 2:] < 0.0, -1.0, 1.0)


def _dbh(table: Float, at: dict[str, int]) -> Float:
    """Return the diameters in a table [m], shape (N,); NaN for missing ones and those that are not between 0
    and DBH_LIMIT. `at` is a dict from the names of the columns to their indices."""
    if DBH not in at:
        return np.full(len(table), np.nan)
    dbh = table[:, at[DBH]]
    with np.errstate(invalid="ignore"):
        return np.where((dbh > 0.0) & (dbh < DBH_LIMIT), dbh, np.nan)


def _numbers(body: bytes, columns: int) -> tuple[Float, int]:
    """Return the rows of numbers in the text `body`, shape (N, columns), with NaN for an empty field and 1
    and 0 for True and False, and the number of damaged rows."""
    text = (b"\n" + body + b"\n").replace(b"\r", b"").replace(b"True", b"1").replace(b"False", b"0")
    for gap, filled in ((b",,", b",nan,"), (b",,", b",nan,"), (b",\n", b",nan\n"), (b"\n,", b"\nnan,")):
        text = text.replace(gap, filled)
    return parse_table(text.replace(b",", b" "), columns)


def _read_trajectory(file: Path, uri: str) -> tuple[Int, list[Pose3]]:
    """Return the times [ns], int64, shape (N,), strictly ascending, and the poses of the sensor in a file.

    Raises:
        SourceError: The file is missing or damaged, or its times do not strictly ascend.
        OSError: The file cannot be read.
    """
    remedy = "It needs a row `time x y z qx qy qz qw` for each TreeManagerState file."
    try:
        times, poses = read_any_poses(file)
        if times is None:
            raise TextError("its rows have no times")
        return times, poses
    except FileNotFoundError:
        raise SourceError(f"there is no {TRAJECTORY} in the folder", where=uri, remedy=remedy) from None
    except TextError as error:
        raise SourceError(f"{TRAJECTORY} cannot be used: {error}", where=uri, remedy=remedy) from error


def _rows(number: Int, count: int, uri: str) -> tuple[Int, tuple[str, ...]]:
    """Return the row of the trajectory for each file, int64, shape (N,), and warnings: the number of the file
    if there are enough rows, else its index if there are as many rows as files. Rows without a file give a
    warning.

    Args:
        number: Frame number of each file, ascending.
        count: Number of rows of the trajectory.
        uri: The source, for errors.

    Raises:
        SourceError: There are neither enough rows nor as many rows as files.
    """
    files = len(number)
    if int(number[-1]) < count and len(np.unique(number)) == files:
        unseen = count - files
        warning = f"{unseen} rows of {TRAJECTORY} have no TreeManagerState file: no stems are seen there"
        return number, (warning,) if unseen else ()
    if files == count:
        return np.arange(count, dtype=np.int64), ()
    raise SourceError(
        f"{TRAJECTORY} has {count} rows, but the TreeManagerState files are numbered up to {int(number[-1])}",
        where=uri,
        remedy="The number of a file is its row, counted from 0.",
    )
