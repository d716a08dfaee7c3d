"""Files that hold points as a table, a column for each value: PLY, NumPy's .npy and .npz, PCD.

One file is opened by `open_table` and read part by part (a whole cloud) or at once by `read_columns` (a
scan). Headers are held against the size of the file before memory is taken, and no pickle is read.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pipeline.io.readers.point_files.table import Columns, PointTable, read_columns

__all__ = ["MAGIC", "Columns", "PointTable", "open_table", "read_columns"]

#: What such files begin with, by the name that they usually have; NumPy's .npz is a .zip by its contents.
MAGIC = {
    ".ply": (b"ply\n", b"ply\r"),
    ".npy": (b"\x93NUMPY",),
    ".npz": (b"PK\x03\x04", b"PK\x05\x06"),
    ".pcd": (b"# .PCD", b"VERSION", b"FIELDS"),
}


def open_table(path: Path) -> PointTable:
    """Open one file by its contents; nothing but its header is read.

    Raises:
        ScanFileError: It is none of these, contradicts itself, or has no x, y and z.
        OSError: It cannot be read.
    """
    from pipeline.io.readers.point_files.numpy_arrays import open_npy, open_npz
    from pipeline.io.readers.point_files.pcd_table import open_pcd_table
    from pipeline.io.readers.point_files.ply import open_ply
    from pipeline.io.readers.scan_folder import ScanFileError

    with path.open("rb") as file:
        head = file.read(16)
    openers: dict[str, Callable[[Path], PointTable]] = {
        ".ply": open_ply,
        ".npy": open_npy,
        ".npz": open_npz,
        ".pcd": open_pcd_table,
    }
    for suffix, marks in MAGIC.items():
        if head.startswith(marks):
            return openers[suffix](path)
    raise ScanFileError("its contents are not those of a PLY, NumPy or PCD file")
