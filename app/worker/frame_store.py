"""The steps of a source and the results of the mapped scans on disk, so that a scan that was mapped is shown
again without mapping it."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any, cast

import msgspec
import numpy as np

from app.common.arrays import rows_of
from app.worker.outbox import path_columns, rows_in_common
from app.worker.protocol import LENGTH_BYTES, MessageCodec, Shown, WireError
from pipeline.io.block_file import BlockFile, unnamed_file
from pipeline.io.checkpoints import record_bytes, record_of
from pipeline.types.records import Columns, Float, Float32, Frame, HeightMap, Path, Step

MOST_FRAME_BYTES = 1 << 30  # of the frames of one map; a scan takes 20 to 100 kB
MOST_STEP_BYTES = 4 << 30  # of the steps of a source; a scan of 30,000 points takes 0.3 MB


class StepStore:
    """The steps of a source.

    Args:
        folder: Folder of the file, which has no name; None for the folder of the system.
    """

    def __init__(self, folder: FilePath | None) -> None:
        self._blocks = BlockFile(unnamed_file(folder), folder=folder, most=MOST_STEP_BYTES)

    def put(self, step: Step) -> None:
        """Store a step, unless one of its index is stored or no more can be stored."""
        if step.index not in self._blocks:
            self._blocks.put_block(step.index, record_bytes(step))

    def read(self, index: int) -> Step | None:
        """Return the step with an index; None if it is not stored."""
        return self._blocks.read_block(index, lambda block: record_of(Step, block))

    def close(self) -> None:
        """Delete the file."""
        self._blocks.close()


# Blocks of a scan: its frame without points, voxel columns and ground, and these two.
_CODECS: tuple[MessageCodec[Any], ...] = (MessageCodec(Shown), MessageCodec(Columns), MessageCodec(HeightMap))


@dataclass(frozen=True, slots=True)
class _Stored:
    """What is known of a stored scan.

    Attributes:
        start: Number of rows of the path that are those of the scan before.
        path: The rows of the path from there on.
        blocks: Number of the block of its voxel columns, and of its ground; None for none. The same object in
            consecutive scans is stored once.
    """

    start: int
    path: Path
    blocks: tuple[int | None, ...]


class FrameStore:
    """The frames of one map without their points, each with the path and the confirmation times of its time.

    Args:
        folder: Folder of the file, which has no name; None for the folder of the system.
    """

    def __init__(self, folder: FilePath | None) -> None:
        self._blocks = BlockFile(unnamed_file(folder), folder=folder, most=MOST_FRAME_BYTES)
        self._scans: list[_Stored] = []
        self._path: Path | None = None  # after the last scan
        self._objects: tuple[object, ...] = (None, None)  # columns and ground of the last scan

    def put(self, frame: Frame, path: Path, time_s: float, confirmed_s: Float) -> None:
        """Store the results of a scan, unless they are stored or no more can be stored. All scans are given,
        in their order.

        Args:
            frame: Results of the scan; its points are not stored.
            path: Path up to this scan.
            time_s: Time of the scan since the first scan [s].
            confirmed_s: Confirmation time of each tree of the frame [s].
        """
        if frame.index != len(self._scans):
            return
        first = len(_CODECS) * frame.index
        start = 0 if self._path is None else rows_in_common(self._path, path)
        objects = (frame.columns, frame.ground)
        blocks: list[int | None] = []
        for kind, (value, last) in enumerate(zip(objects, self._objects, strict=True)):
            if value is None:
                blocks.append(None)
            elif value is last:  # stored with an earlier scan
                blocks.append(self._scans[-1].blocks[kind])
            else:
                blocks.append(first + 1 + kind)
                self._put(first + 1 + kind, value)
        no_points: Float32 = np.zeros((0, 3), np.float32)
        lean = replace(
            frame, raw=no_points, filtered=no_points, labels=frame.labels[:0], columns=None, ground=None
        )
        if all(block is None or block in self._blocks for block in blocks):
            self._put(first, Shown(0, time_s, lean, 0, rows_of(path, slice(0, 0)), confirmed_s))
        rows = rows_of(path, np.arange(start, len(path.x)))  # a copy
        self._scans.append(_Stored(start, rows, tuple(blocks)))
        self._path, self._objects = path, objects

    def read(self, index: int) -> Shown | None:
        """Return the results of a scan without points, with the whole path; None if they are not stored."""
        if not 0 <= index < len(self._scans):
            return None
        shown = self._read(len(_CODECS) * index)
        if shown is None:
            return None
        columns, ground = map(self._read, self._scans[index].blocks)
        frame = replace(shown.frame, columns=columns, ground=ground)
        shown = msgspec.structs.replace(shown, frame=frame, path=self._path_at(index))
        return cast(Shown, shown)

    def forget_from(self, index: int) -> None:
        """Remove the results of the scan with this index and of later ones."""
        self._blocks.forget_from(len(_CODECS) * index)
        del self._scans[index:]
        self._path, self._objects = None, (None, None)

    def close(self) -> None:
        """Delete the file."""
        self._blocks.close()

    def _path_at(self, index: int) -> Path:
        """Return the path up to a stored scan."""
        end = self._scans[index].start + len(self._scans[index].path.x)
        parts: list[Path] = []
        while end > 0:
            stored = self._scans[index]
            if stored.start < end:
                parts.append(rows_of(stored.path, slice(end - stored.start)))
                end = stored.start
            index -= 1
        return Path(*map(np.concatenate, zip(*map(path_columns, reversed(parts)), strict=True)))

    def _put(self, block: int, value: object) -> None:
        """Store a block, unless it is larger than a message may be or no more can be stored."""
        with contextlib.suppress(WireError):
            content = _CODECS[block % len(_CODECS)].encode(value)[LENGTH_BYTES:]
            self._blocks.put_block(block, content)

    def _read(self, block: int | None) -> Any:  # noqa: ANN401 - the type belongs to the block
        """Return the content of a block; None for None, or if it is not stored."""
        return None if block is None else self._blocks.read_block(block, _CODECS[block % len(_CODECS)].decode)
