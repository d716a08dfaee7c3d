"""Folders with one file per scan: KITTI .bin, PCD, PLY, NumPy and LAS, and files with poses and times."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import folders_of_runs, form_of, formats, named, recordings_in
from pipeline.io.readers.base import FileSource, SourceDescription, SourceOptions, count_loss, digest_of
from pipeline.io.readers.firing_order import FIRING_ORDER
from pipeline.io.readers.mounting import assumed_mounting
from pipeline.io.readers.point_files import Columns, ScanFileError, open_table, read_columns
from pipeline.io.readers.point_times import PointTimes, decide_point_times
from pipeline.io.readers.pose_files import TextError, pose_at, read_pose_rows, read_times, seconds_ns, time_ns
from pipeline.io.readers.scan_columns import (
    FARTHEST_MEDIAN,
    NO_METRES,
    RANGE_LIMIT,
    median_range,
    scan_of,
    sensor_of,
    timed_scan,
)
from pipeline.types.records import Float, Int, Odometry, Record, Scan, Sensor

#: Period of scans without times: 10 Hz.
STEP_NS = 100_000_000
#: Usual names of files with times and with poses; further texts with such a word in their names may be poses.
TIMES = ("times.txt", "timestamps.txt")
POSES = ("poses.txt", "poses.tum", "trajectory.txt", "trajectory.tum", "groundtruth.txt")
_POSE_WORDS = re.compile(r"(?:^|[_-])(?:poses?|traj\w*|odom\w*|groundtruth)(?:$|[_-])", re.IGNORECASE)
_TEXTS = (".txt", ".csv", ".tum")
_TIME_NAME = re.compile(r"(?:[A-Za-z]+[_-])?([0-9]{10}[._][0-9]{1,9}|[0-9]{16}|[0-9]{19})", re.ASCII)
#: Number of unreadable files at the start after which the folder is refused.
_TRIES = 20
#: Length of the steps by which two odometries are compared [m], and the share of it and the turn [rad] by
#: which they differ with the same motion: systematic errors of wheels are less.
_STEP, _STEP_SHARE, _STEP_TURN = 1.0, 0.1, 0.05
#: Distance of a sensor from the origin by which the frame of its points is known [m].
_DECISIVE = 1.0

T = TypeVar("T")
#: Pose of each scan, None for a scan without one, and new times of the scans [ns], if any.
Fit = tuple[list[Pose3 | None], Int | None]


class ScanFolder(FileSource):
    """Source of scans from files, in the order of the numbers in their names.

    Poses (odometry; `poses.txt` and the other names of POSES, see `read_pose_rows`) and `times.txt` or
    `timestamps.txt` are read from the folder or its parent. The number in the name of a scan file is its row
    in them, or its index in the folder when there are as many rows as files; if neither fits, a warning is
    given and they are not used. Without such poses, those in the only text with a word like "odom" in its
    name are used whose times are those of the scans, or which has as many rows as there are scans; two
    folders above, only times tell that they belong to this run. Rows with a number of a frame (KITTI-360,
    also `data_poses/<drive>/poses.txt` beside the folder of the drives) belong to the scan with this number.
    Without a file of times, the times are those in the names of the scans (1645000000.25.pcd), else those of
    TUM rows. TUM rows are matched to scans by time where both have times.

    Args:
        uri: Path as the user wrote it.
        path: One file, the folder with the files, or a folder with a folder `velodyne`. Of several formats
            .bin is read, else .pcd, else the one with the most files.
        options: Choices of the user, of which the extrinsics are used.

    Raises:
        SourceError: There are no files, or none of the first ones holds a scan.
        OSError: The folder cannot be read.
    """

    def __init__(self, uri: str, path: Path, options: SourceOptions) -> None:
        """Find the scan files, read the files of times and poses, and load the first scan that can be read.
        Recordings of other formats in the folder, and folders in it that are runs, give a warning.

        Raises:
            SourceError: There are no files, or none of the first ones holds a scan.
            OSError: The folder cannot be read.
        """
        super().__init__()
        self._suffix, self._files = _scan_files(path)
        self._kind = _names_of_scans()[self._suffix]
        self._T_file_lidar: dict[Path, Pose3] = {}
        if not self._files:
            raise SourceError(f"the folder has no {self._suffix} files", where=uri)
        if self._suffix == ".bin":
            with suppress(ScanFileError, OSError):  # the loading of the scan states the reason
                self._kind = open_table(self._files[0]).kind
        self._warnings: list[str] = []
        self._texts: list[Path] = []
        numbers = np.array([_number(file) for file in self._files], dtype=np.int64)
        self._numbers = numbers
        by_time = _names_ns(self._files) is not None
        if by_time or len(np.unique(numbers)) < len(numbers) or (numbers < 0).any():
            numbers = np.arange(len(numbers), dtype=np.int64)
        folder = self._files[0].parent
        own = (self._suffix, ".txt", ".csv")
        others = [name for name in recordings_in(folder) if Path(name).suffix.lower() not in own]
        others += folders_of_runs(folder)
        if others and not path.is_file():
            self._warnings.append(f"not part of this run are {named(others)}: open each of them by its name")
        # A relative path such as "." has no parents; links keep the folder in which they are.
        folder = folder.resolve() if ".." in folder.parts else folder.absolute()
        places = [] if path.is_file() else list(dict.fromkeys([folder, *folder.parents[:2]]))
        if path.is_file() and self._suffix == ".pcd" and (form := form_of(path, options)).why:
            self._warnings.append(form.words)
        self._timed = False
        self._stamp = self._read_stamps(places[:2], numbers)
        self._T_base_lidar = options.T_base_lidar or Pose3.identity()
        self._poses = self._read_poses(places, numbers) or self._read_views()
        if self._poses is None and not self._timed and options.form != "scan":
            _refuse_clouds(self._files, uri)
        if self._poses is not None:
            self._find_frame(self._poses)
        self._times = self._decide_times()
        first = self._first_scan(uri)
        if median_range(first) > FARTHEST_MEDIAN:
            count_loss(self._damage, NO_METRES, len(self._files))
        if options.T_base_lidar is None and self._poses is None:
            self._T_base_lidar, messages = assumed_mounting(first)
            self._warnings += messages
        self._description = SourceDescription(
            uri=uri,
            kind=self._kind,
            sensor=_kitti_sensor(first) if self._suffix == ".bin" else sensor_of(first),
            T_base_lidar=self._T_base_lidar,
            has_odometry=self._poses is not None,
            has_imu=False,
            scans=len(self._files),
            start_ns=int(self._stamp[0]),
            end_ns=int(self._stamp[-1]),
            digest=digest_of([*self._files, *self._texts]),
            warnings=tuple(self._warnings),
            has_times=self._timed,
        )

    def records(self) -> Iterator[Record]:
        """Yield the scans, each after its odometry if it has a pose. Files that cannot be read, and scans
        without points, are left out and counted in `losses`; their odometry is yielded."""
        self._losses = losses = dict[str, int]()
        for index in range(len(self._files)):
            stamp_ns = int(self._stamp[index])
            pose = None if self._poses is None else self._poses[index]
            if pose is not None:
                yield Odometry(stamp_ns, pose @ self._T_base_lidar.inverse())
            try:
                scan = self._load_scan(self._files[index], stamp_ns, losses)
            except (ScanFileError, OSError):
                count_loss(losses, "scan files that cannot be read")
                continue
            if len(scan.points):
                yield scan
            else:
                count_loss(losses, "scans without points")

    def _first_scan(self, uri: str) -> Scan:
        """Return the first scan with points among the first _TRIES files, at the time 0; files that cannot be
        read are skipped.

        Raises:
            SourceError: None of these files can be read and has points.
        """
        reason = ""
        for file in self._files[:_TRIES]:
            try:
                scan = self._load_scan(file, 0, {})
            except (ScanFileError, OSError) as error:
                reason = reason or f"{file.name} cannot be read: {error}"
                continue
            if len(scan.points):
                return scan
            reason = reason or f"{file.name} holds no points"
        raise SourceError(reason, where=uri, remedy=f"Files must be {self._kind} scans.")

    def _first_text(self, places: list[Path], names: Iterable[str], use: Callable[[Path], T]) -> T | None:
        """Return the result for the first file of some names that can be used, which is added to the files of
        the digest; None if there is none. Other files before it become warnings.

        Args:
            places: Folders, searched in this order.
            names: Names of the files.
            use: Function of a path; raises TextError with the reason if the file cannot be used.
        """
        for path in [place / name for place in places for name in names]:
            try:
                found = use(path)
            except FileNotFoundError:
                continue
            except (TextError, OSError) as error:
                self._warnings.append(f"{path.name} is not used: {error}")
                continue
            self._texts.append(path)
            return found
        return None

    def _read_stamps(self, places: list[Path], numbers: Int) -> Int:
        """Return the time of each scan [ns], int64, shape (N,): by a file of times, by the names, or else
        STEP_NS apart by the numbers. `_timed` is set to whether times were found.

        Args:
            places: Folders that are searched.
            numbers: Number in the name of each scan file.
        """

        def in_file(path: Path) -> Int:
            times = read_times(path)
            return times[_rows(len(times), numbers)]

        stamps = self._first_text(places, TIMES, in_file)
        if stamps is None:
            stamps = _times_in_names(self._files)
        self._timed = stamps is not None
        return numbers * STEP_NS if stamps is None else stamps

    def _read_poses(self, places: list[Path], numbers: Int) -> list[Pose3 | None] | None:
        """Return the pose of each scan (None for scans without one) by the first file of POSES that fits, or
        the only one that fits by its name; None if there is none. Times of its rows replace those of scans
        without times.

        Args:
            places: The folder, its parent and the parent of this.
            numbers: Number in the name of each scan file.
        """
        drive = [p.parents[1] / "data_poses" / p.name for p in places[2:] if len(p.parents) > 1]  # KITTI-360
        found = self._first_text([*places[:2], *drive], POSES, lambda path: self._fitting(path, numbers))
        if found is None:
            found = self._guessed(places)
        if found is None:
            return None
        poses, times = found
        if times is not None:
            self._stamp, self._timed = times, True
        return poses

    def _guessed(self, places: list[Path]) -> Fit | None:
        """Return the poses of the text that has a word of poses in its name and fits the scans (see
        `_fitting`), with a warning that names it; None if there is none. Of several with the same steps, that
        with most poses is used; of others none, with a warning. Arguments as in `_read_poses`."""
        fits = list[tuple[Path, Fit]]()
        for place in places if self._timed else places[:2]:
            for path in _texts_of_poses(place):
                with suppress(TextError, OSError):
                    fits.append((path, self._fitting(path, None, by_time=place in places[2:])))
        if not fits:
            return None
        names = named(sorted(path.name for path, _ in fits))
        if any(not _have_same_steps(fits[0][1][0], fit[0]) for _, fit in fits[1:]):
            self._warnings.append(
                f"none of {names} is used: each may have the poses, and they disagree; choose one with "
                "--odometry file:"
            )
            return None
        path, fit = max(fits, key=lambda found: sum(pose is not None for pose in found[1][0]))
        self._warnings.append(f"the motion is that in {path.name}, which was found by its name")
        self._texts.append(path)
        return fit

    def _read_views(self) -> list[Pose3 | None] | None:
        """Return the pose of the sensor in the header of each PCD file; None if most files have none."""
        if self._suffix != ".pcd" or len(self._files) < 2:
            return None
        views = [_view_of(file) for file in self._files]
        if 2 * sum(view is not None for view in views) < len(views):
            return None
        self._warnings.append("the motion is that of the sensor in the headers of the files (VIEWPOINT)")
        # The first sensor is often the origin, which the header does not distinguish from no pose.
        return [view or (Pose3.identity() if k == 0 else None) for k, view in enumerate(views)]

    def _find_frame(self, poses: list[Pose3 | None]) -> None:
        """Find out by the scans whether their points are in the frame of the sensor or already in that of the
        poses, from which they are then moved back.

        Points are dense near the sensor that measured them: their mean logarithmic range counts from there.

        Args:
            poses: Pose of each scan.
        """
        moved = [k for k, pose in enumerate(poses) if pose is not None and np.hypot(*pose.t[:2]) > _DECISIVE]
        gains = []
        for k in moved[:: max(1, len(moved) // _TRIES)][:_TRIES]:
            pose = poses[k]
            try:
                columns = _columns_of(self._files[k], {})
            except (ScanFileError, OSError):
                continue
            points = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
            points = points[np.isfinite(points).all(axis=1) & (points != 0.0).any(axis=1)]
            if pose is not None and len(points):
                gains.append(_mean_log(points) - _mean_log(points - pose.t))
        if gains and float(np.median(gains)) > 0.0:
            self._T_file_lidar = {
                file: pose for file, pose in zip(self._files, poses, strict=True) if pose is not None
            }
            self._warnings.append(
                "the points of the scans are in the frame of their poses: each was moved back by its pose"
            )

    def _decide_times(self) -> PointTimes | None:
        """Return how the times of points are read, by the first _TRIES files; None without times. Times that
        cannot be used, and those by the order of the points, become a warning."""
        scans = []
        for file, stamp_ns in zip(self._files[:_TRIES], self._stamp.tolist(), strict=False):
            try:
                timed = timed_scan(stamp_ns, _columns_of(file, {}))
            except (ScanFileError, OSError):
                continue
            # The order of points that were moved to another frame gives no direction of the sensor.
            scans.append(replace(timed, points=None) if file in self._T_file_lidar else timed)
        times, why = decide_point_times(scans)
        if why:
            self._warnings.append(f"the times of points cannot be used, so scans are not de-skewed: {why}")
        elif times is not None and times.field == FIRING_ORDER:
            self._warnings.append(f"times of points: {times.words}")
        return times

    def _load_scan(self, file: Path, stamp_ns: int, losses: dict[str, int]) -> Scan:
        """Return the scan of a file in the frame of the sensor, which may have no points; errors and `losses`
        as of `_columns_of`."""
        columns = _columns_of(file, losses)
        pose = self._T_file_lidar.get(file)
        if pose is None:
            return scan_of(stamp_ns, columns, self._times)
        points = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
        nothing = ~(points != 0.0).any(axis=1)
        with np.errstate(invalid="ignore", over="ignore"):
            points = (points - pose.t) @ pose.R
        points[nothing] = np.nan  # a beam without a return
        return scan_of(stamp_ns, {**columns, **dict(zip("xyz", points.T, strict=True))}, self._times)

    def _fitting(self, path: Path, numbers: Int | None, *, by_time: bool = False) -> Fit:
        """Return the pose of each scan, None for a scan without one, in a file of poses, and the times of
        their rows for scans without times [ns], int64, shape (N,), or None.

        Args:
            path: The file.
            numbers: Number in the name of each scan file, which may select its row; None for a file of which
                only its name tells that it has poses: most scans must be at its times, or it must have as
                many rows as there are scans.
            by_time: Whether only times tell that the rows belong to the scans.

        Raises:
            TextError: The rows do not belong to the scans, or errors as those of `read_pose_rows`.
            OSError: The file cannot be read.
        """
        times, frames, rows = read_pose_rows(path)
        if frames is not None:
            row_of = dict(zip(frames.tolist(), rows, strict=True))
            named_poses = [row_of.get(number) for number in self._numbers.tolist()]
            if all(pose is None for pose in named_poses):
                raise TextError("its frames are not those of the scans")
            return named_poses, None
        if times is not None and self._timed:
            poses = [pose_at(times, rows, int(stamp_ns)) for stamp_ns in self._stamp]
            count = sum(pose is not None for pose in poses)
            if not count or (numbers is None and 2 * count < len(poses)):
                raise TextError("its times are not those of the scans")
            return poses, None
        if by_time or (numbers is None and len(rows) != len(self._files)):
            raise TextError("its rows are not those of the scans")
        chosen = _rows(len(rows), np.arange(len(rows)) if numbers is None else numbers)
        return [rows[k] for k in chosen.tolist()], None if times is None else times[chosen]


def _rows(count: int, numbers: Int) -> Int:
    """Return the row of each scan in a text file, int64, shape (N,): the number of the scan if there are
    enough rows, else its index if there are as many rows as scans.

    Args:
        count: Number of rows of the file.
        numbers: Number in the name of each scan file, ascending; 0 is the first row.

    Raises:
        TextError: Neither fits.
    """
    if count > int(numbers[-1]):
        return numbers
    if count == len(numbers):
        return np.arange(count, dtype=np.int64)
    raise TextError(f"it has {count} rows, the scans are numbered up to {int(numbers[-1])}")


def _have_same_steps(first: list[Pose3 | None], second: list[Pose3 | None]) -> bool:
    """Return whether two lists of the poses of the same scans, None for a scan without one, have the same
    steps of _STEP or more, most of them up to _STEP_SHARE of the length and _STEP_TURN; False without a
    step."""
    same = list[bool]()
    begin: tuple[Pose3, Pose3] | None = None
    for now in zip(first, second, strict=True):
        if now[0] is None or now[1] is None:
            continue
        begin = begin or (now[0], now[1])
        a, b = begin[0].inverse() @ now[0], begin[1].inverse() @ now[1]
        if (length := np.linalg.norm(a.t)) < _STEP:
            continue
        is_near = np.linalg.norm(a.t - b.t) < _STEP_SHARE * length
        same.append(bool(is_near and np.abs(a.R - b.R).max() < _STEP_TURN))
        begin = now[0], now[1]
    return bool(same) and float(np.mean(same)) > 0.5


def _texts_of_poses(place: Path) -> list[Path]:
    """Return the texts in a folder that may have poses by their names, sorted; [] if it cannot be read."""
    try:
        return sorted(p for p in place.iterdir() if p.suffix in _TEXTS and _POSE_WORDS.search(p.stem))
    except OSError:
        return []


def _refuse_clouds(files: list[Path], uri: str) -> None:
    """Raise SourceError if the first of several files is a cloud by its points."""
    if len(files) > 1 and (form := form_of(files[0], None)).is_cloud:
        suffix = files[0].suffix.lower()
        raise SourceError(
            f"its {len(files)} {suffix} files are clouds or tiles of one, not scans of a drive: {form.why}",
            where=uri,
            remedy="Merge the tiles into one file, or map each by itself; --as scan takes them as scans",
        )


def _view_of(file: Path) -> Pose3 | None:
    """Return the pose of the sensor in the header of a PCD file; None without one."""
    try:
        return open_table(file).view
    except (ScanFileError, OSError):
        return None


def _mean_log(points: Float) -> float:
    """Return the mean logarithm of the distances of points, shape (N, 3), from the origin."""
    return float(np.log(np.maximum(np.linalg.norm(points, axis=1), 0.1)).mean())


def _scan_files(path: Path) -> tuple[str, list[Path]]:
    """Return the suffix of the scans in a folder, or in its folder `velodyne` if it has no .bin file itself,
    and the files with this suffix by number or time; if `path` is a file, only this one, with the suffix .pcd
    if its own is not one of a scan. Without .bin files it is .pcd, or else the most frequent
    suffix of a scan; there may be no files. OSError if it cannot be read."""
    if path.is_file():
        return path.suffix.lower() if path.suffix.lower() in _names_of_scans() else ".pcd", [path]
    inside = path / "velodyne"
    for folder in (path, inside) if inside.is_dir() else (path,):
        if bins := [file for file in folder.iterdir() if file.suffix.lower() == ".bin" and file.is_file()]:
            return ".bin", _in_order(bins)
    suffixes = [file.suffix.lower() for file in path.iterdir() if file.is_file()]
    suffix = ".pcd" if ".pcd" in suffixes else max(_names_of_scans(), key=suffixes.count)
    return suffix, _in_order([f for f in path.iterdir() if f.suffix.lower() == suffix and f.is_file()])


def _names_of_scans() -> dict[str, str]:
    """Return a dict from the suffixes of scans to the names of their formats."""
    return {suffix: kind.scans for kind in formats() if kind.scans for suffix in kind.suffixes}


def _in_order(files: list[Path]) -> list[Path]:
    """Return files sorted by the times in their names if all names are times, else by the numbers at the ends
    of their names (those without a number first); equal ones by name."""
    keys = _names_ns(files) or [_number(file) for file in files]
    return [file for _, _, file in sorted(zip(keys, [f.name for f in files], files, strict=True))]


def _times_in_names(files: list[Path]) -> Int | None:
    """Return the times in the names of the files [ns], int64, shape (N,); None if a name is not a time, or
    the times do not strictly ascend."""
    stamps = _names_ns(files)
    return None if stamps is None or np.any(np.diff(stamps) <= 0) else np.array(stamps, dtype=np.int64)


def _names_ns(files: list[Path]) -> list[int] | None:
    """Return the times in the names of files [ns]: seconds with decimals, or seconds and a whole number of
    smaller units, which may lack its leading zeros, or micro- or nanoseconds since 1970; None if a name is
    not a time."""
    matches = [match for file in files if (match := _TIME_NAME.fullmatch(file.stem))]
    if len(matches) < len(files):
        return None
    words = [match.group(1) for match in matches]
    digits = max((len(word.partition("_")[2]) for word in words), default=0)
    try:
        return [
            seconds_ns(f"{whole}.{units.zfill(digits)}") if units else time_ns(word)
            for word in words
            for whole, _, units in [word.partition("_")]
        ]
    except ValueError:  # too far away
        return None


def _number(file: Path) -> int:
    """Return the number at the end of the name of a file, of which at most the last nine digits are used; -1
    if it does not end with a digit."""
    match = re.search(r"[0-9]{1,9}$", file.stem)
    return int(match.group()) if match else -1


# --- formats ---------------------------------------------------------------------------------------

HDL_64 = Sensor("HDL-64", 64, float(np.radians(0.4)), float(np.radians(0.17)), 0.03, 120.0)


def _columns_of(file: Path, losses: dict[str, int]) -> Columns:
    """Return the columns of a file of points, see `read_columns`; ScanFileError also if most rows of a .bin
    file, which has no header, are not positions."""
    missing = dict[str, int]()
    columns = read_columns(open_table(file), missing)
    if file.suffix.lower() == ".bin":
        with np.errstate(invalid="ignore"):
            sound = np.all([np.abs(columns[axis]) < RANGE_LIMIT for axis in "xyz"], axis=0)
        if 2 * int(np.count_nonzero(sound)) < len(sound):
            raise ScanFileError("most of its rows are no positions")
    for reason, number in missing.items():
        count_loss(losses, reason, number)
    return columns


def _kitti_sensor(scan: Scan) -> Sensor:
    """Return an HDL-64 when the scan looks like one: all around, dense, and from -25 to +3 degrees; otherwise
    the result of `sensor_of`. The scan has points."""
    points = scan.points.astype(np.float64)
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    low, high = np.percentile(elevation, [0.5, 99.5])
    sectors = len(np.unique(np.floor(np.arctan2(points[:, 1], points[:, 0]) / np.radians(10.0))))
    dense = len(points) > 50_000 and sectors >= 30
    return sensor_of(scan, HDL_64 if dense and -27.0 < low < -20.0 and 1.0 < high < 6.0 else None)
