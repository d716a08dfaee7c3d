"""How well the place in the frame of the map is known, where the particles alone would say too much.

The spread of the particles tells of errors in which they still differ. Once all of them come from one
ancestor they share its map, and with it an error that no spread shows: coming back to it they agree, and
would say that they know the frame as well as they know each other. So it is kept how uncertain the pose was
where landmarks were begun, and a pose that is found by those landmarks is never told to be known better: what
they have in common with the pose of then is an error of the frame (Julier, Uhlmann 2001: what is shared
by an unknown part does not shrink when it is taken together).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.loop_closure.map_correction import PathCorrection
from pipeline.slam.motion import wrapped
from pipeline.types.records import Int, Int32

APART = 0.5  # m, or as many radians, between two marks
NOISE = 4.0  # two sigma of the ratio of two variances of N particles each, times the root of N
SMALL = 1e-12  # m^2, rad^2; so that a pose without spread has a direction to grow in


@dataclass(frozen=True, slots=True, eq=False)
class FrameMemory:
    """Immutable. Columns of M marks along the way, in order, and what the particles do not show now.

    Attributes:
        serial: int64, shape (M,): landmarks born with this serial number or a later one belong to a mark.
        scan: int64, shape (M,): the scan there.
        pose: x, y [m], yaw [rad] there, shape (M, 3); covariance: of it, shape (M, 3, 3).
        hidden: Of the error that all particles share, at `at`, shape (3, 3).
        at: Where, shape (3,).
    """

    serial: Int = field(default_factory=lambda: np.zeros(0, np.int64))
    scan: Int = field(default_factory=lambda: np.zeros(0, np.int64))
    pose: Float = field(default_factory=lambda: np.zeros((0, 3)))
    covariance: Float = field(default_factory=lambda: np.zeros((0, 3, 3)))
    hidden: Float = field(default_factory=lambda: np.zeros((3, 3)))
    at: Float = field(default_factory=lambda: np.zeros(3))

    def told(
        self,
        pose: Float,
        spread: Float,
        n_eff: float,
        mean: Float,
        birth: Int,
        hits: Int32,
        hits_min: int,
        reach: float,
    ) -> tuple[Float, FrameMemory]:
        """The covariance of a pose in the frame of the map, and the memory after it.

        Args:
            pose: shape (3,); spread: covariance that the particles show, shape (3, 3); n_eff: so many they
                are worth.
            mean, birth, hits: Of the landmarks, shape (L, ...); those nearer than `reach` [m] and seen
                `hits_min` times are what the pose was found by.
        """
        covariance, hidden = _with_frame(
            pose, spread, n_eff, mean, birth, hits, hits_min, reach, self.serial, self.pose, self.covariance,
            self.hidden, self.at,
        )  # fmt: skip
        return covariance, replace(self, hidden=hidden, at=pose)

    def knows(self, pose: Float, mean: Float, birth: Int, hits: Int32, hits_min: int, reach: float) -> bool:
        """Whether a pose was found by landmarks that belong to a mark; see `told`."""
        if not len(self.serial):
            return False
        near = np.hypot(*(mean - pose[:2]).T) <= reach
        return bool(np.any(near & (hits >= hits_min) & (birth >= self.serial[0])))

    def told_at_least(
        self, spread: Float, n_eff: float, least: Float, by_landmarks: Float | None
    ) -> tuple[Float, FrameMemory]:
        """The covariance of a pose, shape (3, 3), where measured poses tell it no better than `least`, and
        the memory after it.

        Args:
            spread, n_eff: See `told`.
            by_landmarks: Covariance by the landmarks around, None where there are none: who can go by two
                things knows the place at least as well as by the better one.
        """
        covariance = at_least(spread, np.ascontiguousarray(least), NOISE / np.sqrt(n_eff))
        if by_landmarks is not None and np.trace(by_landmarks[:2, :2]) < np.trace(covariance[:2, :2]):
            covariance = by_landmarks
        return covariance, replace(self, hidden=covariance - spread)

    def marked(self, serial: int, scan: int, pose: Float, covariance: Float) -> FrameMemory:
        """With a mark here if the last one is far enough behind; `serial`: of this scan's first detection."""
        if len(self.serial):
            away = pose - self.pose[-1]
            away[2] = wrapped(away[2])
            if np.abs(away).max() < APART:
                return self
        return replace(
            self,
            serial=np.append(self.serial, serial),
            scan=np.append(self.scan, scan),
            pose=np.concatenate([self.pose, pose[None]]),
            covariance=np.concatenate([self.covariance, covariance[None]]),
        )

    def scan_of(self, birth: Int) -> Int:
        """The scan of the mark that landmarks belong to, shape (L,); 0 where they are older than all."""
        if not len(self.serial):
            return np.zeros(len(birth), np.int64)
        k = np.searchsorted(self.serial, birth, side="right") - 1
        return np.where(k >= 0, self.scan[np.maximum(k, 0)], 0)

    def corrected(self, correction: PathCorrection, covariance: Float) -> FrameMemory:
        """Return the memory after a correction of the path.

        Args:
            correction: The correction.
            covariance: Covariance of the pose of each scan, shape (N, 3, 3).
        """
        if not len(self.scan):
            return self
        return replace(self, pose=correction.poses(self.pose, self.scan), covariance=covariance[self.scan])

    def forgotten(self) -> FrameMemory:
        """Nothing hidden: the particles were put somewhere with the spread that is known."""
        return replace(self, hidden=np.zeros((3, 3)))


