"""The results of the mapped scans on disk, to show a scan that was mapped again without mapping it."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import msgspec
import numpy as np

from app.worker.protocol import LENGTH_BYTES, MessageCodec, Shown, WireError
from pipeline.geometry.columns import columns_of, rows_in_common, rows_of
from pipeline.io.block_file import BlockFile
from pipeline.types.records import Float, Float32, Frame, Path

MOST_FRAME_BYTES = 1 << 30  # of the frames of one map; a scan takes 20 to 100 kB


class StoredScan(msgspec.Struct, frozen=True):
    """The results of a scan.

    Attributes:
        shown: Its frame without points and path; without columns and ground that are those of the scan
            before.
        columns_in, ground_in: Numbers of the scans that have its columns and ground; -1 for none.
        replaced: Rows of the path that the scan replaced.
    """

    shown: Shown
    columns_in: int
    ground_in: int
    replaced: Path | None


class FrameStore:
    """The frames of one map without their points, each with the path and the confirmation times of its time.

    In memory are the newest path and the place of each scan in the file. The rows of the path that a
    correction replaced are in the file.
    """

    def __init__(self) -> None:
        self._blocks = BlockFile(MOST_FRAME_BYTES)
        self._codec: MessageCodec[StoredScan] = MessageCodec(StoredScan)
        self._scans = 0
        self._path: Path | None = None  # after the last scan
        self._corrections: list[tuple[int, int]] = []  # scan, first row of the path that it replaced
        # Columns and ground of the last scan, and the scans that have them.
        self._objects: tuple[object, object] = (None, None)
        self._objects_in = (-1, -1)

    def put(self, frame: Frame, path: Path, time_s: float, confirmed_s: Float) -> None:
        """Store the results of a scan, unless they are stored. All scans are given, in their order. A scan
        that is larger than LARGEST_MESSAGE is left out; once the file is full, no later scan is stored.

        Args:
            frame: Results of the scan; its points are not stored.
            path: Path up to this scan.
            time_s: Time of the scan since the first scan [s].
            confirmed_s: Confirmation time of each tree of the frame [s].
        """
        if frame.index != self._scans:
            return
        start = len(path.x) if self._path is None else rows_in_common(self._path, path)
        replaced = None
        if self._path is not None and start < len(self._path.x):
            replaced = rows_of(self._path, slice(start, None))
        objects = (frame.columns, frame.ground)
        columns_in, ground_in = (
            -1 if value is None else last_in if value is last else frame.index
            for value, last, last_in in zip(objects, self._objects, self._objects_in, strict=True)
        )
        no_points: Float32 = np.zeros((0, 3), np.float32)
        lean = replace(
            frame,
            raw=no_points,
            filtered=no_points,
            labels=frame.labels[:0],
            columns=frame.columns if columns_in == frame.index else None,
            ground=frame.ground if ground_in == frame.index else None,
        )
        shown = Shown(0, time_s, lean, 0, rows_of(path, slice(0, 0)), confirmed_s)
        scan = StoredScan(shown, columns_in, ground_in, replaced)
        # A scan that is larger than a message may be is left out, but later ones are stored.
        with contextlib.suppress(WireError):
            if not self._blocks.put_block(frame.index, self._codec.encode(scan)[LENGTH_BYTES:]):
                return
        if replaced is not None:
            self._corrections.append((frame.index, start))
        self._scans += 1
        self._path, self._objects, self._objects_in = path, objects, (columns_in, ground_in)

    def read(self, index: int) -> Shown | None:
        """Return the results of a scan without points, with the path up to it and the run number 0; None if
        they are not stored."""
        scan = self._read(index)
        path = None if scan is None else self._path_at(index)
        if scan is None or path is None:
            return None
        frame = scan.shown.frame
        for name, number in (("columns", scan.columns_in), ("ground", scan.ground_in)):
            if number not in (-1, index):
                earlier = self._read(number)
                if earlier is None:
                    return None
                frame = replace(frame, **{name: getattr(earlier.shown.frame, name)})
        return msgspec.structs.replace(scan.shown, frame=frame, path=path)

    def forget_from(self, index: int) -> None:
        """Remove the results of the scan with this index and of later ones."""
        if index < self._scans:
            self._path, self._objects = self._path_at(index - 1), (None, None)
            self._scans = index
        self._blocks.forget_from(index)
        self._corrections = [(scan, row) for scan, row in self._corrections if scan < index]

    def close(self) -> None:
        """Delete the file."""
        self._blocks.close()

    def _path_at(self, index: int) -> Path | None:
        """Return the path up to a stored scan; None if it cannot be read or has no scan."""
        end = index + 1
        parts: list[Path] = []
        for scan, start in self._corrections:
            if scan > index and start < end:
                stored = self._read(scan)
                if stored is None or stored.replaced is None:
                    return None
                parts.append(rows_of(stored.replaced, slice(end - start)))
                end = start
        if self._path is None:
            return None
        parts.append(rows_of(self._path, slice(end)))
        return Path(*map(np.concatenate, zip(*map(columns_of, reversed(parts)), strict=True)))

    def _read(self, index: int) -> StoredScan | None:
        """Return what is stored of a scan; None if it is not stored."""
        return self._blocks.read_block(index, self._codec.decode)
