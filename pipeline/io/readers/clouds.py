"""Whole clouds of plots, read part by part: LAS, LAZ, E57, PLY, NumPy arrays and PCD."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SourceError
from pipeline.io.readers.base import COORDINATE_LIMIT, count_loss, digest_of
from pipeline.io.readers.point_files import (
    MISSING,
    MOST_POINTS,
    PART,
    ScanFileError,
    open_table,
)
from pipeline.types.records import CloudDescription, Float, Float32, WholeCloud

if TYPE_CHECKING:
    import laspy

_REMEDY = "Copy the file again, or export it again"


def open_cloud(uri: str) -> WholeCloud:
    """Open a whole cloud by its first bytes or its suffix: E57, LAS or LAZ, else a PLY, NumPy or PCD file.

    Raises:
        SourceError: The file does not exist, has an unknown format, or is damaged.
    """
    try:
        path = Path(uri).expanduser()
        with path.open("rb") as file:
            head = file.read(8)
        if head == b"ASTM-E57" or path.suffix.lower() == ".e57":
            return E57Cloud(uri, path)
        is_las = head.startswith(b"LASF") or path.suffix.lower() in (".las", ".laz")
        return LasCloud(uri, path) if is_las else TableCloud(uri, path)
    except MemoryError:
        raise SourceError("it is too large for the memory of this machine", where=uri) from None
    except (OSError, ValueError, RuntimeError) as error:  # a path with a zero byte, an unknown home
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise SourceError(
            f"cannot open: {reason}", where=uri, remedy="Look at the path and its rights"
        ) from None


def is_place(xyz: Float) -> NDArray[np.bool_]:
    """Return which positions, shape (N, 3) [m], are finite with magnitudes below COORDINATE_LIMIT, shape
    (N,)."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.isfinite(xyz) & (np.abs(xyz) < COORDINATE_LIMIT)).all(axis=1))


def offset_for(middle: Float) -> Float:
    """Return the offset of a cloud by a position in it, shape (3,) [m]: per axis, 0 for a magnitude below
    1000 m, else the position rounded to 100 m.

    The offset has whole hundreds of metres, so 32 bits hold the rest of the coordinates without loss.
    """
    return np.where(np.abs(middle) < 1000.0, 0.0, np.round(middle / 100.0) * 100.0)


class CloudFile:
    """A file of points as a cloud (see `pipeline.types.records.WholeCloud`).

    A subclass opens the file (`_open`), calls `_describe`, and yields the points (`_read`).

    Args:
        uri: Path as the user wrote it.
        path: The file.

    Raises:
        SourceError: The file cannot be read, has another format, is damaged, or has no valid point.
    """

    name: str  # of the format, in errors
    description: CloudDescription

    def __init__(self, uri: str, path: Path) -> None:
        """Open the file and read its description and its first points.

        Raises:
            SourceError: The file cannot be read, has another format, is damaged, or has no valid point.
        """
        self._uri, self._path = uri, path
        self.losses: dict[str, int] = {}
        with self._one_error():
            self.description = self._describe()

    def parts(self) -> Iterator[Float32]:
        """Yield all points part by part, relative to `description.offset`, float32, shape (N, 3) [m]; parts
        may be empty. `losses` is reset; points without valid coordinates, and those missing after damage, are
        counted in it.

        Raises:
            SourceError: The file cannot be read, or is damaged, before its first point.
        """
        self.losses = {}
        read = 0
        try:
            with self._one_error():
                for points, xyz in self._read():
                    with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers may have any size
                        xyz = xyz - self.description.offset
                    good = is_place(xyz)
                    read += points
                    if not good.all():
                        count_loss(self.losses, "points without coordinates", int(np.count_nonzero(~good)))
                    yield xyz[good].astype(np.float32)
        except SourceError:
            if read == 0:
                raise
            # Points before the damage are valid.
        if read < self.description.points:
            count_loss(self.losses, MISSING, self.description.points - read)

    def _describe(self) -> CloudDescription:
        """Return the description. Subclasses implement it."""
        raise NotImplementedError

    def _read(self) -> Iterator[tuple[int, Float]]:
        """Yield the positions part by part, shape (N, 3) [m], in the frame of the file, each with the number
        of points read for it. Subclasses implement it."""
        raise NotImplementedError

    def _described(self, kind: str, points: int, **known: Any) -> CloudDescription:  # noqa: ANN401
        """Return a description with the offset by the first valid positions.

        Args:
            kind, points, known: Fields of the description.

        Raises:
            SourceError: No point has valid coordinates.
            OSError: The file cannot be read.
        """
        for _, xyz in self._read():
            first = xyz[is_place(xyz)][:1000]
            if len(first):
                offset, digest = offset_for(first.mean(axis=0)), digest_of([self._path])
                return CloudDescription(self._uri, kind, points, offset, digest=digest, **known)
        raise SourceError("the cloud has no points with valid coordinates", where=self._uri, remedy=_REMEDY)

    @contextmanager
    def _one_error(self) -> Iterator[None]:
        """Raise any exception of a library or of the system as a SourceError; SourceError passes
        unchanged."""
        try:
            yield
        except SourceError:
            raise
        except OSError as error:
            what = f"cannot read: {error.strerror or error}"
            raise SourceError(what, where=self._uri, remedy=_REMEDY) from None
        except ScanFileError as error:
            raise SourceError(str(error), where=self._uri, remedy=_REMEDY) from None
        except BaseException as error:
            # A panic of the LAZ decoder is no Exception.
            if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
                raise
            reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
            what = f"the {self.name} file is damaged: {reason}"
            raise SourceError(what, where=self._uri, remedy=_REMEDY) from None


