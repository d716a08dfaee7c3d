"""Outgoing messages of the worker: only the newest frame is sent, all other messages are kept; and the scans
that were sent last."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque
from dataclasses import replace
from typing import BinaryIO

import numpy as np
from msgspec import structs

from app.worker.protocol import FromWorker, Opened, Report, Shown, Unmapped, WireError, from_worker
from pipeline.geometry.columns import evenly_spaced, rows_in_common, rows_of
from pipeline.types.records import Frame, HeightMap, Path

# A higher frame rate is not visible and would only fill the pipe and the sockets.
_SHORTEST_PAUSE_S = 0.05
# Answers and notices; a web process that reads none of them has ended or does not respond.
MOST_MESSAGES = 500


class Outbox:
    """Writes messages to a stream in a separate thread, so that a slow reader never stops the mapping.

    A newer frame replaces a waiting frame. A newer status replaces a waiting status if that is the last
    message of the queue and source and state are the same. Other messages are sent in order; beyond
    MOST_MESSAGES the oldest is dropped. After `Opened`, no frame of an older run is sent. The status of a
    paused or finished run is sent after its frame, so that the web process never receives the time of a scan
    that it cannot show. A message that cannot be sent is dropped, and the status has a warning.

    Args:
        stream: Output stream; it is not closed here.
        recent: Stores the frames that are sent.
    """

    def __init__(self, stream: BinaryIO, recent: RecentScans | None = None) -> None:
        self._stream = stream
        self._recent = recent or RecentScans()
        self._codec = from_worker()
        self._changed = threading.Condition()
        self._messages: deque[FromWorker] = deque()
        self._picture: Shown | None = None
        self._closing = False
        self._sent_run = -1
        self._sent_path: Path | None = None
        self._sent_ground: HeightMap | None = None
        self._sent_at = -_SHORTEST_PAUSE_S
        self._report: Report | None = None
        self._refused = ""
        self._thread = threading.Thread(target=self._write_all, name="mailbox", daemon=True)
        self._thread.start()

    def put(self, message: FromWorker) -> None:
        """Queue a message without waiting. Of several waiting frames, or messages that replace each other,
        only the newest one is sent; if MOST_MESSAGES wait, the oldest is dropped and later statuses have a
        warning."""
        with self._changed:
            if isinstance(message, Shown):
                self._picture = message
            else:
                if isinstance(message, Opened):
                    self._picture = None  # of the run before
                if self._messages and _replaces(message, self._messages[-1]):
                    self._messages.pop()
                if len(self._messages) >= MOST_MESSAGES:
                    self._messages.popleft()
                    self._refused = "the web process reads too slowly: messages were left out"
                self._messages.append(message)
            self._changed.notify()

    def close(self, timeout_s: float = 0.3) -> None:
        """Send the waiting messages and end the thread. What the reader does not take in time is not sent.

        Args:
            timeout_s: Maximum time to wait for the thread [s].
        """
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(timeout_s)

    def _write_all(self) -> None:
        """Send messages until `close`, or until the stream cannot be written, because its reader is gone.
        Runs in a thread."""
        try:
            while (message := self._next()) is not None:
                for packed in self._packed(message):
                    self._stream.write(packed)
                self._stream.flush()
        except (BrokenPipeError, ValueError, OSError):
            return  # the web process is gone; the reader of commands ends the worker

    def _packed(self, message: FromWorker) -> list[bytes]:
        """Return a list of the encoded message. If the message is too large or has a value that cannot be
        sent, return a list of the last status with a warning, encoded, or an empty list if no status was
        sent. After a frame that was not sent, the next frame has the whole path and the ground."""
        try:
            return [self._codec.encode(self._made_ready(message))]
        except (WireError, NotImplementedError, ValueError, OverflowError) as error:
            if isinstance(message, Shown):
                self._sent_path = self._sent_ground = None  # what was in it did not arrive
            if self._report is message:
                self._report = None
            self._refused = f"a message could not be sent: {error}"
            return [] if self._report is None else [self._codec.encode(self._with_refusal(self._report))]

    def _made_ready(self, message: FromWorker) -> FromWorker:
        """Return a message as it is sent: a frame with only what was not sent before, a status with the
        warning about dropped messages. A frame is stored in `recent`; `Opened` clears the warning."""
        if isinstance(message, Shown):
            self._sent_at = time.monotonic()
            self._recent.keep(message.run, message.frame)
            return self._with_new_path_only(message)
        if isinstance(message, Unmapped):
            return structs.replace(message, frame=picture_of(message.frame))
        if isinstance(message, Opened):
            self._refused = ""
        elif isinstance(message, Report):
            self._report = message
            return self._with_refusal(message)
        return message

    def _with_refusal(self, report: Report) -> Report:
        """Return a status with the last warning about dropped messages appended; the status itself if there
        is no warning."""
        if not self._refused:
            return report
        return Report(replace(report.status, warnings=[*report.status.warnings, self._refused]))

    def _next(self) -> FromWorker | None:
        """Wait for the next message, remove it from the queue and return it; None after `close` if nothing is
        queued. Other messages come before a frame, except the status "paused" or "finished". A frame is
        returned at the earliest _SHORTEST_PAUSE_S after the previous frame, or at once after `close`."""
        with self._changed:
            while True:
                if self._messages and (self._picture is None or not _is_standing(self._messages[0])):
                    return self._messages.popleft()
                wait = self._sent_at + _SHORTEST_PAUSE_S - time.monotonic()
                if self._picture is not None and (wait <= 0 or self._closing):
                    picture, self._picture = self._picture, None
                    return picture
                if self._closing:
                    return None
                self._changed.wait(wait if self._picture is not None else None)

    def _with_new_path_only(self, shown: Shown) -> Shown:
        """Return the frame with only the rows of the path that were not sent before, at most MOST_POINTS raw
        and filtered points each, and without the ground if it was sent before. Path and ground count as sent
        from now on."""
        old, self._sent_path = self._sent_path, shown.path
        start = 0 if old is None or shown.run != self._sent_run else rows_in_common(old, shown.path)
        picture, reflectance = picture_of(shown.frame), shown.reflectance
        if reflectance is not None:
            reflectance = reflectance[evenly_spaced(len(reflectance), MOST_POINTS)]
        if picture.ground is self._sent_ground and shown.run == self._sent_run:
            picture = replace(picture, ground=None)
        else:
            self._sent_ground = picture.ground
        self._sent_run = shown.run
        return structs.replace(
            shown,
            frame=picture,
            path_start=start,
            path=rows_of(shown.path, slice(start, None)),
            odometry_xy=shown.odometry_xy[start:],
            reflectance=reflectance,
        )


def _is_standing(message: FromWorker) -> bool:
    """Return whether a message is a report of the state "paused" or "finished"; other states in which the run
    does not play, e.g. "starting", "waiting" and "failed", do not count."""
    return isinstance(message, Report) and message.status.state in ("paused", "finished")


def _replaces(newer: FromWorker, older: FromWorker) -> bool:
    """Return whether a status replaces a waiting status.

    Each change of source or state is sent: the web process follows an opening by the states in turn.
    """
    if not isinstance(newer, Report) or not isinstance(older, Report):
        return False
    return (newer.status.source, newer.status.state) == (older.status.source, older.status.state)


MOST_POINTS = 200_000
NOT_DRAWN = "not drawn"


def picture_of(frame: Frame) -> Frame:
    """Return the frame with at most MOST_POINTS raw and MOST_POINTS filtered points, selected evenly; the
    frame itself if it has no more.

    If points were left out, `counts["not drawn"]` is their number.
    """
    raw = evenly_spaced(len(frame.raw), MOST_POINTS)
    filtered = evenly_spaced(len(frame.filtered), MOST_POINTS)
    left_out = len(frame.raw) - len(raw) + len(frame.filtered) - len(filtered)
    if left_out == 0:
        return frame
    return replace(
        frame,
        raw=frame.raw[raw],
        filtered=frame.filtered[filtered],
        labels=frame.labels[filtered],
        counts={**frame.counts, NOT_DRAWN: left_out},
    )


def for_comparison(frame: Frame) -> Frame:
    """Return the frame for the comparison of parameter sets: as `picture_of`, without raw points, voxel
    columns and ground, which do not depend on the parameters or are not rendered."""
    return picture_of(replace(frame, raw=np.zeros((0, 3), np.float32), columns=None, ground=None))


_MOST_SCANS = 60  # at twenty scans per second a click may be three seconds old


class RecentScans:
    """The 60 scans that were sent to the browsers last, without their raw points. Thread-safe."""

    def __init__(self) -> None:
        self._frames: OrderedDict[tuple[int, int], Frame] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, run: int, frame: Frame) -> None:
        """Store a scan without its raw points, in place of an earlier result of the same scan. Beyond
        _MOST_SCANS, the scans that were stored first are removed.

        Args:
            run: Number of the run.
            frame: Results of the scan.
        """
        small = replace(frame, raw=np.zeros((0, 3), np.float32))
        with self._lock:
            self._frames[run, frame.index] = small
            self._frames.move_to_end((run, frame.index))
            while len(self._frames) > _MOST_SCANS:
                self._frames.popitem(last=False)

    def forget(self) -> None:
        """Remove all scans."""
        with self._lock:
            self._frames.clear()

    def find(self, run: int, scan: int) -> Frame | None:
        """Return a scan as it was sent last, but with an empty `raw`; None if it is not stored.

        Args:
            run: Number of the run.
            scan: Index of the scan.
        """
        with self._lock:
            return self._frames.get((run, scan))
