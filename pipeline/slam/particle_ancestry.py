"""Resampling of the particles, their ancestry with the path of each particle, and the buffer of the path of a
run.

The particles are drawn with low variance (Thrun, Burgard, Fox: Probabilistic Robotics, table 4.4), with
random numbers that depend on the seed and the scan only; the map of the best particle is reported.

Each scan stores the poses of all particles and, if it resampled, the ancestor of each particle. The path of a
particle follows its ancestors back to the first scan, so later scans select among the paths. The distant past
keeps the poses of one particle only, which bounds the memory.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeline.geometry.columns import GrowingColumns
from pipeline.geometry.file_arrays import extended
from pipeline.geometry.pose_arrays import composed, inverse
from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.types.records import Float32, Int, Path

WORD = 2**32  # seeds below it need one 32-bit word


def draws(seed: int, index: int, particles: int) -> tuple[Float, float]:
    """Return standard normal numbers, shape (P, 3), and one uniform number in [0, 1); the same for equal
    arguments.

    Args:
        seed: Seed of the run, >= 0.
        index: Number of the scan, >= 0.
        particles: Number of particles P.
    """
    # An array of 32-bit words gives the same stream as the list and is converted faster.
    fit = 0 <= seed < WORD and 0 <= index < WORD
    rng = np.random.default_rng(np.array([seed, index], np.uint32) if fit else [seed, index])
    return rng.standard_normal((particles, 3)), float(rng.random())


def normalised(log_weight: Float) -> Float:
    """Return weights that sum to 1 from logarithms up to a constant, shape (P,), P > 0. NaN if all logarithms
    are -inf; the argument is unchanged."""
    weights = np.exp(log_weight - log_weight.max())
    normed: Float = weights / weights.sum()
    return normed


def low_variance_ancestors(weights: Float, offset: float) -> Int:
    """Return the row of the ancestor of each particle of the new generation, int64, shape (P,).

    A particle of weight w is selected floor(P w) or ceil(P w) times. Each selected particle k keeps its row:
    ancestors[k] == k.

    Args:
        weights: Weights with sum 1, shape (P,).
        offset: Uniform random number in [0, 1).
    """
    n = len(weights)
    rows = np.searchsorted(np.cumsum(weights), (np.arange(n) + offset) / n, side="right")
    draws = np.bincount(np.minimum(rows, n - 1), minlength=n)
    ancestors = np.where(draws > 0, np.arange(n), -1)
    ancestors[draws == 0] = np.repeat(np.arange(n), np.maximum(draws - 1, 0))
    return ancestors


def are_apart(pose: Float, weights: Float, distance: float) -> bool:
    """Return whether the weighted position scatter of particles exceeds a distance per axis.

    The criterion is sum_p w_p |p - mean|^2 > 2 distance^2.

    Args:
        pose: x, y [m], yaw [rad], shape (P, 3).
        weights: Weights with sum 1, shape (P,).
        distance: Standard deviation per axis [m].
    """
    away = pose[:, :2] - weights @ pose[:, :2]
    return bool(weights @ (away * away).sum(axis=1) > 2.0 * distance * distance)


def select_best(weights: Float, before: int, pose: Float, distance: float) -> int:
    """Return the row of the best particle: the heaviest one (the first of equal ones), or the previous one if
    the particles are apart.

    Particles that are farther apart than trees can be distinguished are hypotheses with different maps. The
    weights of a few scans would select another hypothesis in each scan, and the mapped trees would agree with
    none of them.

    Args:
        weights: Weights with sum 1, shape (P,).
        before: Row of the previous best particle.
        pose, distance: See `are_apart`.
    """
    return before if are_apart(pose, weights, distance) else int(np.argmax(weights))


def best_after_resampling(best: int, ancestors: Int, weights: Float) -> int:
    """Return the row of the best particle after resampling: `best` if it survived, else the heaviest
    particle.

    Args:
        best: Row before resampling.
        ancestors: Ancestor of each row; survivors keep their row, so that ancestors[k] == k. Shape (P,).
        weights: Weights before resampling, shape (P,). The heaviest particle always survives.
    """
    return best if ancestors[best] == best else int(np.argmax(weights))


RECENT_POSES = 300_000  # poses of all particles that are kept, so that later scans can select among them
BLOCK = 512  # scans that are reduced to the path of one particle at once
FOUNDED = 50  # scans between two counts of the distinct ancestors
_BLOCKS = 64  # of one file
_unused: list[Float] = []  # blocks of the newest file
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_unused.clear)  # a forked process shares the file


def _stored(block: Float) -> Float:
    """Return a copy of the poses of BLOCK scans in a file, see `file_arrays.extended`."""
    try:
        copy = _unused.pop()
    except IndexError:
        copy, *others = extended(np.zeros((0, BLOCK, 3)), _BLOCKS)
        _unused.extend(others)
    copy[:] = block
    return copy


@dataclass(frozen=True, slots=True, eq=False)
class EstimatedPath:
    """The estimated pose of each scan. The record is immutable; a longer path shares the blocks of a shorter
    one.

    The path of one particle is one sample of the posterior: its map may be rotated about the first pose by
    the whole uncertainty of the heading there. The estimate is the mean of the posterior, and trees, columns
    and terrain are mapped at it.

    Attributes:
        blocks: Poses x, y [m], yaw [rad] in the map, oldest first, float64, shape (BLOCK, 3) each.
        newest: Poses of the scans after the blocks, fewer than BLOCK, shape (N, 3).
    """

    blocks: tuple[Float, ...] = ()
    newest: Float = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def of(cls, poses: Float) -> EstimatedPath:
        """Return the path with the poses x, y [m], yaw [rad] of all scans, shape (N, 3), which are copied."""
        whole = len(poses) // BLOCK * BLOCK
        blocks = tuple(_stored(poses[k : k + BLOCK]) for k in range(0, whole, BLOCK))
        return cls(blocks, poses[whole:].copy())

    def __len__(self) -> int:
        """Return the number of scans."""
        return BLOCK * len(self.blocks) + len(self.newest)

    def with_pose(self, pose: Float) -> EstimatedPath:
        """Return the path with the pose of one more scan, x, y [m], yaw [rad], shape (3,)."""
        newest = np.concatenate([self.newest, pose[None]])
        if len(newest) < BLOCK:
            return EstimatedPath(self.blocks, newest)
        return EstimatedPath((*self.blocks, _stored(newest)), np.zeros((0, 3)))

    def poses(self, start: int = 0) -> Float:
        """Return the poses of the scans from `start` on as a copy, x, y [m], yaw [rad], shape (N - start,
        3)."""
        first = min(start // BLOCK, len(self.blocks))
        return np.concatenate([*self.blocks[first:], self.newest])[start - first * BLOCK :]

    def rows_in_common(self, other: EstimatedPath) -> int:
        """Return a number of first scans that have the same poses in another path: all of them if the paths
        share their blocks, else possibly fewer."""
        ours, theirs = (*self.blocks, self.newest), (*other.blocks, other.newest)
        rows = 0
        for a, b in zip(ours, theirs, strict=False):
            if a is not b:
                n = min(len(a), len(b))
                return rows + int(np.logical_and.accumulate((a[:n] == b[:n]).all(axis=1)).sum())
            rows += len(a)
        return rows


@dataclass(frozen=True, slots=True, eq=False)
class Generation:
    """The particles of one scan.

    Attributes:
        pose: Pose x, y [m], yaw [rad] of each particle before resampling, float32, shape (P, 3).
        ancestors: Row of the particle from which each particle after the scan descends, int64, shape (Q,);
            None if the particles were not resampled.
    """

    pose: Float32
    ancestors: Int | None


@dataclass(frozen=True, slots=True, eq=False)
class Genealogy:
    """The poses and ancestors of all scans. The record is immutable, so states may share it.

    Attributes:
        settled: The distant past of one particle: blocks of float64, shape (BLOCK, 3), x, y [m], yaw [rad].
        recent: The generations after it, oldest first.
        founders: Ancestor of each particle, shape (P,), at the last scan whose number is a multiple of
            FOUNDED, and at the multiple before it; None before the first scan.
    """

    settled: tuple[Float, ...] = ()
    recent: tuple[Generation, ...] = ()
    founders: tuple[Int, Int] | None = None

    @classmethod
    def of_path(cls, path: Float, particles: int) -> Genealogy:
        """Return an ancestry in which all particles have the same path, x, y [m], yaw [rad], shape (N, 3),
        and no founders. All whole blocks are settled; the poses after them are rounded to float32."""
        blocks = len(path) // BLOCK
        settled = tuple(_stored(path[BLOCK * k : BLOCK * (k + 1)]) for k in range(blocks))
        recent = tuple(
            Generation(np.tile(row.astype(np.float32), (particles, 1)), None)
            for row in path[BLOCK * blocks :]
        )
        return cls(settled, recent)

    def __len__(self) -> int:
        """Return the number of scans."""
        return BLOCK * len(self.settled) + len(self.recent)

    def with_scan(self, pose: Float, ancestors: Int | None, leaf: int) -> Genealogy:
        """Return the ancestry with one more scan. When a whole BLOCK of scans is older than the newest
        RECENT_POSES poses (and than the newest BLOCK scans), it is reduced to the path of `leaf`.

        Args:
            pose: Poses x, y [m], yaw [rad] before resampling, shape (P, 3); stored as float32.
            ancestors: Ancestor of each particle after resampling, shape (Q,), or None.
            leaf: The best particle after the scan; the distant past keeps its path.
        """
        return self.with_scans([(pose, ancestors, leaf)])

    def with_scans(self, scans: Iterable[tuple[Float | Float32, Int | None, int]]) -> Genealogy:
        """Return the ancestry with more scans, each given as in `with_scan`; the past is copied only once."""
        settled, recent, founders = list(self.settled), list(self.recent), self.founders
        for pose, ancestors, leaf in scans:
            founders = _founders_after(BLOCK * len(settled) + len(recent), founders, len(pose), ancestors)
            recent.append(Generation(pose.astype(np.float32), ancestors))
            if len(recent) >= BLOCK + max(BLOCK, RECENT_POSES // len(pose)):
                settled.append(_stored(_walk(recent, leaf)[:BLOCK]))
                del recent[:BLOCK]
        return Genealogy(tuple(settled), tuple(recent), founders)

    @property
    def distinct_ancestors(self) -> int:
        """Number of distinct ancestors of the particles FOUNDED to 2 FOUNDED scans ago, or at the first scan
        of a shorter run. 0 before the first scan and after `of_path`."""
        return 0 if self.founders is None else int(np.count_nonzero(np.bincount(self.founders[1])))

    def redrawn(self, rows: Int) -> Genealogy:
        """Return the ancestry of redrawn particles: particle k descends from particle rows[k]. `rows` is
        int64, shape (Q,). The ancestry itself without recent scans."""
        if not self.recent:
            return self
        last = self.recent[-1]
        ancestors = rows if last.ancestors is None else last.ancestors[rows]
        founders = self.founders and (self.founders[0][rows], self.founders[1][rows])
        return Genealogy(self.settled, (*self.recent[:-1], Generation(last.pose, ancestors)), founders)

    def path(self, leaf: int) -> Float:
        """Return the path of particle `leaf` of the newest scan, x, y [m], yaw [rad], shape (N, 3). The
        oldest scans, which are settled, are those of the particle that was best when they were settled. Shape
        (0, 3) without scans."""
        return np.concatenate([*self.settled, _walk(self.recent, leaf)])

    def mean_motion_from(self, scans: Int, weights: Float) -> Float:
        """Return the poses of the base at some scans relative to its pose at the newest scan, as means over
        the particles, x, y [m], yaw [rad], shape (S, 3). Settled scans have the pose of one particle; a scan
        after the newest one gives zeros.

        A single particle would add the noise of its random numbers (Rao-Blackwell).

        Args:
            scans: Numbers of the scans, int64, shape (S,), without duplicates.
            weights: Weights of the particles after the newest scan, shape (P,).
        """
        settled = BLOCK * len(self.settled)
        leaf = np.arange(len(weights))
        T_newest_map, means = np.zeros((len(weights), 3)), np.zeros((len(scans), 3))
        wanted = {int(scan): k for k, scan in enumerate(scans)}
        for scan in range(len(self) - 1, max(min(wanted, default=len(self)), settled) - 1, -1):
            generation = self.recent[scan - settled]
            leaf = leaf if generation.ancestors is None else generation.ancestors[leaf]
            if scan == len(self) - 1:
                T_newest_map = inverse(generation.pose[leaf].astype(np.float64))
            if scan in wanted:
                poses = generation.pose[leaf].astype(np.float64)
                means[wanted[scan]] = _mean(composed(T_newest_map, poses), weights)
        for scan, k in wanted.items():
            if scan < settled:
                pose = self.settled[scan // BLOCK][scan % BLOCK]
                means[k] = _mean(composed(T_newest_map, np.tile(pose, (len(weights), 1))), weights)
        return means


def _founders_after(
    scans: int, founders: tuple[Int, Int] | None, particles: int, ancestors: Int | None
) -> tuple[Int, Int]:
    """Return the founders after one more scan (see Genealogy); `scans`: number of scans before it. `founders`
    is None before the first scan; `ancestors`, shape (P,), is None if the particles were not resampled.
    `particles` is the number of particles before the scan."""
    newer, older = founders or (np.arange(particles),) * 2
    if scans % FOUNDED == 0:
        newer, older = np.arange(particles), newer
    return (newer, older) if ancestors is None else (newer[ancestors], older[ancestors])


def _mean(poses: Float, weights: Float) -> Float:
    """Return the weighted mean of similar poses x, y [m], yaw [rad], shape (P, 3), as shape (3,). `weights`
    have the sum 1, shape (P,); yaws are averaged as differences to the first one."""
    turn = wrap_angle(poses[:, 2] - poses[0, 2])
    yaw = float(wrap_angle(poses[0, 2] + weights @ turn))
    return np.array([*(weights @ poses[:, :2]), yaw])


def _walk(generations: Sequence[Generation], leaf: int) -> Float:
    """Return the pose x, y [m], yaw [rad] of particle `leaf` of the last generation and of its ancestors in
    each generation before, oldest first, shape (len(generations), 3)."""
    rows = np.empty((len(generations), 3))
    for i in range(len(generations) - 1, -1, -1):
        ancestors = generations[i].ancestors
        leaf = leaf if ancestors is None else int(ancestors[leaf])
        rows[i] = generations[i].pose[leaf]
    return rows


_STAMP, _SIGMA, _MOTION = 0, 4, 5  # columns; 1 to 3 are x, y, yaw


class TrajectoryBuffer:
    """Time, pose, sigma and odometry of each scan. Poses come from the argument of `path`.

    Args:
        stamp_ns: Times of the scans so far [ns], int64, shape (N,); None for none.
        sigma: Standard deviations of the positions at the scans [m], shape (N,).
        motion: Odometry steps of the scans, shape (N, 3); see `motion`.
    """

    def __init__(
        self, stamp_ns: Int | None = None, sigma: Float | None = None, motion: Float | None = None
    ) -> None:
        stamp_ns = np.zeros(0, np.int64) if stamp_ns is None else stamp_ns
        sigma = np.zeros(0) if sigma is None else sigma
        motion = np.zeros((0, 3)) if motion is None else motion
        unknown = np.full(len(stamp_ns), np.nan)
        self._rows = GrowingColumns(stamp_ns, unknown, unknown, unknown, sigma, motion)
        self._poses, self._with_pose = EstimatedPath(), 0  # the last path, and the rows that have its poses

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._rows)

    @property
    def stamp_ns(self) -> Int:
        """Times of the scans [ns], int64, shape (N,); a view."""
        return self._rows.column(_STAMP)

    @property
    def sigma_xy(self) -> Float:
        """Standard deviations of the positions [m], shape (N,); a view."""
        return self._rows.column(_SIGMA)

    @property
    def motion(self) -> Float:
        """Steps x, y [m], yaw [rad] by odometry from the scan before to each scan, shape (N, 3); a view."""
        return self._rows.column(_MOTION)

    def append(self, stamp_ns: int, motion: Pose2) -> None:
        """Add a scan with its time [ns] and the odometry step from the scan before to it. Its sigma is NaN
        until `set_sigma`, its pose until `path`."""
        unknown = np.full(1, np.nan)
        stamp, step = np.array([stamp_ns]), motion.as_array()[None]
        self._rows.write(len(self), stamp, unknown, unknown, unknown, unknown, step)

    def set_sigma(self, covariance: Float) -> None:
        """Set the sigma of the last scan, which must exist and not be in a path yet, to sqrt((Cxx + Cyy) /
        2), from the covariance C of x, y [m], yaw [rad], shape (3, 3)."""
        self.sigma_xy[-1] = np.sqrt(0.5 * (covariance[0, 0] + covariance[1, 1]))

    def return_to(self, length: int) -> None:
        """Set the number of scans to `length`, at most the largest number so far. Rows beyond it keep their
        values, which a later return to a larger number gives back, until `append` replaces them."""
        self._rows.return_to(length)
        self._with_pose = min(self._with_pose, length)

    def path(self, poses: EstimatedPath) -> Path:
        """Return the path with `poses`, which must have all N scans of the buffer. The result never changes,
        and shares its memory with later ones, so that a call takes a time that depends only on the rows that
        differ from those of the last call. `sigma_xy` is NaN for scans without a sigma."""
        start = min(self._poses.rows_in_common(poses), self._with_pose)
        if start < len(self):
            stamp, *_, sigma, motion = (self._rows.column(k)[start:] for k in range(_MOTION + 1))
            self._rows.write(start, stamp, *poses.poses(start).T, sigma, motion)
        self._poses, self._with_pose = poses, len(self)
        return Path(*self._rows.shared()[:_MOTION])
