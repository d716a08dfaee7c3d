"""A stored map for localisation: stems and a coarse terrain, in a file of about 20 bytes per stem."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import numpy as np

from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float
from pipeline.io.checkpoints.codec import decode, record_bytes, record_parts
from pipeline.loop_closure.stem_matching import MapStems, worst_sigma
from pipeline.types.records import Int, Int32, Trees, UInt16

FORMAT = 1
_BEGINNING = zlib.compress(b"", 9)[:2]  # of every file
#: What a stored map is, for errors.
A_MAP = "Give the folder of a run that `stemmap map` wrote, or a .stems file that `stemmap pack` wrote of it"
MILLIMETRE = 0.001  # m; step of a position, far below its standard deviation
# m; side of the terrain cells of a file. The height of the ground varies over it by a few centimetres, and
# the plane through all cells around the robot averages that.
TERRAIN_CELL = 2.0
LARGEST_FILE = 64 << 20


@dataclass(frozen=True, slots=True, eq=False)
class StoredMap:
    """The stems of a map and its terrain; columns of N stems and K cells, in the frame of the map.

    Attributes:
        number: Number of each tree, int64, shape (N,).
        position: x, y, shape (N, 2) [m].
        covariance: xx, xy, yy, shape (N, 3) [m^2].
        dbh, dbh_sigma: Diameter at breast height and its standard deviation, shape (N,) [m]; NaN if unknown.
        terrain: x, y, z of the cells of the terrain, shape (K, 3) [m]; no rows if it is unknown.
    """

    number: Int
    position: Float
    covariance: Float
    dbh: Float
    dbh_sigma: Float
    terrain: Float = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        """Return the number of stems."""
        return len(self.number)

    @classmethod
    def of(cls, trees: Trees, terrain: Float | None = None) -> StoredMap:
        """Return the confirmed trees of a map with finite positions and covariances, and its terrain.

        Args:
            trees: The trees.
            terrain: x, y, z of its cells, shape (K, 3) [m]; None if unknown.
        """
        covariance = trees.covariance[:, [0, 0, 1], [0, 1, 1]]
        kept = trees.confirmed & np.isfinite(trees.position).all(axis=1) & np.isfinite(covariance).all(axis=1)
        return cls(
            trees.number[kept],
            trees.position[kept],
            covariance[kept],
            trees.dbh[kept],
            np.where(np.isnan(trees.dbh[kept]), np.nan, trees.dbh_sigma[kept]),
            np.zeros((0, 3)) if terrain is None else terrain,
        )

    @property
    def stems(self) -> MapStems:
        """The stems as columns for matching."""
        return MapStems(self.position, worst_sigma(self.covariance), self.dbh, self.dbh_sigma)

    def as_bytes(self) -> bytes:
        """Return the map as the bytes of a file, see `of_bytes`. Positions are rounded to MILLIMETRE, sigmas
        and diameters to 0.1 mm (at most 6.5 m), and the terrain to cells of TERRAIN_CELL and 1 cm.

        Raises:
            StemmapError: A stem is more than 2,147 km from the origin.
        """
        if len(self) and np.abs(self.position).max() / MILLIMETRE > np.iinfo(np.int32).max:
            raise StemmapError(
                "a tree is more than 2,147 km from the origin of the map",
                remedy="Map the run again without the offset of its coordinates",
            )
        sigma = np.sqrt(np.maximum(self.covariance[:, [0, 2]], 0.0))
        product = np.maximum(sigma[:, 0] * sigma[:, 1], 1e-12)
        cell, height = _coarse(self.terrain)
        packed = _Packed(
            FORMAT,
            self.number.astype(np.int32),
            np.rint(self.position / MILLIMETRE).astype(np.int32),
            _tenths(sigma),
            np.rint(np.clip(self.covariance[:, 1] / product, -1.0, 1.0) * 127.0).astype(np.int8),
            _tenths(self.dbh),
            _tenths(self.dbh_sigma),
            cell,
            np.rint(height * 100.0).astype(np.int32),
        )
        return zlib.compress(record_bytes(packed), 9)

    @classmethod
    def of_bytes(cls, data: bytes, where: str) -> StoredMap:
        """Return the map from the bytes of a file, which is named in errors.

        Raises:
            StemmapError: The bytes are of another format, damaged or of another version.
        """
        if not data.startswith(_BEGINNING):
            raise StemmapError("this file is not a stored map", where=where, remedy=A_MAP)
        damaged = StemmapError(
            "the map of stems is damaged", where=where, remedy="Write it again with `stemmap pack`"
        )
        try:
            unpacker = zlib.decompressobj()
            content = unpacker.decompress(data, LARGEST_FILE)
            if not unpacker.eof:
                raise damaged
            tree, arrays = record_parts(content)
            if isinstance(tree, dict) and tree.get("format") != FORMAT:
                raise StemmapError(
                    f"it has format {tree.get('format')!r}, and this version reads {FORMAT}",
                    where=where,
                    remedy="Write it again with `stemmap pack`",
                )
            p = decode(_Packed, tree, arrays, planes=True)
        except (ValueError, KeyError, TypeError, RuntimeError, zlib.error):
            raise damaged from None
        n, k = len(p.number), len(p.cell)
        shapes = (p.position.shape, p.sigma.shape, p.correlation.shape, p.dbh.shape, p.dbh_sigma.shape)
        if shapes != ((n, 2), (n, 2), (n,), (n,), (n,)) or p.cell.shape != (k, 2) or p.height.shape != (k,):
            raise damaged
        sigma = _metres(p.sigma)
        xy = p.correlation / 127.0 * sigma[:, 0] * sigma[:, 1]
        middle = (p.cell + 0.5) * TERRAIN_CELL
        return cls(
            p.number.astype(np.int64),
            p.position.astype(np.float64) * MILLIMETRE,
            np.stack([sigma[:, 0] ** 2, xy, sigma[:, 1] ** 2], axis=1),
            _metres(p.dbh),
            _metres(p.dbh_sigma),
            np.column_stack([middle, p.height / 100.0]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Packed:
    """The content of a file; see `StoredMap.as_bytes`."""

    format: int
    number: Int32
    position: Int32
    sigma: UInt16
    correlation: np.ndarray[tuple[int], np.dtype[np.int8]]
    dbh: UInt16
    dbh_sigma: UInt16
    cell: Int32
    height: Int32


_UNKNOWN = 65535


def _tenths(values: Float) -> UInt16:
    """Return lengths [m] in steps of 0.1 mm, at most 65534; _UNKNOWN for NaN."""
    steps = np.clip(np.rint(np.nan_to_num(values, nan=0.0, posinf=6.5) * 1e4), 0, _UNKNOWN - 1)
    return np.where(np.isnan(values), _UNKNOWN, steps).astype(np.uint16)


def _metres(steps: UInt16) -> Float:
    """Return the lengths of `_tenths` [m]."""
    return np.where(steps == _UNKNOWN, np.nan, steps.astype(np.float64) * 1e-4)


def _coarse(terrain: Float) -> tuple[Int32, Float]:
    """Return the cells of side TERRAIN_CELL with a known height: their indices, int32, shape (K, 2), and
    heights, shape (K,) [m], each the mean of the cells of the terrain in it."""
    cell, of = np.unique(
        np.floor(terrain[:, :2] / TERRAIN_CELL).astype(np.int32), axis=0, return_inverse=True
    )
    count = np.bincount(of.ravel(), minlength=len(cell))
    return cell.astype(np.int32).reshape(-1, 2), np.bincount(of.ravel(), terrain[:, 2], len(cell)) / count
