"""Where the particles of today were before: the path that one of them has behind it.

Each scan leaves the poses of all particles and, where it resampled, who came from whom. Walking
back from a particle gives its own path, which the scans after a loop have chosen, while the means of
the past only knew the scans up to then. As soon as the past is long enough it is settled: the rows of
one particle are kept of it, so that memory stays bounded.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.types.records import Float32, Int

RECENT_POSES = 300_000  # of all particles that are kept: the time in which a loop can still choose
BLOCK = 512  # scans that are settled at once
FOUNDED = 50  # scans; a filter whose particles all come from one so early has no other past to choose


@dataclass(frozen=True, slots=True, eq=False)
class Generation:
    """One scan: `pose`, float32, shape (P, 3), of its particles, and `ancestors`, int64, shape (Q,):
    which of them each particle after it comes from; None where each comes from itself."""

    pose: Float32
    ancestors: Int | None


@dataclass(frozen=True, slots=True, eq=False)
class Genealogy:
    """Immutable, so that it may be kept with every state: growing it makes another.

    Attributes:
        settled: Blocks of float64, shape (BLOCK, 3): x, y [m], yaw [rad], the far past.
        recent: The generations since then, oldest first.
        founders: Which particle each one comes from, shape (P,), since the last time that the number of
            scans was a multiple of FOUNDED, and since the time before it; None before the first scan.
    """

    settled: tuple[Float, ...] = ()
    recent: tuple[Generation, ...] = ()
    founders: tuple[Int, Int] | None = None

    @classmethod
    def of_path(cls, path: Float, particles: int) -> Genealogy:
        """All particles with one path behind them, x, y [m], yaw [rad], shape (N, 3)."""
        blocks = len(path) // BLOCK
        settled = tuple(path[BLOCK * k : BLOCK * (k + 1)].copy() for k in range(blocks))
        recent = tuple(
            Generation(np.tile(row.astype(np.float32), (particles, 1)), None)
            for row in path[BLOCK * blocks :]
        )
        return cls(settled, recent)

    def __len__(self) -> int:
        return BLOCK * len(self.settled) + len(self.recent)

    @property
    def nbytes(self) -> int:
        """Of all arrays but the founders."""
        poses = sum(block.nbytes for block in self.settled) + sum(g.pose.nbytes for g in self.recent)
        return poses + sum(g.ancestors.nbytes for g in self.recent if g.ancestors is not None)

    def with_scan(self, pose: Float, ancestors: Int | None, leaf: int) -> Genealogy:
        """One scan more.

        Args:
            pose: shape (P, 3), before the scan resampled.
            ancestors: Who comes from whom after it, shape (Q,).
            leaf: The best particle after it; its path is taken where the past has to be settled.
        """
        return self.with_scans([(pose, ancestors, leaf)])

    def with_scans(self, scans: Iterable[tuple[Float | Float32, Int | None, int]]) -> Genealogy:
        """Many scans more, each as `with_scan` takes it: the past is copied once and not for each."""
        settled, recent, founders = list(self.settled), list(self.recent), self.founders
        for pose, ancestors, leaf in scans:
            founders = _founders_after(BLOCK * len(settled) + len(recent), founders, len(pose), ancestors)
            recent.append(Generation(pose.astype(np.float32), ancestors))
            if len(recent) >= BLOCK + max(BLOCK, RECENT_POSES // len(pose)):
                settled.append(_walk(recent, leaf)[:BLOCK])
                del recent[:BLOCK]
        return Genealogy(tuple(settled), tuple(recent), founders)

    @property
    def distinct_ancestors(self) -> int:
        """How many particles of FOUNDED to 2 FOUNDED scans ago the particles of today come from; of the
        first scan, while there were fewer."""
        return 0 if self.founders is None else int(np.count_nonzero(np.bincount(self.founders[1])))

    def redrawn(self, rows: Int) -> Genealogy:
        """The same past of particles drawn anew: each one comes from the particle in its row."""
        if not self.recent:
            return self
        last = self.recent[-1]
        ancestors = rows if last.ancestors is None else last.ancestors[rows]
        founders = self.founders and (self.founders[0][rows], self.founders[1][rows])
        return Genealogy(self.settled, (*self.recent[:-1], Generation(last.pose, ancestors)), founders)

    def path(self, leaf: int) -> Float:
        """x, y [m], yaw [rad] of every scan as the particle `leaf` of the last one has it behind it,
        shape (N, 3)."""
        return np.concatenate([*self.settled, _walk(self.recent, leaf)])


def _founders_after(
    scans: int, founders: tuple[Int, Int] | None, particles: int, ancestors: Int | None
) -> tuple[Int, Int]:
    """The founders after one scan more, that many before it; see Genealogy."""
    newer, older = founders or (np.arange(particles),) * 2
    if scans % FOUNDED == 0:
        newer, older = np.arange(particles), newer
    return (newer, older) if ancestors is None else (newer[ancestors], older[ancestors])


def _walk(generations: Sequence[Generation], leaf: int) -> Float:
    rows = np.empty((len(generations), 3))
    for i in range(len(generations) - 1, -1, -1):
        ancestors = generations[i].ancestors
        leaf = leaf if ancestors is None else int(ancestors[leaf])
        rows[i] = generations[i].pose[leaf]
    return rows
