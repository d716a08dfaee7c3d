"""A whole cloud that is read from its source once."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from app.extensions.clouds.records import CloudDescription, WholeCloud
from pipeline.types.records import Float32


class SpooledCloud:
    """A cloud that is read from its source once: later readings come from a temporary file without a name.

    If the file cannot be written, each reading comes from the source.

    Args:
        cloud: The cloud.
        folder: Folder of the temporary file; None for that of the system.
    """

    def __init__(self, cloud: WholeCloud, folder: Path | None = None) -> None:
        self._cloud, self._folder = cloud, folder
        self._file: IO[bytes] | None = None

    @property
    def description(self) -> CloudDescription:
        """Description of the cloud."""
        return self._cloud.description

    @property
    def losses(self) -> dict[str, int]:
        """dict from reasons to numbers of points that were left out in the reading of the source."""
        return self._cloud.losses

    def parts(self) -> Iterator[Float32]:
        """Yield all points in parts: x, y, z minus the offset [m], float32, shape (N, 3). Each call begins at
        the first point. The first complete reading is stored; one that is left before its end, or a full
        disk, stores nothing.

        Raises:
            SourceError: The source cannot be read.
            OSError: The temporary file cannot be read.
        """
        if self._file is not None:
            yield from _read_points(self._file)
            return
        try:
            spool: IO[bytes] | None = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115 - kept open
        except OSError:
            spool = None
        complete = False
        try:
            for part in self._cloud.parts():
                if spool is not None:
                    try:
                        spool.write(np.ascontiguousarray(part).data)
                    except OSError:  # the disk is full
                        spool.close()
                        spool = None
                yield part
            complete = True
        finally:
            if complete:
                self._file = spool
            elif spool is not None:
                spool.close()

    def close(self) -> None:
        """Delete the temporary file; a later reading comes from the source again."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _read_points(file: IO[bytes]) -> Iterator[Float32]:
    """Yield the points of a file of float32 x, y, z in parts of at most SPOOLED, shape (N, 3) [m]."""
    file.seek(0)
    while block := file.read(SPOOLED * 12):
        yield np.frombuffer(block, np.float32).reshape(-1, 3)


SPOOLED = 1 << 19  # points that are read at once
