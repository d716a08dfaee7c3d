"""Whole clouds of plots, read part by part: LAS, LAZ, E57, PLY, NumPy arrays and PCD."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SourceError
from pipeline.inventory.cloud import CloudDescription, WholeCloud
from pipeline.io.readers.base import COORDINATE_LIMIT, count_loss, digest_of
from pipeline.io.readers.point_files import (
    MAGIC,
    MISSING,
    MOST_POINTS,
    PART,
    Columns,
    ScanFileError,
    open_table,
)
from pipeline.types.records import Float, Float32

if TYPE_CHECKING:
    import laspy

_REMEDY = "Copy the file again, or export it again"
LAS, E57 = b"LASF", b"ASTM-E57"
#: Files that are clouds by default; a .pcd file is a scan by default.
SUFFIXES = (".las", ".laz", ".ply", ".npy", ".npz", ".e57")
READABLE = "LAS, LAZ, PLY, E57, .npy, .npz and PCD"


def is_cloud(uri: str) -> bool:
    """Return whether a file is a whole cloud by its first bytes or its name."""
    path = Path(uri).expanduser()
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except (OSError, ValueError, RuntimeError):
        return False
    return head.startswith((LAS, E57, *MAGIC[".ply"], *MAGIC[".npy"])) or path.suffix.lower() in SUFFIXES


def open_cloud(uri: str) -> WholeCloud:
    """Open a whole cloud.

    Raises:
        SourceError: It does not exist, has an unknown format, or is damaged.
    """
    try:
        path = Path(uri).expanduser()
        with path.open("rb") as file:
            head = file.read(8)
        if head == E57 or path.suffix.lower() == ".e57":
            return E57Cloud(uri, path)
        is_las = head.startswith(LAS) or path.suffix.lower() in (".las", ".laz")
        return LasCloud(uri, path) if is_las else TableCloud(uri, path)
    except MemoryError:
        raise SourceError("it is too large for the memory of this machine", where=uri) from None
    except (OSError, ValueError, RuntimeError) as error:  # a path with a zero byte, an unknown home
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise SourceError(
            f"cannot open: {reason}", where=uri, remedy="Look at the path and its rights"
        ) from None


def is_place(xyz: Float) -> NDArray[np.bool_]:
    """Return which rows of shape (N, 3) [m] are finite and within the limit of coordinates, shape (N,)."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.isfinite(xyz) & (np.abs(xyz) < COORDINATE_LIMIT)).all(axis=1))


def offset_for(middle: Float) -> Float:
    """Return the offset of a cloud by a position in it, shape (3,) [m].

    The offset has whole hundreds of metres, so 32 bits hold the rest of the coordinates without loss.
    """
    return np.where(np.abs(middle) < 1000.0, 0.0, np.round(middle / 100.0) * 100.0)


class TableCloud:
    """A PLY, NumPy or PCD file as a cloud (see `pipeline.inventory.cloud.WholeCloud`).

    Raises:
        SourceError: It has another format, or is damaged.
        OSError: It cannot be read.
    """

    def __init__(self, uri: str, path: Path) -> None:
        self.losses: dict[str, int] = {}
        try:
            self._table = open_table(path)
            middle = self._first_places().mean(axis=0)
        except ScanFileError as error:
            raise SourceError(str(error), where=uri, remedy=_REMEDY) from None
        if not np.isfinite(middle).all():
            raise SourceError("the coordinates of the cloud are not valid", where=uri, remedy=_REMEDY)
        self.description = CloudDescription(
            uri=uri,
            kind=self._table.kind,
            points=self._table.points,
            offset=offset_for(middle),
            crs="",
            digest=digest_of([path]),
            attributes=tuple(name for name in self._table.names if name not in ("x", "y", "z")),
        )

    def parts(self) -> Iterator[Float32]:
        """Yield all points part by part, shape (N, 3)."""
        self.losses = {}
        read = 0
        try:
            for columns in self._table.parts():
                with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers may have any size
                    xyz = _places(columns) - self.description.offset
                good = is_place(xyz)
                read += len(xyz)
                if not good.all():
                    count_loss(self.losses, "points without coordinates", int(np.count_nonzero(~good)))
                yield xyz[good].astype(np.float32)
        except ScanFileError as error:
            raise SourceError(str(error), where=self.description.uri, remedy=_REMEDY) from None
        if read < self._table.points:
            count_loss(self.losses, MISSING, self._table.points - read)

    def _first_places(self) -> Float:
        """Return the first valid positions, shape (N, 3) [m]; one row of NaN when there is none."""
        for columns in self._table.parts():
            xyz = _places({axis: columns[axis][:10_000] for axis in "xyz"})
            xyz = xyz[is_place(xyz)][:1000]
            if len(xyz):
                return xyz
        return np.full((1, 3), np.nan)


def _places(columns: Columns) -> Float:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)


# --- LAS and LAZ ---

_LAS_PART = 1 << 19  # points
RECORD_LIMIT = 1024  # bytes of a point
#: A variable length record: its number (after the user id), its length (before the description).
_RECORD = struct.Struct("<18xHH32x")
#: The record of LASzip lists the items of a point from this byte on: kind, length and version of each.
_LASZIP_USER = b"laszip encoded"
_LASZIP, _ITEMS, _ITEM = 22204, 34, struct.Struct("<HHH")


