"""Decision rule: verdicts of columns by the votes of the forest and by their visibility."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.classification.features import BANDS, NAMES
from pipeline.classification.forest import CLASSES
from pipeline.geometry.poses import Float
from pipeline.types.records import AT_ROUND, Bool, Columns, Int32, Verdict

VOXELS, LEAST_VOXELS = NAMES.index("voxels to 3 m"), 6.0
GONE, GONE_SCANS = 0.5, 5  # share and least number of scans with free view of the position
UNFORCED = -1
BREAST_HEIGHT = slice(6, 11)  # slices, 1.2 to 2.2 m
ABOVE_A_HEAD = slice(int(BANDS[3, 0]), int(BANDS[3, 1]))  # slices, 2.2 to 3.2 m
STOPPED, RAYS = 0.3, 10  # a trunk stops a larger share of the rays; least number of rays
MIGHT = 0.3  # share of the votes, weighted for a round cluster, from which a column might be a tree


@dataclass(frozen=True, slots=True, eq=False)
class ColumnVotes:
    """Columns of length C.

    Attributes:
        place: x, y in the frame of the map, shape (C, 2) [m].
        votes: Shares of the votes, shape (C, classes); trees first.
        otherwise: Verdict with too few votes for a tree, int32. Columns that might be a tree by a round
            cluster are TOO_LOW where rays pass above the height of a head.
        forced: Verdict that does not depend on the votes, int32, UNFORCED for none: too few voxels, gone, or
            TOO_LOW where rays pass at breast height.
    """

    place: Float
    votes: Float
    otherwise: Int32
    forced: Int32

    @property
    def nbytes(self) -> int:
        """Memory of all arrays [bytes]."""
        return self.place.nbytes + self.votes.nbytes + self.otherwise.nbytes + self.forced.nbytes

    def verdict(self, tree_share: float) -> Int32:
        """Return the verdict of each column, int32, shape (C,): `forced` if there is one, else TREE with
        enough votes, else `otherwise`.

        Args:
            tree_share: Least share of the votes of a tree, inclusive.
        """
        voted = np.where(self.votes[:, 0] >= tree_share, np.int32(Verdict.TREE), self.otherwise)
        verdict: Int32 = np.where(self.forced == UNFORCED, voted, self.forced).astype(np.int32)
        return verdict


def column_votes(columns: Columns) -> ColumnVotes:
    """Return everything that decides the verdicts of columns, as copies; without columns, empty arrays. Of
    several forced verdicts, gone (MOVING) comes before too few voxels (TOO_FEW_POINTS), and this before
    TOO_LOW."""
    c = columns
    if not len(c.share):
        nothing = np.zeros(0, np.int32)
        return ColumnVotes(np.zeros((0, 2)), np.zeros((0, len(CLASSES))), nothing, nothing)
    otherwise = np.array(CLASSES, np.int32)[c.share.argmax(axis=1)]
    otherwise[otherwise == Verdict.TREE] = Verdict.OTHER
    otherwise[(c.share[:, 0] >= MIGHT * (c.share @ np.array(AT_ROUND))) & is_transparent(c, ABOVE_A_HEAD)] = (
        Verdict.TOO_LOW
    )
    forced = np.full(len(c.share), UNFORCED, np.int32)
    forced[is_transparent(c, BREAST_HEIGHT)] = Verdict.TOO_LOW
    forced[too_few(c.figures)] = Verdict.TOO_FEW_POINTS
    forced[(c.absent >= GONE_SCANS) & (c.absent > GONE * (c.present + c.absent))] = Verdict.MOVING
    return ColumnVotes(c.axis[:, :2].copy(), c.share.copy(), otherwise, forced)


def is_transparent(columns: Columns, slices: slice) -> Bool:
    """Return which columns let most rays pass in a band of heights, shape (C,).

    A trunk is opaque: of 5,106 views of simulated and labelled trunks with at least `RAYS` rays between 1.2
    and 2.2 m, only one stopped less than `STOPPED` of the rays. Above parked motorcycles rays pass. Columns
    with fewer than `RAYS` rays in the band are not transparent.

    Args:
        columns: Columns with the numbers of rays that ended at them and that passed them, by slice.
        slices: The band.
    """
    met, passed = (rays[:, slices].sum(axis=1) for rays in (columns.met, columns.passed))
    transparent: Bool = (met + passed >= RAYS) & (met < STOPPED * (met + passed))
    return transparent


def too_few(figures: Float) -> Bool:
    """Return which columns have so few voxels up to 3 m, less than LEAST_VOXELS, that they may have been
    found by chance, shape (C,). `figures` are their features, shape (C, COUNT)."""
    few: Bool = figures[:, VOXELS] < LEAST_VOXELS
    return few
