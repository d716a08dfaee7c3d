"""What is known of a whole cloud, and how its points are read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from pipeline.types.records import Float, Float32


@dataclass(frozen=True, slots=True, eq=False)
class CloudDescription:
    """What is known of a whole cloud before its points are read.

    Attributes:
        uri: As the user wrote it.
        kind: Name of the format, e.g. "LAS 1.4 compressed".
        points: Number of points by the header.
        offset: Offset that is subtracted from the coordinates, so that 32 bits hold the rest, shape (3,) [m].
        crs: Coordinate reference system as WKT or "EPSG:32632"; empty when unknown.
        digest: SHA-256 (hex) of the file.
        warnings: Messages for the user.
        low, high: Corners by the header (not checked) or by a sample of the points, shape (3,) [m]. None if
            unknown.
        attributes: Names of the columns besides the coordinates.
        cut_above: Whether the field of view of a sensor cuts the trees, as in the cloud of a drive.
        unit: Unit of the coordinates of the file and how it is known, for people.
        up: Axis of the file that points up and how it is known, for people.
        form: Why the file was taken as a whole cloud, for people; "" for a format of whole clouds.
        crs_unit: Metres per unit of the reference system of the file, horizontal and vertical, in which
            positions are written; offset, corners and points are in metres.
    """

    uri: str
    kind: str
    points: int
    offset: Float
    crs: str
    digest: str
    warnings: tuple[str, ...] = ()
    low: Float | None = None
    high: Float | None = None
    attributes: tuple[str, ...] = ()
    cut_above: bool = False
    unit: str = "metres"
    up: str = "z"
    form: str = ""
    crs_unit: tuple[float, float] = (1.0, 1.0)


class WholeCloud(Protocol):
    """A whole cloud of a plot, read in parts."""

    @property
    def description(self) -> CloudDescription:
        """Description that is known before reading."""

    @property
    def losses(self) -> dict[str, int]:
        """Dict from reasons to numbers of points left out in the latest reading; empty if there are none."""

    def parts(self) -> Iterator[Float32]:
        """Yield all points in parts: x, y, z minus the offset [m], finite, float32, shape (N, 3). Each call
        reads the cloud from its beginning.

        Raises:
            SourceError: Nothing can be read.
        """
