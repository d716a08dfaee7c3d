"""Ground truth: tables of trees (CSV) with the headers of other tools, and the JSON attachment of simulated
recordings."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Float
from pipeline.io.csv_table import CsvTable, refuse_faults
from pipeline.io.readers.base import COORDINATE_LIMIT
from pipeline.types.records import HIDDEN, Sensor, Truth, TruthPath, TruthTrees

KINDS = ("tree", "pole", "person", "bush", "other", HIDDEN)
LARGEST_FILE = 8 << 20
_X = ("x_m", "x", "treelocationx", "easting", "easting_m", "east", "utm_x")
_Y = ("y_m", "y", "treelocationy", "northing", "northing_m", "north", "utm_y")
_AZIMUTH = ("azimuth_deg", "azimuth")
_DISTANCE = ("distance_m", "distance", "dist_m")
_UNITS = {"cm": 0.01, "m": 1.0, "mm": 0.001}  # [m]
#: Names of diameters with their units [m]; `bhd` is the German abbreviation.
_DBH = {f"{name}_{unit}": metres for name in ("dbh", "bhd") for unit, metres in _UNITS.items()}
_DBH_OF_UNKNOWN_UNIT = ("dbh", "bhd", "diameter")
#: Names of columns of diameters.
DBH_COLUMNS = (*_DBH, *_DBH_OF_UNKNOWN_UNIT)
#: Range of the median diameter of a table [m]: from a seedling's to that of the thickest trees there are.
_MEDIAN_DBH = (0.005, 3.0)
KIND_COLUMNS = ("class", "kind", "type")
#: Index of the row and error of each fault in a table, see `refuse_faults`.
Faults = list[tuple[int, SourceError]]


def read_truth_trees(path: Path, *, dbh_unit: str | None = None) -> TruthTrees:
    """Read a table of trees.

    Diameters are in metres in the result, NaN where they are unknown, 0 or negative. Positions are x and y
    (or easting and northing) in metres, or azimuth in degrees from north (y), clockwise, with a distance in
    metres from the origin. A table with both uses x and y. The class of a row is one of KINDS, in any case;
    rows with an empty class, and all rows without such a column, are trees.

    Args:
        path: A CSV with a header line; commas, semicolons or tabs. See `CsvTable` for decimal commas.
        dbh_unit: "m", "cm" or "mm" for a column `dbh` without a unit; None refuses such a column.

    Raises:
        SourceError: The file cannot be read, is larger than 8 MB, has no columns of positions or a class that
            is not one of KINDS, a number is invalid or beyond COORDINATE_LIMIT, the unit of diameters is
            unknown, or their median is outside of 5 mm to 3 m. The message names the first 10 lines with
            faults.
    """
    faults: Faults = []
    trees = truth_trees_of(CsvTable.read(path, "table of trees", LARGEST_FILE), faults, dbh_unit=dbh_unit)
    refuse_faults(faults)
    return trees


def truth_trees_of(table: CsvTable, faults: Faults, *, dbh_unit: str | None = None) -> TruthTrees:
    """Return the trees of a table as `read_truth_trees` does, a tree per row. A header without rows gives no
    trees.

    Args:
        table: The table.
        faults: The fault of each wrong cell is added: a class that is not one of KINDS, or a number that is
            invalid or beyond COORDINATE_LIMIT, which is NaN in the result.
        dbh_unit: As in `read_truth_trees`.

    Raises:
        SourceError: The table has no columns of positions, the unit of diameters is unknown, or their median
            is outside of 5 mm to 3 m.
    """
    x, y = _positions(table, faults)
    dbh = _diameters(table, dbh_unit, faults)
    return TruthTrees(x, y, dbh, _kinds(table, faults))


def _numbers(table: CsvTable, name: str, faults: Faults, *, required: bool = True) -> Float:
    found: dict[int, SourceError] = {}
    numbers = table.numbers(name, required=required, faults=found)
    faults += found.items()
    return numbers


def _positions(table: CsvTable, faults: Faults) -> tuple[Float, ...]:
    """Return x and y of each row, shape (N,) [m], from columns of coordinates or of azimuth and distance.

    Raises:
        SourceError: The table has neither of these columns.
    """
    x, y = table.find(_X), table.find(_Y)
    if x is not None and y is not None:
        return _numbers(table, x, faults), _numbers(table, y, faults)
    azimuth, distance = table.find(_AZIMUTH), table.find(_DISTANCE)
    if azimuth is None or distance is None:
        raise SourceError(
            "the table has no position",
            where=table.where,
            remedy="Name the columns x_m and y_m, easting and northing, or azimuth_deg and distance_m; it "
            f"has {', '.join(table.column) or 'no header'}",
        )
    angle = np.radians(_numbers(table, azimuth, faults))
    reach = _numbers(table, distance, faults)
    return reach * np.sin(angle), reach * np.cos(angle)


def _diameters(table: CsvTable, dbh_unit: str | None, faults: Faults) -> Float:
    """Return diameters [m], shape (N,); NaN if there is no column of diameters, and for 0 and negative
    numbers.

    Args:
        table: The table.
        dbh_unit: Unit of a column whose name does not state it: "m", "cm" or "mm".
        faults: See `truth_trees_of`.

    Raises:
        SourceError: The unit is unknown, or the median is outside of _MEDIAN_DBH.
    """
    name = table.find(DBH_COLUMNS)
    if name is None:
        return np.full(len(table.rows), np.nan)
    unit = _DBH.get(name) or _UNITS.get(dbh_unit or "")
    if unit is None:
        what = f"column {name!r} does not say its unit"
        raise SourceError(what, where=table.where, remedy="Give --dbh-unit m, cm or mm")
    diameter = _numbers(table, name, faults, required=False) * unit
    known = diameter[diameter > 0.0]
    median = float(np.median(known)) if len(known) else 1.0
    if not _MEDIAN_DBH[0] <= median <= _MEDIAN_DBH[1]:
        what = (
            f"the median diameter is {median:.1f} m"
            if median > 1.0
            else f"the median diameter is {1000 * median:.2f} mm"
        )
        raise SourceError(
            what,
            where=table.where,
            remedy=f"Check the unit of the column {name}: a name that ends in _cm, _m or _mm states it",
        )
    return np.where(diameter > 0.0, diameter, np.nan)


def _kinds(table: CsvTable, faults: Faults) -> tuple[str, ...]:
    """Return the class of each row in lower case; "tree" for an empty cell, and for all rows if there is no
    column of classes."""
    name = table.find(KIND_COLUMNS)
    if name is None:
        return ("tree",) * len(table.rows)
    kinds = tuple(text.lower() or "tree" for text in table.text(name))
    for row, kind in enumerate(kinds):
        if kind not in KINDS:
            what = f"line {table.lines[row]}: class {kind!r} is not one of {', '.join(KINDS)}"
            faults.append((row, SourceError(what, where=table.where)))
    return kinds


ATTACHMENT = "stemmap_truth.json"
SIZE_LIMIT = 64 << 20
_LIMIT = COORDINATE_LIMIT
Rows = Annotated[
    list[Annotated[float, msgspec.Meta(ge=-_LIMIT, le=_LIMIT)]], msgspec.Meta(max_length=2_000_000)
]


_UNKNOWN = Sensor()


class _Sensor(msgspec.Struct, frozen=True):
    name: str = _UNKNOWN.name
    rings: Annotated[int, msgspec.Meta(ge=0, le=1024)] = _UNKNOWN.rings
    ring_step: Annotated[float, msgspec.Meta(ge=0, le=3.2)] = _UNKNOWN.ring_step
    azimuth_step: Annotated[float, msgspec.Meta(gt=0, le=3.2)] = _UNKNOWN.azimuth_step
    range_sigma: Annotated[float, msgspec.Meta(gt=0, le=10)] = _UNKNOWN.range_sigma
    range_max: Annotated[float, msgspec.Meta(gt=0, le=10_000)] = _UNKNOWN.range_max


class _TreeColumns(msgspec.Struct, frozen=True):
    x: Rows
    y: Rows
    dbh: Annotated[list[float | None], msgspec.Meta(max_length=2_000_000)]
    kind: Annotated[
        list[Literal["tree", "pole", "person", "bush", "other", "hidden"]], msgspec.Meta(max_length=2_000_000)
    ]


class _Path(msgspec.Struct, frozen=True):
    stamp_ns: Annotated[
        list[Annotated[int, msgspec.Meta(ge=0, lt=2**62)]], msgspec.Meta(max_length=2_000_000)
    ]
    x: Rows
    y: Rows
    yaw: Rows


class _TruthFile(msgspec.Struct, frozen=True):
    version: Literal[1]
    sensor: _Sensor | None = None
    trees: _TreeColumns | None = None
    path: _Path | None = None


def read_truth(content: bytes, where: str) -> tuple[Truth, Sensor | None]:
    """Return the ground truth in the map frame, and the sensor (None if it is not named), of an attachment.
    Trees and path of the result are None if they are missing; the path is sorted by time.

    Args:
        content: JSON of `truth_json`.
        where: Name of the recording in errors.

    Raises:
        SourceError: The content is not JSON of this form and version, a coordinate is beyond 1e8, a property
            of the sensor is out of bounds, or columns differ in length.
    """
    try:
        file = msgspec.json.decode(content, type=_TruthFile)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise SourceError(f"the attached ground truth cannot be read: {error}", where=where) from error
    for columns in (file.trees, file.path):
        if columns is not None and len({len(column) for column in msgspec.structs.astuple(columns)}) != 1:
            raise SourceError("the columns of the attached ground truth differ in length", where=where)
    trees = None if file.trees is None else _trees(file.trees)
    path = None if file.path is None else _path(file.path)
    sensor = None if file.sensor is None else Sensor(**msgspec.structs.asdict(file.sensor))
    return Truth(trees, path), sensor


def _trees(columns: _TreeColumns) -> TruthTrees:
    """Return columns of a file as trees; unknown diameters become NaN."""
    dbh = [np.nan if diameter is None else diameter for diameter in columns.dbh]
    return TruthTrees(np.array(columns.x), np.array(columns.y), np.array(dbh, float), tuple(columns.kind))


def _path(columns: _Path) -> TruthPath:
    """Return the columns of a file, which are in the frame of the map, as the true path, sorted by time."""
    stamp_ns = np.array(columns.stamp_ns, dtype=np.int64)
    order = np.argsort(stamp_ns, kind="stable")
    x, y, yaw = (np.array(column, dtype=np.float64)[order] for column in (columns.x, columns.y, columns.yaw))
    return TruthPath(stamp_ns[order], x, y, yaw, same_frame=True)


def truth_json(sensor: Sensor, truth: Truth | None) -> bytes:
    """Return the JSON of the attachment: "version", "sensor", and, if known, "trees" (columns x, y, dbh, null
    where unknown, and kind) and "path" (columns stamp_ns, x, y, yaw).

    A path in another frame than that of the map, or without finite yaws, is left out.

    Args:
        sensor: The LiDAR.
        truth: Ground truth; None, or missing parts of it, are left out. Positions must be finite (else
            ValueError).
    """
    content: dict[str, Any] = {"version": 1, "sensor": asdict(sensor)}
    if truth is not None and truth.trees is not None:
        trees = truth.trees
        content["trees"] = {
            "x": trees.x.tolist(),
            "y": trees.y.tolist(),
            "dbh": [float(dbh) if np.isfinite(dbh) else None for dbh in trees.dbh],
            "kind": list(trees.kind),
        }
    if truth is not None and truth.path is not None:
        path = truth.path
        if path.same_frame and np.isfinite(path.yaw).all():
            content["path"] = {
                "stamp_ns": path.stamp_ns.tolist(),
                "x": path.x.tolist(),
                "y": path.y.tolist(),
                "yaw": path.yaw.tolist(),
            }
    return json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