class LasCloud:
    """A .las or .laz file (see `pipeline.inventory.cloud.WholeCloud`).

    Raises:
        SourceError: It has another format, or is damaged.
        OSError: It cannot be read.
    """

    def __init__(self, uri: str, path: Path) -> None:
        self._path = path
        self.losses: dict[str, int] = {}
        points, self._there, compressed, version = _check_las(path, uri)
        crs = ""
        try:
            with _without_panic(), _open_las(path) as reader:
                header = reader.header
                self._scales, self._offsets = header.scales.copy(), header.offsets.copy()
                crs = _crs_of(header)
                low, high = np.array(header.mins, np.float64), np.array(header.maxs, np.float64)
                attributes = tuple(n for n in header.point_format.dimension_names if n not in ("X", "Y", "Z"))
                with np.errstate(over="ignore", invalid="ignore"):  # checked below
                    first = self._xyz(reader.read_points(min(1000, self._there)))
        except SourceError:
            raise
        except _all_that_damage_raises() as error:
            raise SourceError(f"the LAS file is damaged: {error}", where=uri, remedy=_REMEDY) from None
        if not len(first):
            raise SourceError("the LAS file is damaged: no point is whole", where=uri, remedy=_REMEDY)
        with np.errstate(over="ignore", invalid="ignore"):
            middle = first.mean(axis=0)
        if not is_place(middle[None]).all():
            raise SourceError("the coordinates of the cloud are not valid", where=uri, remedy=_REMEDY)
        self.description = CloudDescription(
            uri=uri,
            kind=f"LAS {version}" + (" compressed" if compressed else ""),
            points=points,
            offset=offset_for(middle),
            crs=crs,
            digest=digest_of([path]),
            low=low,
            high=high,
            attributes=attributes,
        )

    def parts(self) -> Iterator[Float32]:
        """Yield all points part by part, shape (N, 3)."""
        self.losses = {}
        read = 0
        try:
            with _without_panic(), _open_las(self._path) as reader:
                while read < self._there:
                    chunk = reader.read_points(min(_LAS_PART, self._there - read))
                    if len(chunk) == 0:
                        break
                    xyz = self._xyz(chunk) - self.description.offset
                    good = is_place(xyz)
                    withheld = np.asarray(chunk.withheld).astype(np.bool_)
                    self._lose("points without coordinates", int(np.count_nonzero(~good)))
                    self._lose("points that the file withholds", int(np.count_nonzero(good & withheld)))
                    read += len(xyz)
                    yield xyz[good & ~withheld].astype(np.float32)
        except _all_that_damage_raises() as error:
            if read == 0:
                raise SourceError(
                    f"the LAS file is damaged: {error}", where=self.description.uri, remedy=_REMEDY
                ) from None
            # Points before the damage are valid.
        self._lose("points after the damage in the file", self.description.points - read)

    def _xyz(self, chunk: laspy.ScaleAwarePointRecord) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        raw = np.stack([np.asarray(chunk[axis], np.float64) for axis in ("X", "Y", "Z")], axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            xyz: np.ndarray[tuple[int, int], np.dtype[np.float64]] = raw * self._scales + self._offsets
        return xyz

    def _lose(self, reason: str, n: int) -> None:
        if n > 0:
            self.losses[reason] = self.losses.get(reason, 0) + n


@contextmanager
def _without_panic() -> Iterator[None]:
    """Turn a panic of the LAZ decoder, which is no Exception, into a ValueError."""
    try:
        yield
    except BaseException as error:
        if type(error).__name__ == "PanicException":
            raise ValueError(str(error)) from None
        raise


def _open_las(path: Path) -> laspy.LasReader:
    import laspy

    # One decoder in this thread: results do not depend on the number of cores.
    return laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False)


def _all_that_damage_raises() -> tuple[type[BaseException], ...]:
    import laspy
    import lazrs

    return (
        laspy.errors.LaspyException,
        lazrs.LazrsError,
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        AttributeError,
        OverflowError,
        MemoryError,
        EOFError,
        RuntimeError,
        struct.error,
    )


def _check_las(path: Path, uri: str) -> tuple[int, int, bool, str]:
    """Check the sizes in the header of a LAS file against the size of the file, before laspy reads it.

    Returns:
        Number of points by the header, number of points that the file can hold, whether they are compressed,
        and the version.

    Raises:
        SourceError: They contradict each other.
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
            _check_items(file, header_size, first, records, length, uri)
            _check_chunks(file, first, size, uri)
    if points == 0:
        raise SourceError("the cloud has no points", where=uri)
    if points > MOST_POINTS or (compressed and points > 4000 * room):
        raise SourceError("the header of the LAS file promises too many points", where=uri, remedy=_REMEDY)
    return points, there, compressed, version


def _check_items(file: IO[bytes], at: int, end: int, records: int, length: int, uri: str) -> None:
    """Check that the compressed items of a point are together as long as a point (LASzip, `laszip.check`).

    The decoder allocates memory by their sizes: up to 65,535 bytes per point.
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


