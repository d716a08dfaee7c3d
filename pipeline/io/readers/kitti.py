"""KITTI .bin scans: rows of four little-endian float32, x, y, z [m] and reflectance."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.io.readers.base import SourceOptions
from pipeline.io.readers.container import count_loss
from pipeline.io.readers.scan_columns import POINT_LIMIT, RANGE_LIMIT, clean_scan, sensor_of
from pipeline.io.readers.scan_folder import ScanFileError, ScanFolder, ScanFormat
from pipeline.types.records import Scan, Sensor

_ROW = 16
HDL_64 = Sensor("HDL-64", 64, float(np.radians(0.4)), float(np.radians(0.17)), 0.03, 120.0)


def open_kitti(uri: str, path: Path, options: SourceOptions) -> ScanFolder:
    """Open a .bin file, a folder of them, or a folder with a folder `velodyne` of them.

    Raises:
        SourceError: None of the first files holds a scan.
        OSError: The folder cannot be read.
    """
    return ScanFolder(uri, path, ScanFormat("KITTI .bin", ".bin", load_bin, _sensor), options)


def load_bin(path: Path, stamp_ns: int, losses: dict[str, int]) -> Scan:
    """Read one .bin file; a last row that was cut is left out and counted.

    Raises:
        ScanFileError: It is too large, or most of its rows are no positions: it is another thing.
        OSError: It cannot be read.
    """
    size = path.stat().st_size
    if size > POINT_LIMIT * _ROW:
        raise ScanFileError(f"{size} bytes are too many for one scan")
    rows = np.fromfile(path, dtype="<f4", count=size // _ROW * 4).reshape(-1, 4)
    with np.errstate(invalid="ignore"):
        sound = (np.abs(rows[:, :3]) < RANGE_LIMIT).all(axis=1)
    if 2 * int(np.count_nonzero(sound)) < len(rows):
        raise ScanFileError("most of its rows are no positions")
    scan = clean_scan(stamp_ns, rows[:, :3], reflectance=rows[:, 3])
    if size % _ROW:
        count_loss(losses, "scan files that end within a point")
    return scan


def _sensor(scan: Scan) -> Sensor:
    """HDL-64 when the scan looks like one: all around, dense, and from -25 to +3 degrees."""
    points = scan.points.astype(np.float64)
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    low, high = np.percentile(elevation, [0.5, 99.5])
    sectors = len(np.unique(np.floor(np.arctan2(points[:, 1], points[:, 0]) / np.radians(10.0))))
    dense = len(points) > 50_000 and sectors >= 30
    return HDL_64 if dense and -27.0 < low < -20.0 and 1.0 < high < 6.0 else sensor_of(scan)
