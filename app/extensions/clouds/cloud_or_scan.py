"""Whether a file of points is a whole cloud or one scan of a LiDAR, by what it holds: both come as .pcd."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from pipeline.io.readers import FILES, Form, points_format
from pipeline.io.readers.base import COORDINATE_LIMIT, SourceOptions
from pipeline.io.readers.point_files import PART, Columns, PointTable, ScanFileError, open_table
from pipeline.io.readers.point_times import time_fields
from pipeline.io.readers.scan_columns import RING
from pipeline.types.records import Float

#: More points than one sweep: 128 rings at 5 Hz give 480,000.
SWEEP_LIMIT = 500_000
#: A scan has its sensor at the origin; coordinates this large are those of a country [m].
_FAR = 10_000.0
#: Share of the points whose neighbour in direction, seen from the origin, is at another range. A beam ends at
#: the first surface, so neighbours in a sweep differ at edges only: 0.02 to 0.15 in scans of parks, streets
#: and forests (VLP-16, HDL-64, XT32, 40P, solid state), 0.18 where they were thinned to 10 cm; 0.21 to 0.58
#: in plots and maps, of which every part was seen from somewhere else.
_HIDDEN = 0.2
#: The share in scans that were thinned to few points is up to 0.28; also needed against columns of a sweep.
_MOSTLY_HIDDEN, _FEW = 0.3, 20_000
#: Ratio of ranges that are different: 10 %.
_OTHER_RANGE = 0.1
#: The angle between neighbours is that of the beams in a sweep, near or far: over the range it has the
#: exponent 0 (-0.3 in scans that were thinned to 10 cm), and a tenth and nine tenths of the points differ by
#: at most a factor of e^1.5, where beams are random. In a map the points are as dense in space far from the
#: origin as near to it: exponents of -0.5 to -1.4, factors of e^1.7 to e^2.5.
_FALLING, _SPREAD, _SPREAD_OF_FEW = -0.4, 1.3, 1.6
#: Height of the field of view [degrees]: 90 for the tallest LiDARs of robots (OS0), 140 and more for scanners
#: on a tripod.
_TALLEST = 110.0
_SAME_BEAM = 1e-5  # rad; two returns of one beam
_TESTED = 20_000  # points

_AXES = ("x", "y", "z")
_LARGEST = 1000.0 * COORDINATE_LIMIT  # of a coordinate in millimetres; larger ones are damaged
_SAMPLED = 400_000  # points of a sample
_PLACES = 16  # of the file from which they are taken
_LEAST_POINTS = 1000  # by which whole numbers are known
#: Suffixes of tiles of a cloud, and points of one; the form of files with fewer points is not clear.
_TILES, _LEAST_OF_TILE = (".las", ".laz", ".ply"), 20_000


def is_decided_by_points(table: PointTable) -> bool:
    """Return whether the points of a table decide: of PCD and .bin. PLY and NumPy are formats of whole
    clouds, and scans only if their columns say so."""
    return table.kind.startswith("PCD") or table.kind.endswith(".bin")


def form_of_file(path: Path, options: SourceOptions | None) -> Form:
    """Return whether a file of points is a whole cloud or one scan, see `Format.form`. A file that cannot be
    read is what its format usually is; its opening states the reason."""
    kind = points_format(str(path))
    if kind is None or (options is None and path.suffix.lower() not in _TILES):
        return Form(False)
    if options is not None and (options.form != "auto" or not kind.scans):
        return Form(options.form in ("auto", "cloud"))
    try:
        table = open_table(path)
        if options is None:
            return form_of(table, sample_of(table)) if table.points >= _LEAST_OF_TILE else Form(False)
        return form_of(table, sample_of(table) if is_decided_by_points(table) else None)
    except (ScanFileError, OSError, MemoryError):
        return Form(options is not None and kind not in FILES)


def form_of(table: PointTable, sample: CloudSample | None) -> Form:
    """Return the form of a table of points.

    Args:
        table: The table.
        sample: Points of it; None for a format of whole clouds, of which only the columns are looked at.
    """
    if table.points > SWEEP_LIMIT:
        return Form(True, f"its {table.points:,} points are more than one sweep has")
    columns = [*(name for name in table.names if name in RING), *time_fields(list(table.names))]
    if sample is None:
        return Form(False, f"it has a column {columns[0]}") if columns else Form(True, "of its format")
    points = sample.xyz[(sample.xyz != 0.0).any(axis=1)]
    sound = (np.abs(points) < COORDINATE_LIMIT).all(axis=1)
    if 2 * np.count_nonzero(sound) < len(points):
        return Form(False, "most of its rows are no positions")
    points = points[sound]
    if len(points) and float(np.abs(np.median(points, axis=0)).max()) > _FAR:
        return Form(True, "its coordinates are those of a country")
    if len(points) >= _FEW and (tall := _view_height(points)) > _TALLEST:
        return Form(True, f"it reaches over {tall:.0f} degrees of height, more than a LiDAR of a robot sees")
    hidden, falling, spread = _directions(points)
    words = f"{100.0 * hidden:.0f} % of its points lie behind or before others as seen from its origin"
    if hidden >= _MOSTLY_HIDDEN:
        return Form(True, f"{words}, which one sweep cannot see")
    if columns:
        return Form(False, f"it has a column {columns[0]}")
    if table.height > 1:
        return Form(False, f"it has {table.height} rows, as a sensor writes them")
    is_small = len(points) < _FEW
    if hidden >= _HIDDEN and not is_small:
        return Form(True, f"{words}, which one sweep cannot see")
    if falling <= _FALLING and spread >= (_SPREAD_OF_FEW if is_small else _SPREAD):
        return Form(
            True, "its points are as dense far from its origin as near to it, unlike those of one sweep"
        )
    return Form(False, f"only {words}, as in one sweep")


def _view_height(points: Float) -> float:
    """Return the height of the field in which points, none at the origin, are seen from it [degrees]."""
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    low, high = np.percentile(elevation, [1.0, 99.0])
    return float(high - low)


def _directions(points: Float) -> tuple[float, float, float]:
    """Return how the points look from the origin; 0, 0, 0 for fewer than 100 points.

    Args:
        points: Points, none at the origin, shape (N, 3), in any unit.

    Returns:
        Share of points whose nearest neighbour in direction is at a range that differs by more than
        _OTHER_RANGE; exponent of the angle between these neighbours over the range; and the logarithm of the
        ratio of this angle between nine tenths and a tenth of the points.
    """
    from scipy.spatial import cKDTree

    if len(points) < 100:
        return 0.0, 0.0, 0.0
    distance = np.linalg.norm(points, axis=1)
    direction = points / distance[:, None]
    chosen = np.unique(np.linspace(0, len(points) - 1, _TESTED).astype(np.int64))
    angle, near = cKDTree(direction).query(direction[chosen], k=3)
    other = np.where(near[:, 0] == chosen, near[:, 1], near[:, 0])
    hidden = np.abs(np.log(distance[other] / distance[chosen])) > _OTHER_RANGE
    angle = np.log(np.maximum(np.where(angle[:, 1] > _SAME_BEAM, angle[:, 1], angle[:, 2]), _SAME_BEAM))
    reach = np.log(distance[chosen])
    falling = float(np.cov(reach, angle)[0, 1] / max(float(reach.var()), 1e-12))
    low, high = np.percentile(angle, [10.0, 90.0])
    return float(hidden.mean()), falling, float(high - low)


@dataclass(frozen=True, slots=True, eq=False)
class CloudSample:
    """Points from all over a file.

    Attributes:
        xyz: Points in the unit of the file, finite, shape (N, 3).
        is_integer: Whether the file stores whole numbers.
        is_complete: Whether all points were read, of which these are an even share.
    """

    xyz: Float
    is_integer: bool
    is_complete: bool


def sample_of(table: PointTable) -> CloudSample:
    """Return a sample of at most _SAMPLED points: of a small file (_PLACES x PART points) evenly from all
    points, else from up to _PLACES places of it.

    Raises:
        ScanFileError: The file is damaged before its first point.
        OSError: The file cannot be read.
    """
    is_complete = table.points <= _PLACES * PART
    parts = table.parts() if is_complete else _parts_of_places(table)
    step = max(1, -(-min(table.points, _PLACES * PART) // _SAMPLED))
    found, whole = [np.zeros((0, 3))], True
    for part in parts:
        whole = whole and all(part[axis].dtype.kind in "iu" for axis in _AXES)
        with np.errstate(over="ignore", invalid="ignore"):
            xyz = np.stack([part[axis][::step].astype(np.float64) for axis in _AXES], axis=1)
        with np.errstate(invalid="ignore"):
            found.append(xyz[(np.abs(xyz) < _LARGEST).all(axis=1)])
    xyz = np.concatenate(found)
    if len(xyz) >= _LEAST_POINTS and not whole:  # numbers of a text, or floats that hold whole numbers
        whole = bool((xyz == np.floor(xyz)).all())
    return CloudSample(xyz, whole and len(xyz) > 0, is_complete)


def _parts_of_places(table: PointTable) -> Iterator[Columns]:
    """Yield the first part from each of up to _PLACES places of a file; damage at a later place ends it."""
    starts = table.starts or tuple(table.points * k // _PLACES for k in range(_PLACES))
    chosen = starts[:: max(1, -(-len(starts) // _PLACES))]
    for begin in chosen:
        try:
            yield from islice(table.parts(begin), 1)
        except (ScanFileError, OSError):
            if begin == chosen[0]:
                raise
            return