class TableCloud(CloudFile):
    """A PLY, NumPy or PCD file as a cloud."""

    name = "point"

    def _describe(self) -> CloudDescription:
        """Return the description by the header of the table, which is stored for reading.

        Raises:
            ScanFileError: The file is not such a table, or its data is damaged.
            SourceError: No point has valid coordinates.
            OSError: The file cannot be read.
        """
        self._table = table = open_table(self._path)
        attributes = tuple(name for name in table.names if name not in ("x", "y", "z"))
        return self._described(table.kind, table.points, crs="", attributes=attributes)

    def _read(self) -> Iterator[tuple[int, Float]]:
        """Yield the coordinates of all rows, valid or not, shape (N, 3) [m], each part with its number of
        points."""
        for columns in self._table.parts():
            with np.errstate(over="ignore", invalid="ignore"):
                xyz = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
            yield len(xyz), xyz


# --- LAS and LAZ ---

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


class LasCloud(CloudFile):
    """A .las or .laz file as a cloud."""

    name = "LAS"

    def _describe(self) -> CloudDescription:
        """Return the description by the header, which is checked before laspy reads it, and store the number
        of points that can be read. An error of laspy is not caught.

        Raises:
            SourceError: The header contradicts itself or the file, names too many points, or no point has
                valid coordinates.
            OSError: The file cannot be read.
        """
        points, self._there, compressed, version = _check_las(self._path, self._uri)
        with _open_las(self._path) as reader:
            header = reader.header
        return self._described(
            f"LAS {version}" + (" compressed" if compressed else ""),
            points,
            crs=_crs_of(header),
            low=np.array(header.mins, np.float64),
            high=np.array(header.maxs, np.float64),
            attributes=tuple(n for n in header.point_format.dimension_names if n not in ("X", "Y", "Z")),
            cut_above=str(header.system_identifier).rstrip("\0") == SYSTEM_OF_DRIVE,
        )

    def _read(self) -> Iterator[tuple[int, Float]]:
        """Yield the coordinates of the points before any damage, shape (N, 3) [m], each part with the number
        of points read. Withheld points are omitted and counted in `losses`."""
        read = 0
        with _open_las(self._path) as reader:
            scales, offsets = reader.header.scales.copy(), reader.header.offsets.copy()
            while read < self._there and len(chunk := reader.read_points(min(_LAS_PART, self._there - read))):
                raw = np.stack([np.asarray(chunk[axis], np.float64) for axis in ("X", "Y", "Z")], axis=1)
                with np.errstate(over="ignore", invalid="ignore"):
                    xyz = raw * scales + offsets
                withheld = np.asarray(chunk.withheld).astype(np.bool_)
                if withheld.any():
                    count_loss(self.losses, "points that the file withholds", int(np.count_nonzero(withheld)))
                read += len(xyz)
                yield len(xyz), xyz[~withheld]


def _open_las(path: Path) -> laspy.LasReader:
    """Return a laspy reader that decompresses in this thread."""
    import laspy

    # One decoder in this thread: results do not depend on the number of cores.
    return laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False)


