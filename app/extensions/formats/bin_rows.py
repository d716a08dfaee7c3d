"""Scans of nuScenes, Boreas and NCLT as rows without a header, beside those of KITTI."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.io.readers import head_of
from pipeline.io.readers.point_files import Columns, PointTable, ScanFileError, rows_table
from pipeline.io.readers.scan_columns import RANGE_LIMIT

_KITTI = ("x", "y", "z", "intensity")
#: Rows of float32. Those of NCLT are whole numbers.
_ROWS = {
    "KITTI": _KITTI,
    "nuScenes": (*_KITTI, "ring"),
    "Boreas": (*_KITTI, "ring", "time"),
}
_NCLT = np.dtype([("x", "<u2"), ("y", "<u2"), ("z", "<u2"), ("intensity", "u1"), ("laser", "u1")])
#: Unit and offset of the coordinates of NCLT [m], whose y points to the right and z down.
_NCLT_UNIT, _NCLT_ZERO = 0.005, -100.0
#: Height from the sensor that few returns of a drive exceed [m]: the LiDARs of these data sets (HDL-64E,
#: HDL-32E, VLS-128) look up by 15 degrees at most, which is 50 m at a distance of 190 m.
_HIGHEST = 50.0
_TESTED_ROWS = 48_000  # bytes, whole rows of each kind
#: Smaller files are KITTI: less than 20 rows may fit to another layout by chance.
_LEAST = 320  # bytes
_FITTING = 0.99  # share of rows that are sound by the right layout; the rest is damage


def is_of_other_data_set(head: bytes) -> bool:
    """Return whether only rows of nuScenes, Boreas or NCLT give positions and reflectances at the beginning
    of a file, not those of KITTI."""
    return _layout_of(head) not in ("", "KITTI")


def open_rows(path: Path) -> PointTable:
    """Return the table of a .bin file of one of these data sets.

    Raises:
        ScanFileError: It is of none of them, or too large.
        OSError: The file cannot be read.
    """
    layout = _layout_of(head_of(path))
    if not layout:
        raise ScanFileError("its rows are no positions")
    if layout != "NCLT":
        return rows_table(path, f"{layout} .bin", _dtype(_ROWS[layout]))
    table = rows_table(path, "NCLT .bin", _NCLT)
    return replace(table, read=lambda begin: (_metres(part) for part in table.read(begin)))


def _layout_of(head: bytes) -> str:
    """Return the data set whose rows a file has by its first bytes; "" for none."""
    if len(head) < _LEAST:
        return ""
    head = head[:_TESTED_ROWS]
    layouts = (name for name, names in _ROWS.items() if _are_rows(_first_rows(head, _dtype(names))))
    nclt = (name for name in ("NCLT",) if _are_rows(_metres(_first_rows(head, _NCLT))))
    return next(layouts, next(nclt, ""))


def _dtype(names: tuple[str, ...]) -> np.dtype[Any]:
    """Return the type of a row of float32."""
    return np.dtype([(name, "<f4") for name in names])


def _first_rows(head: bytes, dtype: np.dtype[Any]) -> Columns:
    """Return the columns of the whole rows at the beginning of a file."""
    rows = np.frombuffer(head, dtype, len(head) // dtype.itemsize)
    return {name: rows[name] for name in dtype.names or ()}


def _metres(columns: Columns) -> Columns:
    """Return columns of NCLT with coordinates in metres, y to the left and z up."""
    x, y, z = (columns[axis].astype(np.float64) * _NCLT_UNIT + _NCLT_ZERO for axis in "xyz")
    return {**columns, "x": x, "y": -y, "z": -z}


def _are_rows(columns: Columns) -> bool:
    """Return whether nearly all rows without NaN have coordinates of a scan and a reflectance, and there are
    such rows."""
    with np.errstate(invalid="ignore"):  # signalling NaN, in a damaged file
        rows = np.column_stack([columns[name].astype(np.float64) for name in _KITTI])
    x, y, z, reflectance = rows[~np.isnan(rows).any(axis=1)].T
    sound = (np.maximum(np.abs(x), np.abs(y)) < RANGE_LIMIT) & (np.abs(z) < _HIGHEST) & (reflectance >= 0.0)
    return bool(sound.size and sound.mean() > _FITTING)
