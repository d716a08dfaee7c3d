"""Whole clouds of plots: LAS, LAZ and others, read part by part."""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import SourceError
from pipeline.plot.cloud import Cloud
from pipeline.sources.clouds.las import MAGIC

SUFFIXES = (".las", ".laz")


def is_cloud(uri: str) -> bool:
    """Whether it names a file that holds a whole cloud, by its first bytes or its name."""
    path = Path(uri).expanduser()
    try:
        with path.open("rb") as file:
            return file.read(4) == MAGIC or path.suffix.lower() in SUFFIXES
    except (OSError, ValueError):
        return False


def open_cloud(uri: str) -> Cloud:
    """Open a whole cloud.

    Raises:
        SourceError: It is not there, of a kind that cannot be read, or damaged.
    """
    from pipeline.sources.clouds.las import LasCloud

    try:
        return LasCloud(uri, Path(uri).expanduser())
    except MemoryError:
        raise SourceError("it is too large for the memory of this machine", where=uri) from None
    except (OSError, ValueError, RuntimeError) as error:  # a path with a zero byte, a home of nobody
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise SourceError(
            f"cannot open: {reason}", where=uri, remedy="Look at the path and its rights"
        ) from None
