"""PCD files as a table: read in parts where they are binary, at once where they are not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.io.readers.pcd_file import FILE_LIMIT, PcdHeader, parse_header, read_pcd, record_type
from pipeline.io.readers.point_files.table import MOST_POINTS, Columns, check_size, names_of, read_records
from pipeline.io.readers.scan_folder import ScanFileError

_HEAD = 16 << 10


@dataclass(frozen=True, slots=True)
class PcdTable:
    """The points of a PCD file (see `PointTable`)."""

    path: Path
    header: PcdHeader
    names: tuple[str, ...]

    @property
    def kind(self) -> str:
        """The format in words."""
        return f"PCD {self.header.data}"

    @property
    def points(self) -> int:
        """Number of points that the header promises."""
        return self.header.points

    def parts(self) -> Iterator[Columns]:
        """See `PointTable.parts`."""
        if self.header.data != "binary":
            yield self._named(read_pcd(self.path, {}, most_points=MOST_POINTS))
            return
        dtype = record_type(self.header)
        with self.path.open("rb") as file:
            file.seek(self.header.length)
            for records in read_records(file, dtype, self.header.points):
                yield self._named({name: records[name] for name in dtype.names or ()})

    def _named(self, columns: Columns) -> Columns:
        named: Columns = {}
        for name, column in zip(names_of(list(columns)), columns.values(), strict=True):
            named.setdefault(name, column)
        return {name: named[name] for name in self.names}


def open_pcd_table(path: Path) -> PcdTable:
    """Read and check the header.

    Raises:
        ScanFileError: It is no PCD file, or contradicts itself or the file's size.
        OSError: It cannot be read.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = parse_header(file.read(_HEAD), most_points=MOST_POINTS)
    check_size(header.points, header.step)
    if header.data == "binary" and size < header.length + header.step:
        raise ScanFileError("the PCD file ends before its first point")
    if header.data != "binary" and size > FILE_LIMIT:
        raise ScanFileError("the PCD file is too large; write it as binary")
    once = {name: None for name in names_of(list(record_type(header).names or ())) if name != "_"}
    return PcdTable(path, header, tuple(once))
