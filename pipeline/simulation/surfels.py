"""Surfels: a real cloud as small discs in the surface of the neighbouring points, which beams can meet.

Returns must be at the positions of points. Where the surface is curved, as on a trunk, a disc is much smaller
than the gaps between points, so that a trunk does not get thicker; only on flat ground discs are as wide as
the gaps. In foliage a point is a small ball. Each point of a surface also blocks the beams around it, so that
no beam passes through the gaps of a trunk to the bark on its far side.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.jit import compiled
from pipeline.simulation.ray_casting import Optics
from pipeline.types.records import Float, Float32, Int

NEIGHBOURS = 10
SURFACE, FLAT = 0.35, 0.03  # ratio of smallest to middle eigenvalue of the covariance of the neighbours
WIDE, SMALL = 1.0, 0.6  # radius as a share of the distance to the sixth neighbour
LEAST, WIDEST, SMALLEST, BALL = 0.006, 0.10, 0.025, 0.008  # m; of all, of ground, of other discs, of balls
UPRIGHT = 0.7  # least vertical component of the normal of flat ground
BEHIND = 0.06  # m; surfels farther behind a blocking point are hidden
GRAZING = 0.15  # sine of the angle between beam and disc below which the disc is not met
MELT = 0.04  # m; hits this close together are measured as one
_PART = 1 << 17


class Surfels(NamedTuple):
    """Discs and balls as columns of length N, float32, in the frame of the world.

    Attributes:
        points: shape (N, 3) [m]; normals: shape (N, 3), zero for balls; radius: shape (N,) [m].
        blocks: Radius in which a point hides surfels behind it, 0 in foliage, shape (N,) [m].
    """

    points: Float32
    normals: Float32
    radius: Float32
    blocks: Float32


def lay_surfels(points: Float32) -> Surfels:
    """Return surfels at the points of a cloud, float32, shape (N, 3) [m]; balls that block nothing for a
    cloud of NEIGHBOURS or fewer points. The array of points is not copied."""
    from scipy.spatial import cKDTree

    n = len(points)
    normals, blocks = np.zeros((n, 3), np.float32), np.zeros(n, np.float32)
    radius = np.full(n, BALL, np.float32)
    if n > NEIGHBOURS:
        tree = cKDTree(points)
        for k in range(0, n, _PART):
            distance, near = tree.query(points[k : k + _PART], k=NEIGHBOURS + 1)
            part = slice(k, k + _PART)
            _lay(points, near, distance, normals[part], radius[part], blocks[part])
    return Surfels(points, normals, radius, blocks)


@compiled
def _lay(
    points: Float32, near: Int, distance: Float, normals: Float32, radius: Float32, blocks: Float32
) -> None:
    """Fill normal, radius and blocking radius of a part of the points, in place. Where the neighbours form no
    surface, the normal stays as it is and the point blocks nothing.

    Args:
        points: All points, shape (N, 3) [m].
        near: Rows of each point of the part and its neighbours, nearest first, shape (M, NEIGHBOURS + 1).
        distance: Their distances, same shape [m].
        normals, radius, blocks: Rows of the part in the columns of `Surfels`, which must be 0 for normals and
            blocks.
    """
    C, mean = np.empty((3, 3)), np.empty(3)
    for i in range(near.shape[0]):
        mean[:] = 0.0
        C[:] = 0.0
        for j in near[i]:
            for a in range(3):
                mean[a] += points[j, a] / near.shape[1]
        for j in near[i]:
            for a in range(3):
                for b in range(3):
                    C[a, b] += (points[j, a] - mean[a]) * (points[j, b] - mean[b])
        spacing = distance[i, 6]
        values, vectors = np.linalg.eigh(C)
        radius[i] = min(max(SMALL * spacing, LEAST), BALL)
        if values[0] < SURFACE * values[1]:
            normals[i, 0], normals[i, 1], normals[i, 2] = vectors[0, 0], vectors[1, 0], vectors[2, 0]
            radius[i] = min(max(SMALL * spacing, LEAST), SMALLEST)
            blocks[i] = min(max(WIDE * spacing, LEAST), WIDEST)
            # The side of a sparsely sampled trunk seems as flat as ground, but wide discs would protrude from
            # it.
            if values[0] < FLAT * values[1] and abs(vectors[2, 0]) > UPRIGHT:
                radius[i] = blocks[i]


@compiled
def first_surfels(surfels: Surfels, R: Float, o: Float, beams: Float, optics: Optics) -> Float:
    """Return the range [m] of each beam of a sweep, shape (C, K); infinite when it meets nothing up to
    `optics.range_max`, or only surfels hidden behind another point.

    Each surfel is seen from the pose of the sensor when the beam passes it, and only the beams within its
    angle are tested. Surfels very close to the sensor are ignored. The range is the mean of the nearest hit
    and of those within MELT behind it, weighted towards the middle of the discs.

    Args:
        surfels: The surfels.
        R, o: Pose of the sensor at each column, shapes (C, 3, 3) and (C, 3) [m].
        beams: In the sensor's frame, shape (C, K, 3); column c looks along the azimuth pi - c 2 pi / C.
        optics: Beams of the sensor.
    """
    points, normals, radius, blocks = surfels.points, surfels.normals, surfels.radius, surfels.blocks
    lowest, ring_step, farthest = optics.lowest, optics.ring_step, optics.range_max
    columns, rings = beams.shape[0], beams.shape[1]
    nearest, hidden = np.full((columns, rings), np.inf), np.full((columns, rings), np.inf)
    beam, met, weight = np.empty(1 << 16, np.int64), np.empty(1 << 16), np.empty(1 << 16)
    n, step, middle = 0, 2.0 * np.pi / columns, columns // 2
    v, m = np.empty(3), np.empty(3)
    for i in range(points.shape[0]):
        c = middle
        for _ in range(2):  # the position in the sweep decides from which pose it is seen
            _turn(points[i], R[c], o[c], v)
            c = int((np.pi - np.arctan2(v[1], v[0])) / step + 0.5) % columns
        _turn(points[i], R[c], o[c], v)
        flat = np.sqrt(v[0] * v[0] + v[1] * v[1])
        reach, s = np.sqrt(flat * flat + v[2] * v[2]), radius[i]
        widest = max(s, blocks[i])
        if reach > farthest or flat < 2.0 * widest:
            continue
        ring, tall = (np.arctan2(v[2], flat) - lowest) / ring_step, widest / reach / ring_step
        first, last = max(int(np.ceil(ring - tall)), 0), min(int(np.floor(ring + tall)), rings - 1)
        if first > last:
            continue
        for a in range(3):
            m[a] = R[c, 0, a] * normals[i, 0] + R[c, 1, a] * normals[i, 1] + R[c, 2, a] * normals[i, 2]
        disc = normals[i, 0] != 0.0 or normals[i, 1] != 0.0 or normals[i, 2] != 0.0
        at, wide = (np.pi - np.arctan2(v[1], v[0])) / step, widest / flat / step
        for column in range(int(np.ceil(at - wide)), int(np.floor(at + wide)) + 1):
            for k in range(first, last + 1):
                d = beams[column % columns, k]
                t = d[0] * v[0] + d[1] * v[1] + d[2] * v[2]
                if reach * reach - t * t < blocks[i] * blocks[i]:
                    hidden[column % columns, k] = min(hidden[column % columns, k], t + BEHIND)
                if disc:
                    facing = d[0] * m[0] + d[1] * m[1] + d[2] * m[2]
                    if abs(facing) < GRAZING:
                        continue
                    t = (v[0] * m[0] + v[1] * m[1] + v[2] * m[2]) / facing
                off2 = (t * d[0] - v[0]) ** 2 + (t * d[1] - v[1]) ** 2 + (t * d[2] - v[2]) ** 2
                if off2 >= s * s or t <= 0.0:
                    continue
                if n == beam.shape[0]:
                    beam = np.append(beam, np.empty_like(beam))
                    met, weight = np.append(met, np.empty_like(met)), np.append(weight, np.empty_like(weight))
                b = (column % columns) * rings + k
                beam[n], met[n], weight[n] = b, t, 1.0 - off2 / (s * s)
                n += 1
                nearest[column % columns, k] = min(nearest[column % columns, k], t)
    ranges = _melt(nearest, beam[:n], met[:n], weight[:n])
    return np.where(nearest <= hidden, ranges, np.inf)


@compiled
def _turn(point: Float32, R: Float, o: Float, v: Float) -> None:
    """Write the position of a point in the sensor frame into v, shape (3,) [m]; R (3, 3) and o (3,) are the
    pose of the sensor in the world."""
    x, y, z = point[0] - o[0], point[1] - o[1], point[2] - o[2]
    for a in range(3):
        v[a] = R[0, a] * x + R[1, a] * y + R[2, a] * z


@compiled
def _melt(nearest: Float, beam: Int, met: Float, weight: Float) -> Float:
    """Return the range of each beam [m], shape (C, K): the weighted mean of its hits up to MELT behind the
    nearest one; infinite without a hit.

    Args:
        nearest: Range of the nearest hit of each beam, shape (C, K) [m].
        beam: Beam of each hit, column * K + ring, shape (N,).
        met: Range of each hit, shape (N,) [m].
        weight: Weight of each hit, shape (N,).
    """
    rings = nearest.shape[1]
    total, share = np.zeros(nearest.shape), np.zeros(nearest.shape)
    for i in range(beam.shape[0]):
        c, k = beam[i] // rings, beam[i] % rings
        if met[i] <= nearest[c, k] + MELT:
            total[c, k] += weight[i] * met[i]
            share[c, k] += weight[i]
    return np.where(share > 0.0, total / np.maximum(share, 1e-12), np.inf)
