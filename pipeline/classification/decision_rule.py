"""What columns are judged by, once their figures are known: the votes, and a threshold on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.classification.features import BANDS, NAMES
from pipeline.classification.forest import CLASSES
from pipeline.geometry.poses import Float
from pipeline.types.records import AT_ROUND, Bool, Columns, Int32, Verdict

VOXELS, LEAST_VOXELS = NAMES.index("voxels to 3 m"), 6.0
GONE, GONE_SCANS = 0.5, 5  # of the scans that could see something there, and at least so many
UNFORCED = -1
BREAST_HEIGHT = slice(6, 11)  # slices, 1.2 to 2.2 m
ABOVE_A_HEAD = slice(int(BANDS[3, 0]), int(BANDS[3, 1]))  # slices, 2.2 to 3.2 m
STOPPED, RAYS = 0.3, 10  # a trunk stops a larger part of the rays, of at least so many that reach it
MIGHT = 0.3  # of the votes as they count at a round place; so many for a tree might make it one


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Columns of length C.

    Attributes:
        place: x, y in the frame of the map, shape (C, 2) [m].
        votes: Shares of the votes, shape (C, classes), that for a tree first.
        otherwise: int32: the verdict where these are too few, see Verdict. What might be a tree for being
            round is TOO_LOW where rays saw that nothing of it stands above a head.
        forced: int32: the verdict whatever the votes, UNFORCED for none: too few voxels, gone, or TOO_LOW
            where rays pass at breast height.
    """

    place: Float
    votes: Float
    otherwise: Int32
    forced: Int32

    @property
    def nbytes(self) -> int:
        """Of all columns."""
        return self.place.nbytes + self.votes.nbytes + self.otherwise.nbytes + self.forced.nbytes

    def verdict(self, tree_share: float) -> Int32:
        """Of each column."""
        voted = np.where(self.votes[:, 0] >= tree_share, np.int32(Verdict.TREE), self.otherwise)
        verdict: Int32 = np.where(self.forced == UNFORCED, voted, self.forced).astype(np.int32)
        return verdict


def judged(columns: Columns) -> Judged:
    """What the verdicts of columns hang on."""
    c = columns
    if not len(c.share):
        nothing = np.zeros(0, np.int32)
        return Judged(np.zeros((0, 2)), np.zeros((0, len(CLASSES))), nothing, nothing)
    otherwise = np.array(CLASSES, np.int32)[c.share.argmax(axis=1)]
    otherwise[otherwise == Verdict.TREE] = Verdict.OTHER
    otherwise[(c.share[:, 0] >= MIGHT * (c.share @ np.array(AT_ROUND))) & is_transparent(c, ABOVE_A_HEAD)] = (
        Verdict.TOO_LOW
    )
    forced = np.full(len(c.share), UNFORCED, np.int32)
    forced[is_transparent(c, BREAST_HEIGHT)] = Verdict.TOO_LOW
    forced[too_few(c.figures)] = Verdict.TOO_FEW_POINTS
    forced[(c.absent >= GONE_SCANS) & (c.absent > GONE * (c.present + c.absent))] = Verdict.MOVING
    return Judged(c.axis[:, :2].copy(), c.share.copy(), otherwise, forced)


def is_transparent(columns: Columns, slices: slice) -> Bool:
    """Columns that let most rays pass in a band of heights, shape (C,).

    A trunk is opaque: of 5,106 views of simulated and labelled trunks with at least `RAYS` rays between
    1.2 and 2.2 m, one stopped less than `STOPPED` of them. Above parked motorcycles rays go on.

    Args:
        columns: With the rays that ended at them and those that passed them, by slice.
        slices: The band.
    """
    met, passed = (rays[:, slices].sum(axis=1) for rays in (columns.met, columns.passed))
    transparent: Bool = (met + passed >= RAYS) & (met < STOPPED * (met + passed))
    return transparent


def too_few(figures: Float) -> Bool:
    """Columns of so few voxels that chance can pile them up."""
    few: Bool = figures[:, VOXELS] < LEAST_VOXELS
    return few
