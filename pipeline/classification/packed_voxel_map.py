"""The memory as it is kept and saved: without the tables by which its voxels are found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.classification.voxel_map import KEPT, TILE_CELLS, Memory, index
from pipeline.geometry.mmap_arrays import copied
from pipeline.types.records import Float32, Int, Int32

LARGEST_ROOM = 1 << 25  # more than the parameters allow
MASK = (1 << 31) - 1


@dataclass(frozen=True, slots=True, eq=False)
class PackedMemory:
    """A memory as it was, which nobody changes any more: columns of the voxels and tiles in use, in their
    order, without the tables that find them; `room` and `tile_room` are what was there for both. See
    Memory."""

    key: Int
    mean: Float32
    returns: Int32
    scans: Int32
    latest: Int32
    tile_judged: Int
    room: int
    tile_room: int
    added: int

    @classmethod
    def of(cls, memory: Memory) -> PackedMemory:
        """What cannot be found again from the rest, copied."""
        columns = {name: copied(getattr(memory, name)[: memory.used]) for name in KEPT}
        judged = memory.tile_judged[: memory.tiles].copy()
        return cls(
            **columns,
            tile_judged=judged,
            room=len(memory.key),
            tile_room=len(memory.tile_key),
            added=memory.added,
        )

    def unpacked(self) -> Memory:
        """The same memory, to the bit."""
        n = len(self.key)
        memory = Memory.empty(self.room, self.tile_room)
        for name in KEPT:
            getattr(memory, name)[:n] = getattr(self, name)
        memory.added = self.added
        index(memory, n)
        memory.tile_judged[: memory.tiles] = self.tile_judged
        return memory

    def checked(self) -> PackedMemory:
        """Itself, if it can be unpacked; what comes from a file need not.

        Raises:
            ValueError: The columns do not fit one another or a key stands for no place.
        """
        n, tiles = len(self.key), len(self.tile_judged)
        for room, used in ((self.room, n), (self.tile_room, tiles)):
            if not (max(used, 1) <= room <= LARGEST_ROOM and room & (room - 1) == 0):
                raise ValueError(f"there is no room of {room} for {used} voxels or tiles")
        lengths = {len(self.mean), len(self.returns), len(self.scans), len(self.latest), n}
        if (
            len(lengths) > 1
            or self.mean.shape[1:] != (3,)
            or self.key.ndim != 1
            or self.tile_judged.ndim != 1
        ):
            raise ValueError("the columns of the voxels have other lengths")
        if n and (self.key.min() < 0 or len(np.unique(self.key)) < n):
            raise ValueError("two voxels are one")
        tile = ((self.key >> 36) // TILE_CELLS << 31) | ((self.key >> 5) & MASK) // TILE_CELLS
        if len(np.unique(tile)) != tiles:
            raise ValueError("the tiles are not those of the voxels")
        return self
