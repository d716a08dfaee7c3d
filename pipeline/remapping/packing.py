"""Segmented scans as compressed blocks of bytes; unpacking returns the same bits.

A block holds the length of the text, the text (JSON, see `pipeline.io.checkpoints.codec`) and the arrays,
compressed by Zstandard. The bytes of the arrays are arranged by significance, because equal bytes next to
each other compress well.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import zstandard

from pipeline.classification.voxel_map import SLICE, SLICES
from pipeline.front_end import ColumnInput, SegmentedScan
from pipeline.geometry.quantisation import POINT
from pipeline.io.checkpoints.codec import decode, encode
from pipeline.types.records import Float, Float32, Int32, Learnt, Scan, Step, UInt16

HIGHEST = SLICES * SLICE  # m above the ground; higher points are not integrated into the columns
LARGEST = 1 << 28  # bytes of a block; the largest known clouds need a fiftieth
_LEVEL = 1  # higher levels take longer and save one percent
_LENGTH = struct.Struct("<I")


class TooLargeError(ValueError):
    """A scan is larger than the cache accepts."""


@dataclass(frozen=True, slots=True, eq=False)
class _PackedColumnInput:
    """`ColumnInput` with points in steps of POINT: x, y and height above the ground, shape (3, N)."""

    points: Int32
    steepest: Float
    depth: UInt16
    terrain: Float

    @classmethod
    def of(cls, given: ColumnInput) -> _PackedColumnInput:
        """Pack the points that can be integrated into columns; their z is not used and not stored."""
        low = (given.height > 0.0) & (given.height < HIGHEST)
        places = np.stack([given.points[low, 0], given.points[low, 1], given.height[low]])
        steps = np.rint(places * np.float32(1.0 / POINT)).astype(np.int32)
        return cls(steps, given.steepest, np.ascontiguousarray(given.depth.T), given.terrain)

    def unpacked(self) -> ColumnInput:
        """Return the input; z of the points is 0."""
        places = self.points.astype(np.float32) * np.float32(POINT)
        points = np.zeros((places.shape[1], 3), np.float32)
        points[:, 0], points[:, 1] = places[0], places[1]
        depth = np.ascontiguousarray(self.depth.T)
        return ColumnInput(points, places[2].copy(), self.steepest, depth, self.terrain)


@dataclass(frozen=True, slots=True, eq=False)
class _PackedScan:
    """A step and its segmented scan without points and without the column input, which is apart."""

    step: Step
    scan: SegmentedScan
    column_input: _PackedColumnInput | None


def pack(step: Step, scan: SegmentedScan) -> bytes:
    """Pack a step and its segmented scan; of the points only those of the column input are kept.

    Raises:
        TooLargeError: The block is larger than `unpack` accepts.
    """
    no_points: Float32 = np.zeros((0, 3), np.float32)
    lean = replace(
        scan, raw=no_points, filtered=no_points, labels=scan.labels[:0], column_input=None, clearance=None
    )
    packed = _PackedScan(
        replace(step, scan=Scan(step.scan.stamp_ns, no_points), learnt=Learnt()),
        lean,
        None if scan.column_input is None else _PackedColumnInput.of(scan.column_input),
    )
    tree, arrays = encode(packed, planes=True)
    text = msgspec.json.encode(tree)
    block = _LENGTH.pack(len(text)) + text + arrays
    if len(block) > LARGEST:
        raise TooLargeError(f"its data takes more than {LARGEST >> 20} MB")
    return zstandard.ZstdCompressor(level=_LEVEL).compress(block)


def unpack(block: bytes | bytearray) -> tuple[Step, SegmentedScan]:
    """Return what `pack` was given, without the raw points.

    Raises:
        ValueError: The block is damaged.
    """
    try:
        if not 0 <= zstandard.frame_content_size(block) <= LARGEST:
            raise ValueError("the size of the block is not valid")
        data = zstandard.ZstdDecompressor().decompress(block)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from None
    if len(data) < _LENGTH.size:
        raise ValueError("the block is cut off")
    end = _LENGTH.size + _LENGTH.unpack_from(data)[0]
    packed = decode(_PackedScan, msgspec.json.decode(data[_LENGTH.size : end]), data[end:], planes=True)
    given = packed.column_input
    return packed.step, replace(packed.scan, column_input=None if given is None else given.unpacked())
