"""LZF, the compression inside of PCD files of the kind binary_compressed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.jit import compiled

#: Three bytes of LZF give at most 264 bytes.
MOST_GROWTH = 88


class LzfError(Exception):
    """The block is damaged or promises another size than it has."""


def lzf_decompress(block: bytes | memoryview, size: int) -> NDArray[np.uint8]:
    """Unpack a block that must have exactly `size` bytes afterwards; uint8 of shape (size,).

    Raises:
        LzfError: It cannot have this size, or is damaged.
    """
    if size > MOST_GROWTH * len(block) + MOST_GROWTH:
        raise LzfError("the packed data cannot grow to the size it says")
    unpacked = np.empty(size, dtype=np.uint8)
    if _unpack(np.frombuffer(block, dtype=np.uint8), unpacked) != size:
        raise LzfError("the packed data is damaged")
    return unpacked


@compiled
def _unpack(block: NDArray[np.uint8], unpacked: NDArray[np.uint8]) -> int:
    """Number of bytes written, -1 when the block leads out of either array."""
    at, out = 0, 0
    while at < len(block):
        control = int(block[at])
        at += 1
        if control < 32:
            run = control + 1
            if at + run > len(block) or out + run > len(unpacked):
                return -1
            for k in range(run):
                unpacked[out + k] = block[at + k]
            at += run
        else:
            run = control >> 5
            if run == 7:
                if at >= len(block):
                    return -1
                run += int(block[at])
                at += 1
            if at >= len(block):
                return -1
            source = out - ((control & 31) << 8) - int(block[at]) - 1
            at += 1
            run += 2
            if source < 0 or out + run > len(unpacked):
                return -1
            # The source may overlap what is written: it repeats, so bytes go one by one.
            for k in range(run):
                unpacked[out + k] = unpacked[source + k]
        out += run
    return out