@compiled
def carried(covariance: Float, dx: float, dy: float) -> Float:
    """A Sigma A^T, A = [[1, 0, -dy], [0, 1, dx], [0, 0, 1]]: the same error of the frame, seen at a pose that
    lies further on by dx, dy [m]; written out, for the library's product of such small matrices is slow."""
    C, moved = covariance, np.empty((3, 3))
    t = C[2, 2]
    moved[0, 0] = C[0, 0] - 2.0 * dy * C[0, 2] + dy * dy * t
    moved[0, 1] = moved[1, 0] = C[0, 1] + dx * C[0, 2] - dy * C[1, 2] - dx * dy * t
    moved[1, 1] = C[1, 1] + 2.0 * dx * C[1, 2] + dx * dx * t
    moved[0, 2] = moved[2, 0] = C[0, 2] - dy * t
    moved[1, 2] = moved[2, 1] = C[1, 2] + dx * t
    moved[2, 2] = t
    return moved


@compiled
def _with_frame(
    pose: Float,
    spread: Float,
    n_eff: float,
    mean: Float,
    birth: Int,
    hits: Int32,
    hits_min: int,
    reach: float,
    serial: Int,
    place: Float,
    covariance: Float,
    hidden: Float,
    at: Float,
) -> tuple[Float, Float]:
    """What the pose's covariance is at least by the landmarks around, joined with the spread."""
    least, known = np.zeros((3, 3)), 0
    counts = np.zeros(len(serial), np.int64)
    for j in range(len(hits)):
        dx, dy = mean[j, 0] - pose[0], mean[j, 1] - pose[1]
        if hits[j] < hits_min or dx * dx + dy * dy > reach * reach:
            continue
        m = np.searchsorted(serial, birth[j], side="right") - 1
        if m >= 0:
            counts[m] += 1
            known += 1
    if known == 0:
        hidden = carried(hidden, pose[0] - at[0], pose[1] - at[1])
        return spread + hidden, hidden
    for m in range(len(serial)):
        if counts[m]:
            least += counts[m] / known * carried(covariance[m], pose[0] - place[m, 0], pose[1] - place[m, 1])
    both = at_least(spread, least, NOISE / np.sqrt(n_eff))
    return both, both - spread


@compiled
def at_least(spread: Float, least: Float, noise: float = 0.0) -> Float:
    """The covariance that is no smaller than `spread` in any direction, and as large as `least` where that is
    larger by more than `noise`; no larger in their common axes.

    Args:
        spread, least: shape (3, 3) each, of x, y [m] and heading [rad].
        noise: Error of the ratio of their variances, both being taken from particles. Of two that are alike
            but for this the larger one would always be too large, and more so each time that it is kept; so
            what is larger by less counts for nothing, and what is larger by much, for all that it is
            (non-negative garrote; Gao 1998).
    """
    # Two particles far apart spread along a line; what rounding leaves of the rest grows with the distance.
    L = np.linalg.cholesky(spread + SMALL * max(1.0, np.trace(spread)) * np.eye(3))
    L_inv = np.linalg.inv(L)
    values, axes = np.linalg.eigh(L_inv @ least @ L_inv.T)
    B = L @ axes
    more = np.maximum(values - 1.0, 1e-300)
    larger = np.maximum(more - noise * noise / more, 0.0)
    grown: Float = spread + (B * larger) @ B.T
    return grown
