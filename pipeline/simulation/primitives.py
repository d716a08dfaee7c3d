"""The shapes of which everything in a scene is made, kept as columns.

A tapered cylinder (trunk, branch, pole, limb), an ellipsoid that is solid (head, torso) or lets part of
the light through (foliage), and an upright box. Each row also has a capsule that encloses it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from pipeline.types.records import Float, Int32

CONE, ELLIPSOID, BOX = 0, 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """N shapes as columns.

    Attributes:
        kind: int32, CONE, ELLIPSOID or BOX.
        shape: float64, shape (N, 9). CONE: start (3), unit axis (3), length, radius at the start,
            change of radius per metre. ELLIPSOID and BOX: centre (3), half sizes (3), cosine and sine
            of the yaw, and for the ellipsoid the mean free path of light in it [m], 0 if solid.
        capsule: float64, shape (N, 7): two ends (3 + 3) and the radius of what encloses it.
        surface: float64, shape (N, 2): reflectivity 0..1, roughness of the surface [m].
        owner: int32: number of the thing in the scene that it belongs to.
    """

    kind: Int32
    shape: Float
    capsule: Float
    surface: Float
    owner: Int32

    def __len__(self) -> int:
        return int(self.kind.shape[0])

    def join(self, other: Solids) -> Solids:
        """These and those."""
        return Solids(
            np.concatenate([self.kind, other.kind]),
            np.concatenate([self.shape, other.shape]),
            np.concatenate([self.capsule, other.capsule]),
            np.concatenate([self.surface, other.surface]),
            np.concatenate([self.owner, other.owner]),
        )

    def placed(self, offset: Float, yaw: float) -> Solids:
        """Turned by `yaw` [rad] about the z axis, then shifted by `offset` (3,) [m]."""
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        shape, capsule = self.shape.copy(), self.capsule.copy()
        shape[:, :3] = shape[:, :3] @ R.T + offset
        cone = self.kind == CONE
        shape[cone, 3:6] = shape[cone, 3:6] @ R.T
        cos, sin = shape[~cone, 6], shape[~cone, 7]
        shape[~cone, 6], shape[~cone, 7] = c * cos - s * sin, s * cos + c * sin
        capsule[:, :3] = capsule[:, :3] @ R.T + offset
        capsule[:, 3:6] = capsule[:, 3:6] @ R.T + offset
        return Solids(self.kind, shape, capsule, self.surface, self.owner)


@dataclass(slots=True)
class SolidsBuilder:
    """Collects shapes one by one."""

    _kind: list[int] = field(default_factory=list)
    _shape: list[list[float]] = field(default_factory=list)
    _capsule: list[list[float]] = field(default_factory=list)
    _surface: list[list[float]] = field(default_factory=list)
    _owner: list[int] = field(default_factory=list)

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
        """A tapered cylinder without caps from `start` to `end` (3,) [m] with its two radii [m]."""
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        length = float(np.linalg.norm(b - a))
        axis = (b - a) / length
        self._add(
            CONE,
            [*a, *axis, length, radii[0], (radii[1] - radii[0]) / length],
            [*a, *b, max(radii)],
            [reflectivity, roughness],
            owner,
        )

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
        """An ellipsoid with half sizes (3,) [m], turned by `yaw` about z; porous if `free_path` > 0."""
        c, h = np.asarray(centre, dtype=np.float64), np.asarray(half, dtype=np.float64)
        self._add(
            ELLIPSOID,
            [*c, *h, np.cos(yaw), np.sin(yaw), free_path],
            [*c, *c, float(h.max())],
            [reflectivity, 0.0],
            owner,
        )

    def box(
        self, owner: int, centre: ArrayLike, half: ArrayLike, *, yaw: float = 0.0, reflectivity: float = 0.5
    ) -> None:
        """An upright box with half sizes (3,) [m], turned by `yaw` about z."""
        c, h = np.asarray(centre, dtype=np.float64), np.asarray(half, dtype=np.float64)
        self._add(
            BOX,
            [*c, *h, np.cos(yaw), np.sin(yaw), 0.0],
            [*c, *c, float(np.linalg.norm(h))],
            [reflectivity, 0.0],
            owner,
        )

    def build(self) -> Solids:
        """All shapes so far as columns."""
        return Solids(
            np.array(self._kind, dtype=np.int32),
            np.array(self._shape, dtype=np.float64).reshape(-1, 9),
            np.array(self._capsule, dtype=np.float64).reshape(-1, 7),
            np.array(self._surface, dtype=np.float64).reshape(-1, 2),
            np.array(self._owner, dtype=np.int32),
        )

    def _add(
        self, kind: int, shape: list[float], capsule: list[float], surface: list[float], owner: int
    ) -> None:
        self._kind.append(kind)
        self._shape.append(shape)
        self._capsule.append(capsule)
        self._surface.append(surface)
        self._owner.append(owner)
