"""Pictures of a live run, stored until its end, when the positions of the trees are known."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path as FilePath
from typing import NamedTuple

from pipeline.io.readers.base import count_loss
from pipeline.io.readers.camera import Picture
from pipeline.remapping.scan_cache import SPARE_BYTES, free_space
from pipeline.types.records import Path

#: Motion between two stored pictures, which shows every tree from near, and limits of the disk space.
STEP_M, TURN_RAD = 1.0, math.radians(22.5)
MOST_BYTES, MOST_PICTURES = 1 << 30, 20_000
FULL = "pictures not stored for trees: the limit of 1 GB is reached"
REFUSED = "pictures not stored for trees: the disk cannot be written"
SPARED = f"pictures not stored for trees: less than {SPARE_BYTES / 1e9:.0f} GB of the disk would be left"


class _Kept(NamedTuple):
    """A picture without its bytes, and their position and length in the file."""

    picture: Picture
    begin: int
    length: int


class PictureStore:
    """Temporary file without a name, which the system deletes when the process ends.

    Args:
        folder: Selects the disk; the nearest existing parent is used.

    Attributes:
        losses: Number of pictures that were not stored, by reason.

    Raises:
        OSError: The file cannot be created.
    """

    def __init__(self, folder: FilePath) -> None:
        there = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.is_dir())
        # Without a buffer: bytes that a full disk refused would raise an error at a later read or at the end.
        self._file = tempfile.TemporaryFile(dir=there, buffering=0)  # noqa: SIM115 - open until `close`
        self._folder = there
        self._kept: dict[int, _Kept] = {}
        self._length = 0
        self._last: tuple[float, float, float] | None = None
        self.losses: dict[str, int] = {}

    def is_due(self, path: Path) -> bool:
        """Return whether the robot has moved far enough since the last stored picture.

        Args:
            path: Path up to the present pose.
        """
        if not len(path.x):
            return False
        here = float(path.x[-1]), float(path.y[-1]), float(path.yaw[-1])
        if self._last is None:
            return True
        x, y, yaw = self._last
        turned = abs(math.remainder(here[2] - yaw, math.tau))
        return math.hypot(here[0] - x, here[1] - y) >= STEP_M or turned >= TURN_RAD

    def add(self, picture: Picture, path: Path) -> None:
        """Store a picture.

        Args:
            picture: The picture.
            path: Path up to the pose at which it was taken.
        """
        self._last = float(path.x[-1]), float(path.y[-1]), float(path.yaw[-1])
        if picture.stamp_ns in self._kept:
            return
        size = len(picture.data)
        if self._length + size > MOST_BYTES or len(self._kept) >= MOST_PICTURES:
            count_loss(self.losses, FULL)
            return
        try:
            if free_space(self._folder) < SPARE_BYTES + size:
                count_loss(self.losses, SPARED)
                return
            self._file.seek(self._length)
            is_whole = self._file.write(picture.data) == size
        except OSError:
            is_whole = False
        if not is_whole:
            count_loss(self.losses, REFUSED)
            return
        empty = Picture(picture.stamp_ns, picture.encoding, picture.width, picture.height, picture.step, b"")
        self._kept[picture.stamp_ns] = _Kept(empty, self._length, size)
        self._length += size

    def stamps(self) -> list[int]:
        """Return the times of the pictures, ascending [ns]."""
        return sorted(self._kept)

    def at(self, wanted_ns: Collection[int]) -> Iterator[Picture]:
        """Yield the pictures of some of `stamps`, each once."""
        for stamp_ns in sorted(set(wanted_ns) & self._kept.keys()):
            empty, begin, length = self._kept[stamp_ns]
            self._file.seek(begin)
            data = self._file.read(length)
            yield Picture(stamp_ns, empty.encoding, empty.width, empty.height, empty.step, data)

    def close(self) -> None:
        """Close and delete the file."""
        self._file.close()
