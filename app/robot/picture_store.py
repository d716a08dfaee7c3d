"""Pictures of a live run put aside for its trees: which tree is where is only known when the run is over."""

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

#: A picture each metre or a quarter of a turn shows every tree from near; the disk that they may take.
STEP_M, TURN_RAD = 1.0, math.radians(22.5)
MOST_BYTES, MOST_PICTURES = 1 << 30, 20_000
FULL = "pictures not put aside for trees: 1 GB of them is there"
REFUSED = "pictures not put aside for trees: the disk refuses"
SPARED = f"pictures not put aside for trees: less than {SPARE_BYTES / 1e9:.0f} GB of the disk would be left"


class _Kept(NamedTuple):
    """A picture without its bytes, and where these begin in the file and how many they are."""

    picture: Picture
    begin: int
    length: int


class PictureStore:
    """A file without a name, which goes with the process.

    Args:
        folder: On whose disk it is, or on that of the next folder above that is there.

    Attributes:
        losses: What was not kept, by reason.

    Raises:
        OSError: The file cannot be made.
    """

    def __init__(self, folder: FilePath) -> None:
        there = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.is_dir())
        # Without a buffer: what a full disk refused would wait there, for who reads or closes to be refused.
        self._file = tempfile.TemporaryFile(dir=there, buffering=0)  # noqa: SIM115 - open until `close`
        self._folder = there
        self._kept: dict[int, _Kept] = {}
        self._length = 0
        self._last: tuple[float, float, float] | None = None
        self.losses: dict[str, int] = {}

    def is_due(self, path: Path) -> bool:
        """Whether the robot is far enough from where the last picture was put aside."""
        if not len(path.x):
            return False
        here = float(path.x[-1]), float(path.y[-1]), float(path.yaw[-1])
        if self._last is None:
            return True
        x, y, yaw = self._last
        turned = abs(math.remainder(here[2] - yaw, math.tau))
        return math.hypot(here[0] - x, here[1] - y) >= STEP_M or turned >= TURN_RAD

    def add(self, picture: Picture, path: Path) -> None:
        """Put a picture aside that was taken at the end of a path."""
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
        told = Picture(picture.stamp_ns, picture.encoding, picture.width, picture.height, picture.step, b"")
        self._kept[picture.stamp_ns] = _Kept(told, self._length, size)
        self._length += size

    def stamps(self) -> list[int]:
        """When they were taken, ascending [ns]."""
        return sorted(self._kept)

    def at(self, wanted_ns: Collection[int]) -> Iterator[Picture]:
        """Those that were taken at some of `stamps`, each once."""
        for stamp_ns in sorted(set(wanted_ns) & self._kept.keys()):
            told, begin, length = self._kept[stamp_ns]
            self._file.seek(begin)
            data = self._file.read(length)
            yield Picture(stamp_ns, told.encoding, told.width, told.height, told.step, data)

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()
