"""PCD files, one a scan, as a source."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.io.readers.base import SourceOptions
from pipeline.io.readers.pcd_file import read_pcd
from pipeline.io.readers.point_files import Columns
from pipeline.io.readers.scan_columns import (
    REFLECTANCE,
    RING,
    TIME,
    clean_scan,
    first_of,
    is_ring,
    point_offsets,
    sensor_of,
)
from pipeline.io.readers.scan_folder import ScanFolder, ScanFormat
from pipeline.types.records import Scan


def open_pcd(uri: str, path: Path, options: SourceOptions) -> ScanFolder:
    """Open a .pcd file or a folder of them.

    Raises:
        SourceError: None of the first files holds a scan.
        OSError: The folder cannot be read.
    """
    return ScanFolder(uri, path, ScanFormat("PCD", ".pcd", load_pcd, sensor_of), options)


def load_pcd(path: Path, stamp_ns: int, losses: dict[str, int]) -> Scan:
    """Read one .pcd file as a scan; rows of NaN, as organised clouds have them, are no returns.

    Raises:
        ScanFileError: See `read_pcd`.
        OSError: It cannot be read.
    """
    return scan_of(read_pcd(path, losses), stamp_ns)


def scan_of(columns: Columns, stamp_ns: int) -> Scan:
    """A scan of the columns of a table; x, y and z [m] are among them."""
    kind = np.float64 if any(columns[axis].dtype.itemsize > 4 for axis in "xyz") else np.float32
    with np.errstate(invalid="ignore", over="ignore"):
        points = np.stack([columns[axis].astype(kind) for axis in "xyz"], axis=1)
    ring, time = first_of(columns, RING), first_of(columns, TIME)
    return clean_scan(
        stamp_ns,
        points,
        reflectance=first_of(columns, REFLECTANCE),
        ring=ring if ring is not None and is_ring(ring) else None,
        offset_ns=None if time is None else point_offsets(time, stamp_ns),
    )
