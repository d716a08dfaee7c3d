"""The recording of a live run while it is made. A disk that refuses ends the recording, never the map."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any

from pipeline.errors import SourceError
from pipeline.io.readers.container import Channel, Message
from pipeline.io.recording import outputs
from pipeline.io.recording.live_writer import LiveWriter
from pipeline.types.records import Frame, Path

_FLUSH_S = 0.5
_MAP_PAUSE_S = 1.0
_MOST_NAMES = 1000


class Recording:
    """One file that grows.

    Args:
        path: Of the file; where one is there already, a number is added to the name.
        clock: Seconds from any start.

    Attributes:
        problem: Why it ended before the run, "" while all is well.

    Raises:
        SourceError: The file cannot be made.
    """

    def __init__(self, path: FilePath, clock: Callable[[], float] = time.monotonic) -> None:
        self.problem = ""
        self.path: FilePath
        self._file: RawFile | None
        self._clock = clock
        self._writer: LiveWriter | None = None
        self._flushed_at = self._map_at = -_MAP_PAUSE_S
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.path, self._file = _new_file(path)
        except OSError as error:
            raise SourceError(
                f"cannot record: {error.strerror}", where=str(path), remedy="Name another file with --record."
            ) from error

    @property
    def words(self) -> str:
        """For the strip: where it goes and how long it is, or why it ended."""
        if self.problem:
            return f"not recording: {self.problem}"
        size = 0 if self._file is None else self._file.tell()
        return f"recording {self.path.name}, {size / 1e6:.0f} MB"

    def begin(self, channels: Sequence[Channel], told: Mapping[str, Any], robot: str) -> None:
        """The robot's topics are known."""

        if self._file is None:
            return
        try:
            self._writer = LiveWriter(self._file, channels, told, robot)
        except OSError as error:
            self._refused(error)

    def add(self, message: Message) -> None:
        """A message that the run takes in."""
        self._guarded(lambda writer: writer.add(message))
        self.flush_when_due()

    def add_frame(self, frame: Frame, path: Path) -> None:
        """What came of a scan."""
        if self._writer is None:
            return
        found = outputs.scan_messages(frame)
        if self._clock() >= self._map_at + _MAP_PAUSE_S:
            self._map_at = self._clock()
            found |= outputs.map_messages(frame, path)
        self._guarded(lambda writer: writer.add_outputs(found))

    def add_parameters(self, revision: int, from_scan: int, values: Mapping[str, Any]) -> None:
        """Parameters that are in force from a scan on."""
        self._guarded(lambda writer: writer.add_parameters(revision, from_scan, values))

    def flush_when_due(self) -> None:
        """Hand to the system what waits, twice a second."""
        if self._clock() >= self._flushed_at + _FLUSH_S:
            self._flushed_at = self._clock()
            self._guarded(lambda writer: writer.flush())

    def close(self) -> None:
        """Write the index and close the file; a file without a message goes."""
        self._guarded(lambda writer: writer.finish())
        empty = self._writer is None and not self.problem
        self._end()
        if empty:
            self.path.unlink(missing_ok=True)

    def _end(self) -> None:
        file, self._file, self._writer = self._file, None, None
        if file is not None:
            file.close()

    def _guarded(self, work: Callable[[LiveWriter], None]) -> None:
        if self._writer is None:
            return
        try:
            work(self._writer)
        except OSError as error:
            self._refused(error)

    def _refused(self, error: OSError) -> None:
        self.problem = (
            f"{error.strerror or error} ({self.path}). What was written until then is kept; the map goes on"
        )
        self._end()


class RawFile:
    """A new file without a buffer of its own: what was written is with the system when `write` returns."""

    def __init__(self, path: FilePath) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        self._length = 0

    def write(self, data: bytes) -> int:
        """Write all of it.

        Raises:
            OSError: The disk refuses; a part may be written.
        """
        rest = memoryview(data)
        while rest:
            written = os.write(self._descriptor, rest)
            self._length += written
            rest = rest[written:]
        return len(data)

    def tell(self) -> int:
        """How much was written."""
        return self._length

    def close(self) -> None:
        """Close it."""
        os.close(self._descriptor)


def _new_file(path: FilePath) -> tuple[FilePath, RawFile]:
    """A file of this name, or of one with a number."""
    named = path
    for k in range(2, _MOST_NAMES):
        try:
            return named, RawFile(named)
        except FileExistsError:
            named = path.with_name(f"{path.stem}-{k}{path.suffix}")
    return named, RawFile(named)
