"""Folders of PLY, NumPy or LAS files, one a scan, as a source."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.errors import SourceError
from pipeline.io.readers.base import SourceOptions
from pipeline.io.readers.container import count_loss
from pipeline.io.readers.pcd import scan_of
from pipeline.io.readers.point_files import read_columns
from pipeline.io.readers.scan_columns import POINT_LIMIT, clean_scan, sensor_of
from pipeline.io.readers.scan_folder import ScanFileError, ScanFolder, ScanFormat
from pipeline.types.records import Scan

_KINDS = {".ply": "PLY", ".npy": "NumPy", ".npz": "NumPy", ".las": "LAS", ".laz": "LAS"}


def open_table_scans(uri: str, folder: Path, options: SourceOptions) -> ScanFolder:
    """Open a folder of scans; of several kinds the one with the most files is read.

    Raises:
        SourceError: None of the first files holds a scan.
        OSError: The folder cannot be read.
    """
    counts = dict.fromkeys(_KINDS, 0)
    for file in folder.iterdir():
        if file.suffix.lower() in counts:
            counts[file.suffix.lower()] += 1
    suffix = max(counts, key=lambda each: counts[each])
    load = load_las if suffix in (".las", ".laz") else load_table
    return ScanFolder(uri, folder, ScanFormat(_KINDS[suffix], suffix, load, sensor_of), options)


def load_table(path: Path, stamp_ns: int, losses: dict[str, int]) -> Scan:
    """Read one PLY or NumPy file as a scan.

    Raises:
        ScanFileError: See `read_columns`.
        OSError: It cannot be read.
    """
    return scan_of(read_columns(path, losses), stamp_ns)


def load_las(path: Path, stamp_ns: int, losses: dict[str, int]) -> Scan:
    """Read one LAS or LAZ file as a scan: its coordinates are those of the sensor's frame.

    Raises:
        ScanFileError: It is damaged or too large.
        OSError: It cannot be read.
    """
    from pipeline.io.readers.clouds.las import LasCloud

    try:
        cloud = LasCloud(str(path), path)
        if cloud.description.points > POINT_LIMIT:
            raise ScanFileError(
                f"its header promises {cloud.description.points} points, too many for one scan"
            )
        parts = list(cloud.parts())
    except SourceError as error:
        raise ScanFileError(error.what) from None
    for reason, number in cloud.losses.items():
        count_loss(losses, reason, number)
    points = np.concatenate(parts) if parts else np.zeros((0, 3), np.float32)
    return clean_scan(stamp_ns, points + cloud.description.offset)