def _check_las(path: Path, uri: str) -> tuple[int, int, bool, str]:
    """Check the sizes in the header of a LAS file against the size of the file, before laspy reads it.

    Returns:
        Number of points by the header, number of points that the file can hold, whether they are compressed,
        and the version.

    Raises:
        SourceError: The file is not a LAS file, the sizes contradict each other, there are no or too many
            points, or none before the first damage.
        OSError: The file cannot be read.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
        if len(head) < 227 or head[:4] != b"LASF":
            raise SourceError("the contents are not those of a LAS file", where=uri, remedy=_REMEDY)
        version = f"{head[24]}.{head[25]}"
        header_size, first, records = struct.unpack_from("<HII", head, 94)
        kind, length, points = struct.unpack_from("<BHI", head, 104)
        if head[25] >= 4 and len(head) >= 255:
            points = max(points, struct.unpack_from("<Q", head, 247)[0])
        compressed = kind >= 0x80
        fits = header_size <= first <= size and records * 54 <= first - header_size
        if not fits or not 20 <= length <= RECORD_LIMIT:
            raise SourceError("the header of the LAS file contradicts itself", where=uri, remedy=_REMEDY)
        room = size - first
        # A file that is cut is read up to its end.
        there = points if compressed else min(points, room // length)
        if points and there == 0:
            raise SourceError("the LAS file ends before its first point", where=uri, remedy=_REMEDY)
        if compressed:
            record, layers = _check_items(file, header_size, first, records, length, uri)
            _check_chunks(file, first, size, uri)
            if layers:
                there = min(points, _points_before_damage(file, first, length, record, layers))
            if points and there == 0:
                raise SourceError("the first chunk of the LAS file is damaged", where=uri, remedy=_REMEDY)
    if points == 0:
        raise SourceError("the cloud has no points", where=uri)
    if points > MOST_POINTS or (compressed and points > 4000 * room):
        raise SourceError("the header of the LAS file promises too many points", where=uri, remedy=_REMEDY)
    return points, there, compressed, version


def _check_items(
    file: IO[bytes], at: int, end: int, records: int, length: int, uri: str
) -> tuple[bytes, int]:
    """Check that the sum of the lengths of the compressed items of a point is the length of a point (LASzip,
    `laszip.check`).

    The decoder allocates memory by their sizes: up to 65,535 bytes per point.

    Args:
        file: The opened file.
        at, end: First byte of the variable-length records, and first byte after them.
        records: Number of these records.
        length: Length of a point by the header [bytes].
        uri: Name of the file in errors.

    Returns:
        The record of LASzip, b"" if there is none, and the number of layers of a chunk, 0 if it has none.

    Raises:
        SourceError: The lengths differ.
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
            raise SourceError("the header of the LAS file contradicts itself", where=uri, remedy=_REMEDY)
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


def _check_chunks(file: IO[bytes], first: int, size: int, uri: str) -> None:
    """Check that the chunk table is inside the file and has no more entries than the file has bytes.

    Args:
        file: The opened file.
        first: First byte of the points.
        size: Size of the file [bytes].
        uri: Name of the file in errors.

    Raises:
        SourceError: The file is cut off, or its table is too large.
    """
    file.seek(first)
    raw = file.read(8)
    at = struct.unpack("<q", raw)[0] if len(raw) == 8 else 0
    if at == -1 and size >= first + 16:
        file.seek(size - 8)
        at = struct.unpack("<q", file.read(8))[0]
    if not first + 8 <= at <= size - 8:
        raise SourceError("the compressed LAS file is cut off", where=uri, remedy=_REMEDY)
    file.seek(at)
    _, chunks = struct.unpack("<II", file.read(8))
    if chunks > size:
        raise SourceError("the header of the LAS file contradicts itself", where=uri, remedy=_REMEDY)


def _crs_of(header: laspy.LasHeader) -> str:
    """Return the coordinate reference system of the header: WKT, or "EPSG:" with the number of the projected
    or else geographic system; "" if there is none."""
    for record in header.vlrs:
        if record.record_id == 2112:
            wkt = str(getattr(record, "string", "")).strip("\0 \n")
            if wkt:
                return wkt
    for record in header.vlrs:
        if record.record_id == 34735:
            keys = {int(key.id): key for key in getattr(record, "geo_keys", ())}
            for name in (3072, 2048):  # a projected system before a geographic one
                key = keys.get(name)
                if (
                    key is not None
                    and int(key.tiff_tag_location) == 0
                    and 1024 <= int(key.value_offset) < 32767
                ):
                    return f"EPSG:{int(key.value_offset)}"
    return ""


