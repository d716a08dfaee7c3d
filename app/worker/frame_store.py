"""Results of the mapped scans on disk, so that a scan that was mapped is shown again without mapping it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath
from typing import Any

import msgspec
import numpy as np
import zstandard

from app.worker.outbox import joined, rows_from, rows_in_common
from app.worker.protocol import LENGTH_BYTES, MessageCodec, Shown, WireError
from pipeline.io.block_file import BlockFile, unnamed_file
from pipeline.io.checkpoints.codec import decode, encode
from pipeline.types.records import Bool, Columns, Float, Float32, Frame, HeightMap, Path, Step, Trees

MOST_FRAME_BYTES = 1 << 30  # of the frames of one map; a scan takes 20 to 100 kB
MOST_STEP_BYTES = 4 << 30  # of the steps of a source; a scan of 30,000 points takes 0.3 MB
_LEVEL = 1  # higher levels take longer and save a few percent
# Scans between two whole paths; in between, only the rows are stored that differ from the scan before.
_WHOLE_PATH = 32
_FRAME, _COLUMNS, _GROUND, _PATH = range(4)  # blocks of a scan


class StepStore:
    """The steps of a source, which are read once.

    Args:
        folder: Folder of the file, which has no name; None for the folder of the system.
    """

    def __init__(self, folder: FilePath | None) -> None:
        self._blocks = BlockFile(unnamed_file(folder), folder=folder, most=MOST_STEP_BYTES)

    def put(self, step: Step) -> None:
        """Store a step, unless one of its index is stored or no more can be stored."""
        if step.index not in self._blocks:
            tree, arrays = encode(step, planes=True)
            text = msgspec.json.encode(tree)
            block = len(text).to_bytes(LENGTH_BYTES, "little") + text + arrays
            self._blocks.put_block(step.index, zstandard.ZstdCompressor(_LEVEL).compress(block))

    def read(self, index: int) -> Step | None:
        """Return the step with an index; None if it is not stored."""
        return self._blocks.read_block(index, _unpacked_step)

    def close(self) -> None:
        """Delete the file."""
        self._blocks.close()


class _PathRows(msgspec.Struct, frozen=True):
    """Rows of the path after a scan, from row `start` onwards; the rows before are those of the scan
    before."""

    start: int
    rows: Path


_CODECS: dict[int, MessageCodec[Any]] = {
    _FRAME: MessageCodec(Shown),
    _COLUMNS: MessageCodec(Columns),
    _GROUND: MessageCodec(HeightMap),
    _PATH: MessageCodec(_PathRows),
}


@dataclass(slots=True)
class _Stored:
    """What is stored of a scan.

    Attributes:
        columns, ground: Scans with the block of its voxel columns and of its ground; None for none.
        own_numbers: Whether its trees have the numbers of the map, see `FrameStore.renumber`.
    """

    columns: int | None
    ground: int | None
    own_numbers: bool


@dataclass(slots=True)
class _Last:
    """The scan that was stored last, with its objects: an object that is unchanged is not stored again."""

    index: int = -1
    path: Path | None = None
    columns: Columns | None = None
    ground: HeightMap | None = None


@dataclass(slots=True, eq=False)
class FrameStore:
    """The frames of one map without their points, each with the path and the confirmation times of its time.

    Attributes:
        folder: Folder of the file, which has no name; None for the folder of the system.
    """

    folder: FilePath | None
    _blocks: BlockFile = field(init=False)
    _scans: dict[int, _Stored] = field(default_factory=dict)
    _last: _Last = field(default_factory=_Last)
    _number_of: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._blocks = BlockFile(unnamed_file(self.folder), folder=self.folder, most=MOST_FRAME_BYTES)

    def put(self, frame: Frame, path: Path, time_s: float, confirmed_s: Float, *, own_numbers: bool) -> None:
        """Store the results of a scan, unless they are stored or no more can be stored.

        Args:
            frame: Results of the scan; its points are not stored.
            path: Path up to this scan.
            time_s: Time of the scan since the first scan [s].
            confirmed_s: Confirmation time of each tree of the frame [s].
            own_numbers: Whether the trees have the numbers of the map, see `renumber`.
        """
        index, last = frame.index, self._last
        if index in self._scans:
            return
        stored = _Stored(
            self._object(index, _COLUMNS, frame.columns, last.columns),
            self._object(index, _GROUND, frame.ground, last.ground),
            own_numbers,
        )
        follows = last.index == index - 1 and index % _WHOLE_PATH > 0
        start = rows_in_common(last.path, path) if follows and last.path is not None else 0
        no_points: Float32 = np.zeros((0, 3), np.float32)
        lean = replace(
            frame, raw=no_points, filtered=no_points, labels=frame.labels[:0], columns=None, ground=None
        )
        shown = Shown(0, time_s, lean, 0, rows_from(path, len(path.x)), confirmed_s)
        if (
            self._put(index, _PATH, _PathRows(start, rows_from(path, start)))
            and self._put(index, _FRAME, shown)
            and (frame.columns is None or stored.columns is not None)
            and (frame.ground is None or stored.ground is not None)
        ):
            self._scans[index] = stored
            self._last = _Last(index, path, frame.columns, frame.ground)

    def read(self, index: int) -> Shown | None:
        """Return the results of a scan without points, with the whole path; None if they are not stored."""
        stored = self._scans.get(index)
        shown: Shown | None = self._read(index, _FRAME)
        path = self._path(index)
        if stored is None or shown is None or path is None:
            return None
        columns = None if stored.columns is None else self._read(stored.columns, _COLUMNS)
        ground = None if stored.ground is None else self._read(stored.ground, _GROUND)
        frame, confirmed_s = replace(shown.frame, columns=columns, ground=ground), shown.confirmed_s
        if stored.own_numbers and confirmed_s is not None:
            known = np.isin(frame.trees.number, list(self._number_of))
            frame = replace(frame, trees=_renumbered(frame.trees, known, self._number_of))
            confirmed_s = confirmed_s[known]
        return msgspec.structs.replace(shown, frame=frame, path=path, confirmed_s=confirmed_s)

    def renumber(self, number_of: Mapping[int, int]) -> None:
        """Set the numbers that people see of the trees that were stored with the numbers of the map; trees
        without such a number are left out.

        Args:
            number_of: Number by the number in the map.
        """
        self._number_of = dict(number_of)

    def forget_from(self, index: int) -> None:
        """Remove the results of the scan with this index and of later ones."""
        self._blocks.forget_from(len(_CODECS) * index)
        self._scans = {known: stored for known, stored in self._scans.items() if known < index}
        if self._last.index >= index:
            self._last = _Last()

    def close(self) -> None:
        """Delete the file."""
        self._blocks.close()

    def _object(self, index: int, kind: int, value: object, last: object) -> int | None:
        """Store an object of a scan unless it is that of the scan before; return the scan with its block,
        None for none."""
        if value is None:
            return None
        if value is last:
            before = self._scans[self._last.index]
            return before.columns if kind == _COLUMNS else before.ground
        return index if self._put(index, kind, value) else None

    def _path(self, index: int) -> Path | None:
        """Return the path up to a scan; None if it is not stored."""
        found = self._read(index, _PATH)
        start, parts = (0, []) if found is None else (found.start, [found.rows])
        while found is not None and start > 0:
            index -= 1
            found = self._read(index, _PATH)
            if found is not None and found.start < start:
                parts.append(_first(found.rows, start - found.start))
                start = found.start
        if found is None:
            return None
        path: Path = parts.pop()
        while parts:
            path = joined(path, len(path.x), parts.pop())
        return path

    def _put(self, index: int, kind: int, value: object) -> bool:
        """Store a block of a scan; return whether it is stored."""
        try:
            block = _CODECS[kind].encode(value)[LENGTH_BYTES:]
        except WireError:
            return False
        return self._blocks.put_block(
            len(_CODECS) * index + kind, zstandard.ZstdCompressor(_LEVEL).compress(block)
        )

    def _read(self, index: int, kind: int) -> Any:  # noqa: ANN401 - the type belongs to the kind
        """Return the content of a block of a scan; None if it is not stored."""

        def unpacked(block: bytearray) -> object:
            return _CODECS[kind].decode(zstandard.ZstdDecompressor().decompress(block))

        return self._blocks.read_block(len(_CODECS) * index + kind, unpacked)


def _unpacked_step(block: bytearray) -> Step:
    data = zstandard.ZstdDecompressor().decompress(block)
    end = LENGTH_BYTES + int.from_bytes(data[:LENGTH_BYTES], "little")
    return decode(Step, msgspec.json.decode(data[LENGTH_BYTES:end]), data[end:], planes=True)


def _first(path: Path, rows: int) -> Path:
    """Return the first rows of a path."""
    return Path(*(getattr(path, name)[:rows] for name in Path.__slots__))


def _renumbered(trees: Trees, known: Bool, number_of: Mapping[int, int]) -> Trees:
    """Return the known rows of a table of trees with other numbers."""
    columns = {name: column for name in Trees.__slots__ if (column := getattr(trees, name)) is not None}
    kept = {name: column[known] for name, column in columns.items()}
    kept["number"] = np.array([number_of[number] for number in kept["number"].tolist()], np.int64)
    return Trees(**kept)
