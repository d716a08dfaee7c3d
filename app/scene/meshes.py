"""The few shapes of the scene, as vertices and faces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SIDES = 32  # of a circle

Mesh = tuple[NDArray[np.float32], NDArray[np.uint32]]


def cylinder(sides: int = 20) -> Mesh:
    """A closed cylinder of radius 1 and height 1 that stands on the origin."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    low = np.column_stack([rim, np.zeros(sides)])
    high = np.column_stack([rim, np.ones(sides)])
    vertices = np.vstack([low, high, [[0, 0, 0], [0, 0, 1]]])
    faces: list[tuple[int, int, int]] = []
    for i in range(sides):
        j = (i + 1) % sides
        faces += [(i, j, sides + i), (j, sides + j, sides + i)]
        faces += [(j, i, 2 * sides), (sides + i, sides + j, 2 * sides + 1)]
    return vertices.astype(np.float32), np.array(faces, dtype=np.uint32)


def box() -> Mesh:
    """A box of side 1 with a corner in the origin."""
    vertices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float32)
    squares = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [face for a, b, c, d in squares for face in ((a, b, c), (a, c, d))]
    return vertices, np.array(faces, dtype=np.uint32)


def circles(
    centres: NDArray[np.floating], radii: NDArray[np.floating], z: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Circles as segments, `SIDES` for each.

    Args:
        centres: shape (N, 2) [m].
        radii: shape (N,) [m].
        z: Heights, shape (N,) [m].

    Returns:
        shape (N * SIDES, 2, 3) [m].
    """
    angle = np.linspace(0.0, 2.0 * np.pi, SIDES + 1)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    xy = centres[:, None, :] + radii[:, None, None] * rim[None, :, :]
    xyz = np.concatenate([xy, np.broadcast_to(z[:, None, None], (*xy.shape[:2], 1))], axis=2)
    return np.stack([xyz[:, :-1], xyz[:, 1:]], axis=2).reshape(-1, 2, 3).astype(np.float32)


def polyline(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Segments that join points of shape (N, 3), shape (N - 1, 2, 3)."""
    xyz = points.astype(np.float32)
    return np.stack([xyz[:-1], xyz[1:]], axis=1)