def _check_chunks(file: IO[bytes], first: int, size: int, uri: str) -> None:
    """Check that the chunk table has no more entries than the file has bytes."""
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
    """Return the coordinate reference system of the header, "" when there is none."""
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


class E57Cloud:
    """An E57 file (ASTM E2807) as a cloud (see `pipeline.inventory.cloud.WholeCloud`): all stations in one
    frame.

    Raises:
        SourceError: It has another format, is damaged, or pye57 is not installed.
    """

    def __init__(self, uri: str, path: Path) -> None:
        self._uri, self._path = uri, path
        self.losses: dict[str, int] = {}
        file = self._open()
        try:
            stations = self._guarded(lambda: int(file.scan_count))
            if stations > MOST_STATIONS:
                raise SourceError(f"it promises {stations} stations", where=uri, remedy=_REMEDY)
            points = self._guarded(lambda: [int(file.get_header(k).point_count) for k in range(stations)])
            if not all(0 <= n <= MOST_POINTS for n in points) or sum(points) > MOST_POINTS:
                raise SourceError("it promises more points than there can be", where=uri, remedy=_REMEDY)
            first = next((part[good] for part, good in self._places(file) if good.any()), None)
        finally:
            file.close()
        if first is None:
            raise SourceError("the cloud has no points", where=uri, remedy=_REMEDY)
        self.description = CloudDescription(
            uri=uri,
            kind=f"E57, {stations} station{'s' * (stations != 1)}",
            points=sum(points),
            offset=offset_for(first[:1000].mean(axis=0)),
            crs="",
            digest=digest_of([path]),
        )

    def parts(self) -> Iterator[Float32]:
        """Yield all points part by part, shape (N, 3)."""
        self.losses = {}
        read = 0
        file = self._open()
        try:
            for xyz, good in self._places(file):
                read += len(xyz)
                if not good.all():
                    count_loss(self.losses, "points without coordinates", int(np.count_nonzero(~good)))
                yield (xyz[good] - self.description.offset).astype(np.float32)
        except SourceError:
            if read == 0:
                raise
        finally:
            file.close()
        if read < self.description.points:
            count_loss(self.losses, "points after the damage in the file", self.description.points - read)

    def _places(self, file: Any) -> Iterator[tuple[Float, Any]]:  # noqa: ANN401 - pye57 has no types
        """Yield points of all stations in the frame of the file, (N, 3) [m], and which are valid, (N,)."""
        for station in range(self._guarded(lambda: int(file.scan_count))):
            yield from self._station(file, station)

    def _station(self, file: Any, station: int) -> Iterator[tuple[Float, Any]]:  # noqa: ANN401
        header = self._guarded(lambda: file.get_header(station))
        there = set(self._guarded(lambda: list(header.point_fields)))
        axes = _CARTESIAN if there.issuperset(_CARTESIAN) else _SPHERICAL
        if not there.issuperset(axes):
            raise SourceError("its points have no coordinates", where=self._uri, remedy=_REMEDY)
        wanted = [*axes, *(name for name in _INVALID if name in there)]
        R, t = self._guarded(lambda: _pose(header))
        arrays, buffers = self._guarded(lambda: file.make_buffers(wanted, PART))
        reader = self._guarded(lambda: header.points.reader(buffers))
        try:
            while count := self._guarded(reader.read):
                columns = {name: np.array(arrays[name][:count], dtype=np.float64) for name in wanted}
                with np.errstate(over="ignore", invalid="ignore"):
                    xyz = _cartesian(columns, axes) @ R.T + t
                good = is_place(xyz)
                for name in wanted[3:]:
                    good &= columns[name] == 0
                yield xyz, good
        finally:
            self._guarded(reader.close)

    def _open(self) -> Any:  # noqa: ANN401
        try:
            from pye57 import E57
        except ImportError:
            raise SourceError(
                "E57 files need pye57", where=self._uri, remedy="Install it with: uv sync --extra e57"
            ) from None
        return self._guarded(lambda: E57(str(self._path)))

    def _guarded(self, work: Any) -> Any:  # noqa: ANN401
        """Call a function of pye57; any exception means damage."""
        try:
            return work()
        except Exception as error:
            reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
            raise self._damaged(reason) from None

    def _damaged(self, reason: str) -> SourceError:
        return SourceError(f"the E57 file is damaged: {reason}", where=self._uri, remedy=_REMEDY)


def _pose(header: Any) -> tuple[Float, Float]:  # noqa: ANN401
    """Return rotation and translation of a station in the frame of the file; identity by default."""
    if not header.has_pose():
        return np.eye(3), np.zeros(3)
    return np.asarray(header.rotation_matrix, np.float64), np.asarray(header.translation, np.float64)


def _cartesian(columns: dict[str, Float], axes: tuple[str, ...]) -> Float:
    first, second, third = (columns[name] for name in axes)
    if axes == _CARTESIAN:
        return np.stack([first, second, third], axis=1)
    flat = first * np.cos(third)
    return np.stack([flat * np.cos(second), flat * np.sin(second), first * np.sin(third)], axis=1)
