"""Shapes of which the objects of a scene are built, as columns.

There are tapered cylinders (trunks, branches, poles, limbs), stems with a section that is not round and bark
with furrows, ellipsoids that are solid (head, torso) or porous (foliage), and upright boxes. Each row
also has a capsule that encloses the shape.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pipeline.types.records import Float, Int32

CONE, ELLIPSOID, BOX, STEM = 0, 1, 2, 3
SURFACE = 9  # columns of `Solids.surface`


@dataclass(frozen=True, slots=True)
class Section:
    """Section of a stem. At the angle a around the axis the bark has the radius

        r (1 + oval cos(2 (a - oval_phase)) + fluted cos(3 (a - fluted_phase))) - depth f,

    where f is 0 on the ridges and 1 in the furrows of the bark. The section without furrows is convex, so
    that a tape touches the ridges only.

    Attributes:
        oval, fluted: Relative amplitudes of two and of three lobes.
        oval_phase, fluted_phase: Directions of the lobes [rad].
        bark: Depth of the furrows at the start of the stem [m]; it is proportional to the radius.
        furrows: Number of furrows around the stem.
        furrow_phase: Phase of the furrows [rad].
    """

    oval: float = 0.0
    oval_phase: float = 0.0
    fluted: float = 0.0
    fluted_phase: float = 0.0
    bark: float = 0.0
    furrows: int = 0
    furrow_phase: float = 0.0

    @property
    def widest(self) -> float:
        """Factor between r and a radius that encloses the section, at least 1."""
        return 1.0 + self.oval + self.fluted

    def perimeter_factor(self) -> float:
        """Return the length of a tape around the section divided by 2 pi r."""
        a = np.arange(3600) * (2.0 * np.pi / 3600)
        two, three = 2.0 * (a - self.oval_phase), 3.0 * (a - self.fluted_phase)
        r = 1.0 + self.oval * np.cos(two) + self.fluted * np.cos(three)
        slope = -2.0 * self.oval * np.sin(two) - 3.0 * self.fluted * np.sin(three)
        return float(np.sqrt(r * r + slope * slope).mean())


class Solids(NamedTuple):
    """N shapes as columns.

    Attributes:
        kind: Kind of each shape, int32: CONE, ELLIPSOID, BOX or STEM.
        shape: Geometry, float64, shape (N, 9). CONE and STEM: start (3), unit axis (3), length, radius at the
            start, change of radius per metre. ELLIPSOID and BOX: centre (3), half sizes (3), cosine and sine
            of the yaw, and for the ellipsoid the mean free path of light in it [m], 0 if solid.
        capsule: Two ends (3 + 3) and radius of the enclosing capsule, float64, shape (N, 7) [m].
        surface: Surface, float64, shape (N, SURFACE): reflectivity 0..1, roughness of the surface [m], and of
            a STEM the seven parameters of its `Section`.
        owner: Number of the object in the scene, int32.
    """

    kind: Int32
    shape: Float
    capsule: Float
    surface: Float
    owner: Int32

    def join(self, other: Solids) -> Solids:
        """Return new columns with these shapes followed by others; the numbers of the objects are not
        changed."""
        columns: Iterator[tuple[Any, Any]] = zip(self, other, strict=True)
        return Solids(*map(np.concatenate, columns))

    def placed(self, offset: Float, yaw: float) -> Solids:
        """Return the shapes rotated by `yaw` [rad] about the z axis, then shifted by `offset` (3,) [m]; these
        shapes are not changed, and share the other columns with the result. Capsules and axes are moved with
        the shapes."""
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        shape, capsule = self.shape.copy(), self.capsule.copy()
        shape[:, :3] = shape[:, :3] @ R.T + offset
        cone = (self.kind == CONE) | (self.kind == STEM)
        shape[cone, 3:6] = shape[cone, 3:6] @ R.T
        cos, sin = shape[~cone, 6], shape[~cone, 7]
        shape[~cone, 6], shape[~cone, 7] = c * cos - s * sin, s * cos + c * sin
        capsule[:, :3] = capsule[:, :3] @ R.T + offset
        capsule[:, 3:6] = capsule[:, 3:6] @ R.T + offset
        return Solids(self.kind, shape, capsule, self.surface, self.owner)


class SolidsBuilder:
    """Collects shapes one by one. `owner` is the number of the object of a shape."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, list[float], list[float], list[float], int]] = []

    def cone(
        self,
        owner: int,
        start: ArrayLike,
        end: ArrayLike,
        radii: tuple[float, float],
        *,
        reflectivity: float = 0.35,
        roughness: float = 0.0,
    ) -> None:
        """Add a tapered cylinder without caps from `start` to `end` (3,) [m] with its two radii [m].

        Args:
            owner: Number of the object to which the shape belongs.
            start, end: Ends of the axis, shape (3,) [m]; they must differ.
            radii: Radius at `start` and at `end` [m].
            reflectivity: Share of the light that is reflected.
            roughness: Maximum random deviation of a range from the surface [m].
        """
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        length = float(np.linalg.norm(b - a))
        shape = [*a, *((b - a) / length), length, radii[0], (radii[1] - radii[0]) / length]
        self._rows.append((CONE, shape, [*a, *b, max(radii)], _surface(reflectivity, roughness), owner))

    def stem(
        self,
        owner: int,
        start: ArrayLike,
        end: ArrayLike,
        radii: tuple[float, float],
        section: Section,
        *,
        reflectivity: float = 0.35,
    ) -> None:
        """Add a stem: a tapered cylinder without caps, as in `cone`, with a section that is not round.

        Args:
            owner: Number of the object to which the shape belongs.
            start, end: Ends of the axis, shape (3,) [m]; they must differ, which is not checked.
            radii: Radius r of `Section` at `start` and at `end` [m].
            section: Shape of the section.
            reflectivity: Share of the light that is reflected, 0 to 1.
        """
        self.cone(owner, start, end, radii, reflectivity=reflectivity)
        _, shape, capsule, surface, _ = self._rows.pop()
        capsule[6] *= section.widest
        self._rows.append((STEM, shape, capsule, [*surface[:2], *astuple(section)], owner))

    def ellipsoid(
        self,
        owner: int,
        centre: ArrayLike,
        half: ArrayLike,
        *,
        yaw: float = 0.0,
        free_path: float = 0.0,
        reflectivity: float = 0.3,
    ) -> None:
        """Add an ellipsoid.

        Args:
            owner: Number of the object to which the shape belongs.
            centre: Centre, shape (3,) [m].
            half: Half sizes, shape (3,) [m].
            yaw: Rotation about z [rad].
            free_path: Mean free path of light in a porous ellipsoid [m]; 0 for a solid one.
            reflectivity: Share of the light that is reflected.
        """
        c, h = np.asarray(centre, dtype=np.float64), np.asarray(half, dtype=np.float64)
        shape = [*c, *h, np.cos(yaw), np.sin(yaw), free_path]
        self._rows.append((ELLIPSOID, shape, [*c, *c, float(h.max())], _surface(reflectivity), owner))

    def box(
        self, owner: int, centre: ArrayLike, half: ArrayLike, *, yaw: float = 0.0, reflectivity: float = 0.5
    ) -> None:
        """Add an upright box.

        Args:
            owner: Number of the object to which the shape belongs.
            centre: Centre, shape (3,) [m].
            half: Half sizes, shape (3,) [m].
            yaw: Rotation about z [rad].
            reflectivity: Share of the light that is reflected.
        """
        c, h = np.asarray(centre, dtype=np.float64), np.asarray(half, dtype=np.float64)
        shape = [*c, *h, np.cos(yaw), np.sin(yaw), 0.0]
        self._rows.append((BOX, shape, [*c, *c, float(np.linalg.norm(h))], _surface(reflectivity), owner))

    def extend(self, solids: Solids) -> None:
        """Add all shapes of a table with the numbers of their objects; the table is copied."""
        self._rows += zip(*(column.tolist() for column in solids), strict=True)

    def build(self) -> Solids:
        """Return all shapes so far as new columns, without rows if there are none; more shapes may follow."""
        kind, shape, capsule, surface, owner = zip(*self._rows, strict=True) if self._rows else [()] * 5
        return Solids(
            np.array(kind, dtype=np.int32),
            np.array(shape, dtype=np.float64).reshape(-1, 9),
            np.array(capsule, dtype=np.float64).reshape(-1, 7),
            np.array(surface, dtype=np.float64).reshape(-1, SURFACE),
            np.array(owner, dtype=np.int32),
        )


def _surface(reflectivity: float, roughness: float = 0.0) -> list[float]:
    """Return a row of `Solids.surface` of a shape that is not a STEM: reflectivity from 0 to 1, roughness
    [m], and zeros in place of the parameters of a `Section`."""
    return [reflectivity, roughness, *[0.0] * (SURFACE - 2)]
