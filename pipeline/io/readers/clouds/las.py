"""LAS and LAZ files: the clouds of terrestrial and mobile scanners, read part by part by laspy.

What the header promises is held against the size of the file before anything is read, so that no number
in a damaged file decides how much memory is taken.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from pipeline.errors import SourceError
from pipeline.inventory.cloud import CloudDescription
from pipeline.io.readers.base import digest_of
from pipeline.io.readers.clouds.coordinate_offset import is_place, offset_for
from pipeline.types.records import Float32

if TYPE_CHECKING:
    import laspy

PART = 1 << 19  # points
MOST_POINTS = 2_000_000_000
RECORD_LIMIT = 1024  # bytes of a point
#: A variable length record: what it is (after who says it), how long it is (before what it is in words).
_RECORD = struct.Struct("<18xHH32x")
#: The one of LASzip lists the items of a point from that byte on: kind, length and version of each.
_LASZIP_USER = b"laszip encoded"
_LASZIP, _ITEMS, _ITEM = 22204, 34, struct.Struct("<HHH")
_REMEDY = "Copy the file again, or export it again"


class LasCloud:
    """A .las or .laz file (see `pipeline.inventory.cloud.Cloud`).

    Raises:
        SourceError: It is no such file, or damaged.
        OSError: It cannot be read.
    """

    def __init__(self, uri: str, path: Path) -> None:
        self._path = path
        self.losses: dict[str, int] = {}
        points, self._there, compressed, version = _check(path, uri)
        crs = ""
        try:
            with _without_panic(), _open(path) as reader:
                header = reader.header
                self._scales, self._offsets = header.scales.copy(), header.offsets.copy()
                crs = _crs_of(header)
                low, high = np.array(header.mins, np.float64), np.array(header.maxs, np.float64)
                attributes = tuple(n for n in header.point_format.dimension_names if n not in ("X", "Y", "Z"))
                with np.errstate(over="ignore", invalid="ignore"):  # looked at below
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
            raise SourceError("the coordinates of the cloud are no coordinates", where=uri, remedy=_REMEDY)
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
        """All points, part by part."""
        self.losses = {}
        read = 0
        try:
            with _without_panic(), _open(self._path) as reader:
                while read < self._there:
                    chunk = reader.read_points(min(PART, self._there - read))
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
            # What came before the damage is whole and stays.
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
    """What makes the decoder panic is damage as any other; its own exception is none that is caught."""
    try:
        yield
    except BaseException as error:
        if type(error).__name__ == "PanicException":
            raise ValueError(str(error)) from None
        raise


def _open(path: Path) -> laspy.LasReader:
    import laspy

    # One decoder, in this thread: results do not depend on the machine's cores.
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


def _check(path: Path, uri: str) -> tuple[int, int, bool, str]:
    """Number of points that are promised and that can be there, whether they are compressed, version; all
    sizes held against the file's.

    Raises:
        SourceError: They contradict it.
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
        # One that was cut off in the middle is read as far as it goes.
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
    """The items that a point is packed in are together as long as a point (LASzip, `laszip.check`).

    The decoder takes memory for what they say: 65,535 bytes a point, whatever the header promises.
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
        told = file.read(content)
        items = int.from_bytes(told[_ITEMS - 2 : _ITEMS], "little")
        table = told[_ITEMS : _ITEMS + _ITEM.size * items]
        table = table[: len(table) // _ITEM.size * _ITEM.size]
        if sum(size for _, size, _ in _ITEM.iter_unpack(table)) != length:
            raise SourceError("the header of the LAS file contradicts itself", where=uri, remedy=_REMEDY)


def _check_chunks(file: IO[bytes], first: int, size: int, uri: str) -> None:
    """The table of the compressed parts names no more of them than the file has bytes."""
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
    """The coordinate reference system as the header tells it, empty when it does not."""
    for record in header.vlrs:
        if record.record_id == 2112:
            wkt = str(getattr(record, "string", "")).strip("\0 \n")
            if wkt:
                return wkt
    for record in header.vlrs:
        if record.record_id == 34735:
            keys = {int(key.id): key for key in getattr(record, "geo_keys", ())}
            for name in (3072, 2048):  # projected before geographic
                key = keys.get(name)
                if (
                    key is not None
                    and int(key.tiff_tag_location) == 0
                    and 1024 <= int(key.value_offset) < 32767
                ):
                    return f"EPSG:{int(key.value_offset)}"
    return ""
