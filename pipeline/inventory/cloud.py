"""What a whole cloud is to those who map it: points that come part by part, as often as asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from pipeline.geometry.poses import Float
from pipeline.types.records import Float32


@dataclass(frozen=True, slots=True, eq=False)
class CloudDescription:
    """What is known of a whole cloud before its points are read.

    Attributes:
        uri: As the user wrote it.
        kind: The format in words, e.g. "LAS 1.4 compressed".
        points: Number of points that the file promises.
        offset: shape (3,) [m]: what was taken from its coordinates, so that 32 bits hold the rest.
        crs: Its coordinate reference system, as WKT or "EPSG:32632"; empty when it is not said.
        digest: SHA-256 (hex) of the file.
        warnings: What a person should know.
        low, high: Corners that the file promises, in its own coordinates, shape (3,) [m]; not checked.
        attributes: What the file says of each point besides its place, by the names of the format.
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


class Cloud(Protocol):
    """A whole cloud of a plot, read part by part."""

    @property
    def description(self) -> CloudDescription:
        """What is known before reading."""

    @property
    def losses(self) -> dict[str, int]:
        """What was left out at the last reading, by reason in words."""

    def parts(self) -> Iterator[Float32]:
        """All points from the first on, float32, shape (N, 3) each: x, y, z less the offset [m], finite.

        Raises:
            SourceError: It is damaged so far that nothing can be read.
        """
