"""Recorder of a live run: writes every message that arrives to an MCAP file, independently of the mapping.

The recorder has its own thread and a bounded queue. Mapping that is slow, paused or waiting for a compiled
kernel does not delay it. A disk error ends the recording, never the map.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any

from pipeline.errors import SourceError
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel, Message
from pipeline.io.recording.mcap_writer import LiveWriter

#: Bytes that wait for the disk at most: several seconds of a fast LiDAR.
QUEUE_BYTES = 256 << 20
#: The thread empties the queue, and ends a chunk of the file, at these intervals [s].
_WRITE_S, _FLUSH_S = 0.05, 0.5
#: `close` waits this long for a slow disk [s].
_CLOSE_S = 8.0
_MAX_NUMBERED_NAMES = 1000

NOT_RECORDED = "messages not recorded because the disk is too slow"

_Work = Callable[[LiveWriter], None]


class Recorder:
    """Writes one file in a separate thread. Every method may be called from any thread and returns at once,
    except `close`.

    Args:
        path: The file, which is created at once, with its folder. If it exists, a number is appended to the
            name.

    Attributes:
        path: The file that is written.
        problem: Reason why the recording ended before the run; "" otherwise.
        losses: Dict from reasons to numbers of messages that were not recorded.

    Raises:
        SourceError: The file cannot be created.
    """

    def __init__(self, path: FilePath) -> None:
        self.problem = ""
        self.losses: dict[str, int] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._queue: deque[tuple[int, _Work]] = deque()
        self._queued_bytes = 0
        self._skipped: dict[int, list[int]] = {}
        self._topics: dict[int, str] = {}
        self._thread: threading.Thread | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.path, self._file = _new_file(path)
        except OSError as error:
            raise SourceError(
                f"cannot record: {error.strerror}", where=str(path), remedy="Name another file with --record."
            ) from error

    @property
    def status(self) -> str:
        """The file and its size, or the reason why the recording ended, as one line; "" without a file."""
        if self.problem:
            return f"not recording: {self.problem}"
        lost = sum(self.losses.values())
        missing = f", {lost:,} messages missing because the disk is too slow" if lost else ""
        word = "recording"
        if self._closing.is_set():
            if self._thread is None:
                return ""  # it ended before the first message, and the empty file is deleted
            word = "finishing" if self._thread.is_alive() else "recorded"
        return f"{word} {self.path.name}, {self._file.tell() / 1e6:.0f} MB{missing}"

    @property
    def is_open(self) -> bool:
        """Whether it records, or will when the first message arrives."""
        return not self.problem and not self._closing.is_set()

    @property
    def begun(self) -> bool:
        """Whether the file has a beginning; it stays after the run."""
        return self._thread is not None

    def begin(self, channels: Sequence[Channel], header: Mapping[str, Any], robot: str) -> None:
        """Write the beginning of the file and start the thread. A second call, and one after `close`, does
        nothing; a disk error ends the recording, see `problem`.

        Args:
            channels: Channels of the robot, whose numbers messages refer to.
            header: Address and topics of the run, as JSON values.
            robot: Namespace of the robot, "" for none.
        """
        with self._lock:
            if self._thread is not None or self._closing.is_set():
                return
            self._topics = {channel.number: channel.topic for channel in channels}
            try:
                writer = LiveWriter(self._file, channels, header, robot)
            except OSError as error:
                self._end_with(error)
                return
            self._thread = threading.Thread(target=self._run, args=(writer,), name="recorder", daemon=True)
            self._thread.start()

    def add(self, message: Message) -> None:
        """Record a message of the robot. It is dropped and counted in `losses` if the queue is full; dropped
        after the end of the recording."""
        self._put(len(message.payload), lambda writer: writer.add(message))

    def skip(self, message: Message) -> None:
        """Record that the mapping did not use a message that was recorded."""
        with self._lock:
            self._skipped.setdefault(message.channel, []).append(message.log_ns)

    def add_outputs(self, messages_by_topic: Mapping[str, bytes]) -> None:
        """Record results of the mapping, a dict from the topic to the message in CDR, see
        `pipeline.io.recording.messages`. They are dropped as by `add`."""
        size = sum(map(len, messages_by_topic.values()))
        self._put(size, lambda writer: writer.add_outputs(messages_by_topic))

    def add_parameters(self, revision: int, from_scan: int, values: Mapping[str, Any]) -> None:
        """Record parameters that apply from a mapped scan onwards; nothing happens after the end of the
        recording.

        Args:
            revision: Number of the revision.
            from_scan: Index of the first scan that is mapped with them.
            values: Dict from the stage to a dict from names to values.
        """
        self._put(0, lambda writer: writer.add_parameters(revision, from_scan, values))

    def close(self) -> None:
        """Write the queued messages and the index, and close the file; waits at most 8 s for a slow disk. If
        `begin` was never called, the empty file is deleted."""
        self._closing.set()
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join(_CLOSE_S)
            return
        self._file.close()
        if not self.problem:
            self.path.unlink(missing_ok=True)

    def _put(self, size: int, work: _Work) -> None:
        """Queue an entry; it is dropped after the end of the recording, and counted if the queue is full.

        Args:
            size: Number of bytes that count towards QUEUE_BYTES.
            work: Function that writes the entry with the given writer.
        """
        with self._lock:
            if self.problem or self._closing.is_set():
                return
            if self._queued_bytes + size > QUEUE_BYTES:
                count_loss(self.losses, NOT_RECORDED)
                return
            self._queued_bytes += size
            self._queue.append((size, work))

    def _run(self, writer: LiveWriter) -> None:
        """Write the queue until `close`, and finish the file. Runs in a thread; an error ends the recording,
        see `problem`."""
        flushed_s = time.monotonic()
        try:
            while True:
                is_last = self._closing.wait(_WRITE_S)
                self._write_queue(writer)
                if is_last:
                    self._write_skipped(writer)
                    writer.finish()
                    break
                if time.monotonic() >= flushed_s + _FLUSH_S:
                    flushed_s = time.monotonic()
                    self._write_skipped(writer)
                    writer.flush()
        except OSError as error:
            self._end_with(error)
        except Exception as error:  # a thread that ends silently would look like a recording that goes on
            self._end_with(OSError(0, f"{type(error).__name__}: {error}"))
        finally:
            self._file.close()

    def _write_queue(self, writer: LiveWriter) -> None:
        """Write all queued entries; raises OSError of the disk."""
        with self._lock:
            entries, self._queue = self._queue, deque()
        for size, work in entries:
            work(writer)
            with self._lock:
                self._queued_bytes -= size

    def _write_skipped(self, writer: LiveWriter) -> None:
        """Write which messages were skipped since the last call."""
        with self._lock:
            skipped, self._skipped = self._skipped, {}
        if skipped:
            writer.add_skipped({self._topics[number]: times for number, times in skipped.items()})

    def _end_with(self, error: OSError) -> None:
        """End the recording because of an error; what was written stays."""
        self.problem = (
            f"{error.strerror or error} ({self.path}). What was written until then is kept; mapping continues"
        )
        self._queue.clear()


class RawFile:
    """A new file without a user-space buffer: the system has the bytes when `write` returns. Only its owner
    may read it.

    Args:
        path: The file.

    Raises:
        FileExistsError: The file exists.
        OSError: The file cannot be created.
    """

    def __init__(self, path: FilePath) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        self._length = 0

    def write(self, data: bytes) -> int:
        """Write all bytes and return their number.

        Raises:
            OSError: The bytes cannot be written; a part of them may be written.
        """
        rest = memoryview(data)
        while rest:
            written = os.write(self._descriptor, rest)
            self._length += written
            rest = rest[written:]
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._length

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


def _new_file(path: FilePath) -> tuple[FilePath, RawFile]:
    """Create the file, or one with a number appended ("-2" and so on) if the name is taken; return its path
    and the open file. OSError if it cannot be created."""
    named = path
    for k in range(2, _MAX_NUMBERED_NAMES):
        try:
            return named, RawFile(named)
        except FileExistsError:
            named = path.with_name(f"{path.stem}-{k}{path.suffix}")
    return named, RawFile(named)
