"""Places along the path, and whether their landmarks take part in the data association.

Data association by distance needs a pose whose error is smaller than the distance between trees. After a
long way this holds for the landmarks that the robot has just seen, but not always for those of a place that
it left long ago: each detection is then associated with the old landmark next to it, and many such
associations confirm a wrong pose. At a place that the robot has not seen for REVISIT_DISTANCE, the detections
are therefore compared with the landmarks (`agreement`). Until this decides, the landmarks correct the pose
but are not updated, because a landmark that follows a wrong pose agrees with it. If they agree about as often
as by chance, they are inactive until the pose is corrected, by a loop or by other places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from pipeline.geometry.gaussian import in_map
from pipeline.geometry.poses import Float
from pipeline.jit import compiled_borrowing
from pipeline.types.records import Bool, Int

#: m of path without a view of a place, after which a view of it is a revisit.
REVISIT_DISTANCE = 30.0
#: States of a place: its landmarks are associated and updated, associated only, or left alone.
ACTIVE, UNCERTAIN, INACTIVE = 0, 1, 2
PLACE = 5.0  # m of path; the landmarks that are begun within it belong to one place
GATE = 3.0  # sigma; a detection agrees with a landmark within it
WINDOW = 8.0  # m; radius in which the density of stems is measured; it holds several stems of a forest
AGREEING = 0.4  # least share of the stems of a known place that are seen again; others are hidden
ODDS = math.log(100.0)  # a place is accepted above these log odds and contradicted below their negative


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """M places along the path. Instances are immutable.

    Attributes:
        birth: First birth number of each place, int64, shape (M,), ascending. Landmarks with birth numbers
            from it up to that of the next row belong to the place.
        distance: Distance driven at each place, shape (M,) [m].
        seen: Distance driven when the place was last seen, see `with_scan` and `with_seen`, shape (M,) [m].
        inactive: Which places the detections contradict, shape (M,).
        contradicted: Whether the last scan contradicts a place; then a loop is searched for.
    """

    birth: Int = field(default_factory=lambda: np.zeros(0, np.int64))
    distance: Float = field(default_factory=lambda: np.zeros(0))
    seen: Float = field(default_factory=lambda: np.zeros(0))
    inactive: Bool = field(default_factory=lambda: np.zeros(0, np.bool_))
    contradicted: bool = False

    def with_scan(self, distance: float, first_birth: int, birth: Int) -> Places:
        """Return the places after a scan, with a new place if the last one is PLACE or more behind.
        `contradicted` becomes False.

        Args:
            distance: Distance driven [m].
            first_birth: Birth number of the first landmark that the scan may begin.
            birth: Birth numbers of the landmarks that the scan shows, int64, shape (D,). Their places become
                seen, except those that were not seen for REVISIT_DISTANCE; see `with_seen`.
        """
        places = self
        if not len(self.birth) or distance - self.distance[-1] >= PLACE:
            places = replace(
                self,
                birth=np.append(self.birth, first_birth),
                distance=np.append(self.distance, distance),
                seen=np.append(self.seen, distance),
                inactive=np.append(self.inactive, False),
            )
        row = np.unique(places._row(birth))
        row = row[row >= 0]
        seen = places.seen.copy()
        seen[row[~places.is_old(distance)[row]]] = distance
        return replace(places, seen=seen, contradicted=False)

    def with_seen(self, distance: float, birth: Int) -> Places:
        """Return the places after the landmarks `birth` were seen: the places of these landmarks and those
        within REVISIT_DISTANCE of them along the path are active and seen.

        Args:
            distance: Distance driven [m].
            birth: Birth numbers of the landmarks, int64, shape (L,); may be empty.
        """
        near = self._near(birth)
        return replace(self, seen=np.where(near, distance, self.seen), inactive=self.inactive & ~near)

    def with_contradiction(self, birth: Int) -> Places:
        """Return the places after the detections contradicted landmarks of the given birth numbers, int64,
        shape (L,): their places are inactive, and `contradicted` is True. Landmarks that precede all places
        make no place inactive."""
        inactive = self.inactive.copy()
        row = self._row(birth)
        inactive[row[row >= 0]] = True
        return replace(self, inactive=inactive, contradicted=True)

    def is_old(self, distance: float) -> Bool:
        """Return whether each place was last seen more than REVISIT_DISTANCE of driven path ago, shape (M,).

        Args:
            distance: Distance driven until now [m].
        """
        old: Bool = self.seen < distance - REVISIT_DISTANCE
        return old

    def of_old(self, birth: Int, distance: float) -> Bool:
        """Return which landmarks belong to old places, shape (L,), by birth numbers of shape (L,). False for
        landmarks that precede all places."""
        row = self._row(birth)
        return (row >= 0) & self.is_old(distance)[row] if len(self.birth) else row >= 0

    def is_usable(self, birth: Int) -> Bool:
        """Return which landmarks are not in inactive places, shape (L,), by birth numbers of shape (L,); True
        for landmarks that precede all places."""
        row = self._row(birth)
        return (row < 0) | ~self.inactive[row] if len(self.birth) else row < 0

    def in_reach(self, birth: Int, distance: float) -> PlaceStates:
        """Return the states of all places at a distance driven [m]; an empty table if the places of the given
        landmarks are all active.

        Args:
            birth: Birth numbers of the landmarks in reach, int64, shape (L,).
            distance: Distance driven [m].
        """
        state = np.where(self.inactive, INACTIVE, np.where(self.is_old(distance), UNCERTAIN, ACTIVE))
        row = self._row(birth)
        if not np.any(state[row[row >= 0]] != ACTIVE):
            return NO_PLACES
        return PlaceStates(self.birth, state)

    def _row(self, birth: Int) -> Int:
        """Return the row of the place of each landmark, int64, shape (L,), by birth numbers of this shape; -1
        for those that precede all places."""
        return np.searchsorted(self.birth, birth, side="right") - 1

    def _near(self, birth: Int) -> Bool:
        """Return which places are within REVISIT_DISTANCE along the path of those of some landmarks, shape
        (M,), by their birth numbers, int64, shape (L,); all False for an empty list or landmarks that precede
        all places."""
        row = np.unique(self._row(birth))
        at = self.distance[row[row >= 0]]
        change = np.zeros(len(self.birth) + 1, np.int64)
        np.add.at(change, np.searchsorted(self.distance, at - REVISIT_DISTANCE), 1)
        np.add.at(change, np.searchsorted(self.distance, at + REVISIT_DISTANCE, side="right"), -1)
        near: Bool = np.cumsum(change[:-1]) > 0
        return near


class PlaceStates(NamedTuple):
    """The states of places as kernels take them.

    Attributes:
        birth: See Places.
        state: ACTIVE, UNCERTAIN or INACTIVE, int64, shape (M,).
    """

    birth: Int
    state: Int


#: The table where all places are active.
NO_PLACES = PlaceStates(np.zeros(0, np.int64), np.zeros(0, np.int64))


@compiled_borrowing
def state_of(birth: int, places: PlaceStates) -> int:
    """Return the state of the place of a landmark by its birth number; ACTIVE for landmarks that precede all
    places, and with an empty table."""
    low, high = 0, places.state.shape[0]
    while low < high:
        middle = (low + high) // 2
        if places.birth[middle] <= birth:
            low = middle + 1
        else:
            high = middle
    return places.state[low - 1] if low > 0 else ACTIVE


def states_of(birth: Int, places: PlaceStates) -> Int:
    """Return `state_of` of several landmarks, int64, shape (L,), by birth numbers of shape (L,)."""
    row = np.searchsorted(places.birth, birth, side="right") - 1
    return np.where(row >= 0, places.state[row], ACTIVE) if len(places.state) else np.full(len(birth), ACTIVE)


def agreement(
    pose: Float, pose_covariance: Float, centre: Float, R: Float, mean: Float, covariance: Float
) -> tuple[float, Bool, Bool]:
    """Return the log odds that detections show the given landmarks and not others, which landmarks agree with
    a detection, and which have a detection within WINDOW, shape (L,). The log odds are 0 if no landmark is
    within WINDOW of a detection.

    A landmark agrees with one of the detections around it, which have the density rho, by chance with the
    probability p = 1 - exp(-rho A), where A is the area of the gate, and at the right place with AGREEING (or
    p, if that is larger). The odds are the product of the ratios of both over the landmarks with a detection
    within WINDOW.

    Args:
        pose: x, y [m], yaw [rad], shape (3,).
        pose_covariance: Covariance of the pose relative to the active landmarks, shape (3, 3).
        centre: Detections in the base frame, shape (D, 2) [m].
        R: Covariances xx, xy, yy of the detections, shape (D, 3) [m^2].
        mean: Positions of the landmarks, shape (L, 2) [m].
        covariance: Covariances xx, xy, yy of the landmarks, shape (L, 3) [m^2].
    """
    place, own, added = in_map(
        centre, np.ascontiguousarray(R[:, [0, 1, 1, 2]]).reshape(-1, 2, 2), pose, pose_covariance
    )
    expected = (own + added).reshape(-1, 1, 4)[:, :, [0, 1, 3]]  # of each detection
    y0, y1 = np.moveaxis(mean - place[:, None], 2, 0)
    S0, S1, S2 = np.moveaxis(expected + covariance, 2, 0)
    near = y0 * y0 + y1 * y1 <= WINDOW * WINDOW
    det = S0 * S2 - S1 * S1
    d2 = (S2 * y0 * y0 - 2.0 * S1 * y0 * y1 + S0 * y1 * y1) / det
    close, agrees = near.any(axis=0), (near & (d2 < GATE * GATE)).any(axis=0)
    area = np.pi * GATE * GATE * np.where(near, np.sqrt(det), 0.0).sum(axis=0)
    p = 1.0 - np.exp(-area[close] / (np.pi * WINDOW * WINDOW))
    q = np.maximum(p, AGREEING)
    odds = np.where(agrees[close], np.log(q / p), 0.0)
    hidden = ~agrees[close] & (p < q)
    odds[hidden] = np.log((1.0 - q[hidden]) / (1.0 - p[hidden]))
    return float(odds.sum()), agrees, close
