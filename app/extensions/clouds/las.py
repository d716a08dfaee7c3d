"""LAS and LAZ files as tables of points."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from pipeline.io.readers.point_files import (
    MOST_POINTS,
    Columns,
    PointTable,
    ScanFileError,
    errors_as_damage,
)

if TYPE_CHECKING:
    import laspy

_AXES = ("x", "y", "z")
_LAS_PART = 1 << 19  # points
RECORD_LIMIT = 1024  # bytes of a point
#: A variable length record: its number (after the user id), its length (before the description).
_RECORD = struct.Struct("<18xHH32x")
#: The record of LASzip lists the items of a point from this byte on: kind, length and version of each.
_LASZIP_USER = b"laszip encoded"
_LASZIP, _ITEMS, _ITEM = 22204, 34, struct.Struct("<HHH")
#: Layers of a chunk by the kind of the item (LAS 1.4); extra bytes have one layer each.
_LAYERS, _BYTES_14 = {10: 9, 11: 1, 12: 2, 13: 1}, 14


#: System identifier of the LAS files that `stemmap export` writes of a drive.
SYSTEM_OF_DRIVE = "stemmap drive"


def open_las(path: Path) -> PointTable:
    """Return the table of the positions in a LAS or LAZ file; withheld points are NaN. Its header is checked
    before laspy reads it.

    Raises:
        ScanFileError: The header is damaged, contradicts itself or the file, or names too many points.
        OSError: The file cannot be read.
    """
    with errors_as_damage("the LAS file is damaged"):
        points, there, compressed, version = _check_las(path)
        with _las_reader(path) as reader:
            header = reader.header
            scales, offsets = header.scales.copy(), header.offsets.copy()
            (crs, units), system = _crs_of(header), str(header.system_identifier).rstrip("\0")
            dimensions = tuple(n for n in header.point_format.dimension_names if n not in ("X", "Y", "Z"))
            low, high = (np.array(corner, np.float64) for corner in (header.mins, header.maxs))

    def read(begin: int = 0) -> Iterator[Columns]:
        """Yield the coordinates of the points that the file can hold from the point `begin` on, float64."""
        left = there - begin
        with _las_reader(path) as reader:
            if begin:
                reader.seek(begin)
            while left and len(chunk := reader.read_points(min(_LAS_PART, left))):
                raw = np.stack([np.asarray(chunk[axis], np.float64) for axis in ("X", "Y", "Z")])
                with np.errstate(over="ignore", invalid="ignore"):
                    xyz = raw * scales[:, None] + offsets[:, None]
                xyz[:, np.asarray(chunk.withheld).astype(np.bool_)] = np.nan
                left -= xyz.shape[1]
                yield dict(zip(_AXES, xyz, strict=True))

    return PointTable(
        f"LAS {version}" + (" compressed" if compressed else ""),
        points,
        _AXES,
        read,
        attributes=dimensions,
        crs=crs,
        units=units,
        low=low,
        high=high,
        cut_above=system == SYSTEM_OF_DRIVE,
        invalid="points that have no coordinates, or that the file withholds",
    )


def _las_reader(path: Path) -> laspy.LasReader:
    """Return a laspy reader that decompresses in this thread."""
    import laspy

    # One decoder in this thread: results do not depend on the number of cores.
    return laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False)


def _check_las(path: Path) -> tuple[int, int, bool, str]:
    """Check the sizes in the header of a LAS file against the size of the file, before laspy reads it.

    Returns:
        Number of points by the header, number of points that the file can hold, whether they are compressed,
        and the version.

    Raises:
        ScanFileError: The file is not a LAS file, the sizes contradict each other, there are no or too many
            points, or none before the first damage.
        OSError: The file cannot be read.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
        if len(head) < 227 or head[:4] != b"LASF":
            raise ScanFileError("the contents are not those of a LAS file")
        version = f"{head[24]}.{head[25]}"
        header_size, first, records = struct.unpack_from("<HII", head, 94)
        kind, length, points = struct.unpack_from("<BHI", head, 104)
        if head[25] >= 4 and len(head) >= 255:
            points = max(points, struct.unpack_from("<Q", head, 247)[0])
        compressed = kind >= 0x80
        fits = header_size <= first <= size and records * 54 <= first - header_size
        if not fits or not 20 <= length <= RECORD_LIMIT:
            raise ScanFileError("the header of the LAS file contradicts itself")
        room = size - first
        # A file that is cut is read up to its end.
        there = points if compressed else min(points, room // length)
        if points and there == 0:
            raise ScanFileError("the LAS file ends before its first point")
        if compressed:
            record, layers = _check_items(file, header_size, first, records, length)
            _check_chunks(file, first, size)
            if layers:
                there = min(points, _points_before_damage(file, first, length, record, layers))
            if points and there == 0:
                raise ScanFileError("the first chunk of the LAS file is damaged")
    if points == 0:
        raise ScanFileError("the cloud has no points")
    if points > MOST_POINTS or (compressed and points > 4000 * room):
        raise ScanFileError("the header of the LAS file promises too many points")
    return points, there, compressed, version


def _check_items(file: IO[bytes], at: int, end: int, records: int, length: int) -> tuple[bytes, int]:
    """Check that the sum of the lengths of the compressed items of a point is the length of a point (LASzip,
    `laszip.check`).

    The decoder allocates memory by their sizes: up to 65,535 bytes per point.

    Args:
        file: The opened file.
        at, end: First byte of the variable-length records, and first byte after them.
        records: Number of these records.
        length: Length of a point by the header [bytes].

    Returns:
        The record of LASzip, b"" if there is none, and the number of layers of a chunk, 0 if it has none.

    Raises:
        ScanFileError: The lengths differ.
    """
    for _ in range(records):
        file.seek(at)
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size or at + _RECORD.size > end:
            break
        number, content = _RECORD.unpack(head)
        at += _RECORD.size + content
        if number != _LASZIP or head[2:18].rstrip(b"\0") != _LASZIP_USER:
            continue
        record = file.read(content)
        items = int.from_bytes(record[_ITEMS - 2 : _ITEMS], "little")
        table = record[_ITEMS : _ITEMS + _ITEM.size * items]
        table = table[: len(table) // _ITEM.size * _ITEM.size]
        if sum(size for _, size, _ in _ITEM.iter_unpack(table)) != length:
            raise ScanFileError("the header of the LAS file contradicts itself")
        kinds = [(kind, size) for kind, size, _ in _ITEM.iter_unpack(table)]
        return record, sum(size if kind == _BYTES_14 else _LAYERS.get(kind, 0) for kind, size in kinds)
    return b"", 0


def _points_before_damage(file: IO[bytes], first: int, length: int, record: bytes, layers: int) -> int:
    """Return the number of points in the chunks before the first one whose layers are longer than the chunk.

    A chunk that is cut off also ends the count.

    Args:
        file: The opened file.
        first: First byte of the points.
        length: Length of a point [bytes]; a chunk begins with one point, a number, and a length per layer.
        record: The record of LASzip.
        layers: Number of layers of a chunk.
    """
    import lazrs

    file.seek(first)
    points, at = 0, first + 8
    for count, size in lazrs.read_chunk_table(file, lazrs.LazVlr(record)):
        file.seek(at + length + 4)
        lengths = np.frombuffer(file.read(4 * layers), "<u4")
        if len(lengths) < layers or lengths.sum(dtype=np.int64) > size:
            break
        points, at = points + count, at + size
    return points


def _check_chunks(file: IO[bytes], first: int, size: int) -> None:
    """Check that the chunk table is inside the file and has no more entries than the file has bytes.

    Args:
        file: The opened file.
        first: First byte of the points.
        size: Size of the file [bytes].

    Raises:
        ScanFileError: The file is cut off, or its table is too large.
    """
    file.seek(first)
    raw = file.read(8)
    at = struct.unpack("<q", raw)[0] if len(raw) == 8 else 0
    if at == -1 and size >= first + 16:
        file.seek(size - 8)
        at = struct.unpack("<q", file.read(8))[0]
    if not first + 8 <= at <= size - 8:
        raise ScanFileError("the compressed LAS file is cut off")
    file.seek(at)
    _, chunks = struct.unpack("<II", file.read(8))
    if chunks > size:
        raise ScanFileError("the header of the LAS file contradicts itself")


_WKT, _GEO_KEYS = 2112, 34735  # numbers of records of LAS
#: GeoTIFF keys: systems of positions (a projected one before a geographic one) and of heights, and their
#: units, which count where the system is user-defined; for heights always, because writers name NAVD88 so.
_PROJECTED, _GEOGRAPHIC, _PROJECTED_UNIT, _VERTICAL, _VERTICAL_UNIT = 3072, 2048, 3076, 4096, 4099
_EPSG_UNITS = {9001: "m", 9002: "ft", 9003: "us-ft"}


def _crs_of(header: laspy.LasHeader) -> tuple[str, tuple[str, str]]:
    """Return the coordinate reference system of the header, and units that it names apart from it.

    Returns:
        WKT, or "EPSG:" with the number of the projected or else geographic system, and of heights after a
        "+"; "" if there is none. The units of positions and heights as in `PointTable.units`.
    """
    for record in header.vlrs:
        if record.record_id == _WKT:
            wkt = str(getattr(record, "string", "")).strip("\0 \n")
            if wkt:
                return wkt, ("", "")
    keys: dict[int, int] = {}
    for record in header.vlrs:
        if record.record_id == _GEO_KEYS:
            for key in getattr(record, "geo_keys", ()):
                if int(key.tiff_tag_location) == 0:
                    keys.setdefault(int(key.id), int(key.value_offset))
    systems = [keys[k] for k in (_PROJECTED, _GEOGRAPHIC) if 1024 <= keys.get(k, 0) < 32767]
    high = _EPSG_UNITS.get(keys.get(_VERTICAL_UNIT, 0), "")
    if not systems:
        return "", (_EPSG_UNITS.get(keys.get(_PROJECTED_UNIT, 0), ""), high)
    vertical = keys.get(_VERTICAL, 0)
    heights = f"+{vertical}" if 1024 <= vertical < 32767 and _is_vertical(vertical) else ""
    return f"EPSG:{systems[0]}{heights}", ("", high)


def _is_vertical(number: int) -> bool:
    """Return whether PROJ knows a system of heights by its EPSG number; old files name a datum instead."""
    import pyproj

    try:
        return bool(pyproj.CRS.from_epsg(number).is_vertical)
    except pyproj.exceptions.ProjError:
        return False