# --- E57 ---

MOST_STATIONS = 10_000
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")


class E57Cloud(CloudFile):
    """An E57 file (ASTM E2807) as a cloud: all stations in one frame."""

    name = "E57"

    def _describe(self) -> CloudDescription:
        """Return the description by the headers of the stations. An error of pye57 is not caught.

        Raises:
            SourceError: pye57 is not installed, there are too many stations or points, or no point has valid
                coordinates.
            OSError: The file cannot be read.
        """
        with closing(self._open()) as file:
            stations = int(file.scan_count)
            if stations > MOST_STATIONS:
                raise SourceError(f"it promises {stations} stations", where=self._uri, remedy=_REMEDY)
            points = [int(file.get_header(k).point_count) for k in range(stations)]
        if not all(0 <= n <= MOST_POINTS for n in points) or sum(points) > MOST_POINTS:
            raise SourceError("it promises more points than there can be", where=self._uri, remedy=_REMEDY)
        kind = f"E57, {stations} station{'s' * (stations != 1)}"
        return self._described(kind, sum(points), crs="")

    def _read(self) -> Iterator[tuple[int, Float]]:
        """Yield the positions of the points of all stations in the frame of the file, shape (N, 3) [m], NaN
        for invalid ones, each part with its number of points. Errors of pye57 are not caught.

        Raises:
            SourceError: pye57 is not installed, or points have no coordinates.
        """
        with closing(self._open()) as file:
            for station in range(int(file.scan_count)):
                for xyz in self._station(file, station):
                    yield len(xyz), xyz

    def _station(self, file: Any, station: int) -> Iterator[Float]:  # noqa: ANN401 - pye57 has no types
        """Yield the points of a station in the frame of the file in parts, shape (N, 3) [m]; NaN for invalid
        ones.

        Raises:
            SourceError: The points have no coordinates.
        """
        header = file.get_header(station)
        there = set(header.point_fields)
        axes = _CARTESIAN if there.issuperset(_CARTESIAN) else _SPHERICAL
        if not there.issuperset(axes):
            raise SourceError("its points have no coordinates", where=self._uri, remedy=_REMEDY)
        wanted = [*axes, *(name for name in _INVALID if name in there)]
        R, t = _pose(header)
        arrays, buffers = file.make_buffers(wanted, PART)
        with closing(header.points.reader(buffers)) as reader:
            while count := reader.read():
                columns = {name: np.array(arrays[name][:count], dtype=np.float64) for name in wanted}
                with np.errstate(over="ignore", invalid="ignore"):
                    xyz = _cartesian(columns, axes) @ R.T + t
                for name in wanted[3:]:
                    xyz[columns[name] != 0] = np.nan
                yield xyz

    def _open(self) -> Any:  # noqa: ANN401
        """Return the file opened by pye57.

        Raises:
            SourceError: pye57 is not installed.
        """
        try:
            from pye57 import E57
        except ImportError:
            raise SourceError(
                "E57 files need pye57", where=self._uri, remedy="Install it with: uv sync --extra e57"
            ) from None
        return E57(str(self._path))


def _pose(header: Any) -> tuple[Float, Float]:  # noqa: ANN401
    """Return rotation, shape (3, 3), and translation, shape (3,) [m], of a station in the frame of the file;
    those of the identity if the header has no pose."""
    if not header.has_pose():
        return np.eye(3), np.zeros(3)
    return np.asarray(header.rotation_matrix, np.float64), np.asarray(header.translation, np.float64)


def _cartesian(columns: dict[str, Float], axes: tuple[str, ...]) -> Float:
    """Return positions, shape (N, 3) [m], from the three columns of `columns` with the names `axes`:
    Cartesian, or range [m], azimuth and elevation [rad]."""
    first, second, third = (columns[name] for name in axes)
    if axes == _CARTESIAN:
        return np.stack([first, second, third], axis=1)
    flat = first * np.cos(third)
    return np.stack([flat * np.cos(second), flat * np.sin(second), first * np.sin(third)], axis=1)
