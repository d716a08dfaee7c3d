"""Localisation of a driving robot in a stored map: global search, then tracking, and withdrawal of a fix that
the stems contradict.

The run is mapped separately from the stored map, in the frame `odom` of its own map or odometry. While the
robot is not found, the stems of the last metres are searched for in the stored map (`search`). A fix gives
T_map_odom. It is updated as in a Kalman filter: the drift since the last alignment increases its covariance,
and the stems in view, paired within this covariance, correct it. A few stems that agree by chance elsewhere
therefore cannot move it. While fewer of the stems in view agree than at a known place, no pose is given. The
fix is withdrawn when the cumulative log odds contradict it.

The stored map is never changed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import binom

from app.extensions.maps.localisation.heights import HeightFix, align_heights
from app.extensions.maps.localisation.search import (
    SIGMA_XY,
    MapFix,
    MapIndex,
    Prior,
    false_alarms,
    fix_near,
    search_map,
)
from app.extensions.maps.localisation.stored_map import StoredMap
from pipeline.geometry.poses import Float, Pose2, Pose3
from pipeline.loop_closure.stem_matching import MapStems, Match, worst_sigma
from pipeline.slam.frame_uncertainty import transported_covariance
from pipeline.slam.places import AGREEING, ODDS
from pipeline.types.records import Bool, Detections, Int, Trees

#: Probability that any search of a drive accepts a wrong pose. The k-th search has the share 1 / (k (k + 1)),
#: so that all shares sum to 1 whatever the length of the drive.
FALSE_FIX = 1e-6
MISSED = 0.01  # probability of saying "nothing of this map is here" although it is
SEARCH_EVERY = 4.0  # m of driven path between two searches
GROWN = 1.25  # a search also follows when the number of stems has grown by this factor
TRACK_EVERY = 1.0  # m of driven path between two alignments
LOCAL = 60.0  # m of driven path, in which the stems of a search were seen; drift bends longer ones
RECENT = 0.5  # m of driven path, in which the stems of an alignment were seen, without detections
REACH = 30.0  # m around the robot, in which stems of an alignment are
MOST_STEMS = 120  # of a search, those nearest to the robot
# Part of the distortion of the maps that the stems around the robot share. With it, intervals of 95 % cover
# 95 % of the true positions of V01 in the maps of other visits (`tests.benchmarks localise`).
SHARED = 0.2
FEWEST = 5  # stems inside the map from which a fix is judged
# Drift of the odometry outside of the map: m/sqrt(m) and rad/sqrt(m), those of wheels on soft ground.
DRIFT_XY, DRIFT_YAW = 0.05, 0.01


class State(Enum):
    """State of a localisation."""

    SEARCHING = "not found yet"
    FOUND = "found"
    NOT_FOUND = "not found"  # at the end of the run
    ABSENT = "nothing of this map is here"


@dataclass(frozen=True, slots=True, eq=False)
class Localisation:
    """Where the robot is in the stored map.

    Attributes:
        state: The state.
        T_map_odom: Pose of the local frame in the map; None unless found.
        covariance: Covariance of x, y [m], yaw [rad] of the base in the map, shape (3, 3), relative to the
            stems of the map; zeros unless found.
        stems, of: Of the stems in view at the last alignment, the number that agree with stems of the map,
            and of those that are where the map has stems.
        residual: Root mean square distance of the stems that agree [m]; NaN without any.
        height: Height and tilt of the local frame; None if unknown.
        driven: Distance driven [m].
        found_at: Distance driven when it was last found [m]; NaN if it never was, or this fix was withdrawn.
        searches: Number of searches.
        withdrawn: Number of fixes that were withdrawn.
        reason: Why the last search found nothing; "" if found or not searched.
    """

    state: State = State.SEARCHING
    T_map_odom: Pose2 | None = None
    covariance: Float = field(default_factory=lambda: np.zeros((3, 3)))
    stems: int = 0
    of: int = 0
    residual: float = math.nan
    height: HeightFix | None = None
    driven: float = 0.0
    found_at: float = math.nan
    searches: int = 0
    withdrawn: int = 0
    reason: str = ""

    @property
    def text(self) -> str:
        """The state for people."""
        if self.state is State.FOUND:
            sigma = math.sqrt(0.5 * (self.covariance[0, 0] + self.covariance[1, 1]))
            agree = f"{self.stems} of {self.of} stems in view agree" if self.of else "too few stems in view"
            return f"found: {agree}, {sigma:.2f} m"
        if not math.isnan(self.found_at):
            return f"found at {self.found_at:.0f} m, lost since: {self.reason}"
        if self.state is State.ABSENT:
            return str(self.state.value)
        if self.withdrawn:
            return "not found: the stems contradicted the place that was found"
        if self.state is State.NOT_FOUND:
            return f"not found in {self.driven:.0f} m of driving"
        return str(self.state.value)

    @property
    def pose_3d(self) -> Pose3 | None:
        """Pose of the local frame in the map with height, roll and pitch; they are 0 where `height` is None.
        None unless found."""
        if self.T_map_odom is None:
            return None
        if self.height is not None:
            return self.height.pose3(self.T_map_odom)
        pose = self.T_map_odom
        return Pose3.from_euler(np.array([pose.x, pose.y, 0.0]), 0.0, 0.0, pose.yaw)


class Localiser:
    """Finds and follows a robot in a stored map.

    Args:
        stored: The map.
        slack: Standard deviation of the distortion of a map within a constellation [m].
        index: Index of the map with this slack, to share it among localisers; it is made if None.
    """

    def __init__(self, stored: StoredMap, slack: float = 0.1, *, index: MapIndex | None = None) -> None:
        """Prepare the search; a map without stems is never found."""
        self.stored = stored
        self.localisation = Localisation()
        self._slack = slack
        self._index = (index or MapIndex.of(stored, slack)) if len(stored) else None
        self._terrain = cKDTree(stored.terrain[:, :2]) if len(stored.terrain) else None
        self._stamp_ns: list[int] = []
        self._driven: list[float] = []
        self._pose = Pose2()
        self._view: Detections | None = None
        self._fix: MapFix | None = None
        self._followed = Pose2()  # T_map_odom, while there is a fix
        self._covariance: Float = np.zeros((3, 3))  # of x, y, yaw of the base in the map at _place
        self._place, self._fixed_at, self._odds = np.zeros(2), 0.0, 0.0
        self._next = 0.0
        self._searched_stems = self._first = 0

    def update(
        self,
        stamp_ns: int,
        T_odom_base: Pose2,
        trees: Trees,
        terrain: Float | None = None,
        view: Detections | None = None,
    ) -> Localisation:
        """Add the local map after a scan, and return the localisation.

        Args:
            stamp_ns: Time of the scan; later than before [ns].
            T_odom_base: Pose of the robot in the local frame.
            trees: The local map, in the local frame. Only confirmed trees count.
            terrain: x, y, z of the cells of the local terrain, shape (K, 3) [m]; None if unknown.
            view: Trees of the scan in the base frame, which determine the present pose even if the pose in
                the local map has slipped; None takes the trees of the local map that were seen last.
        """
        self._view = view
        before, self._pose = self._pose, T_odom_base
        driven = 0.0
        if self._driven:
            driven = self._driven[-1] + math.hypot(T_odom_base.x - before.x, T_odom_base.y - before.y)
        self._stamp_ns.append(stamp_ns)
        self._driven.append(driven)
        self.localisation = replace(self.localisation, driven=driven)
        if self._index is None:
            return self.localisation
        if self._fix is None:
            self._search(self._index, trees, terrain)
        elif driven >= self._next:
            self._track(self._index, trees, terrain)
        return self.localisation

    def end(self) -> Localisation:
        """Return the localisation at the end of the run, after which nothing is found any more."""
        if self.localisation.state is State.SEARCHING:
            self.localisation = replace(self.localisation, state=State.NOT_FOUND)
        return self.localisation

    @property
    def match(self) -> Match | None:
        """The present fix as the match of the local map with the stored one; None unless found."""
        fix = self._fix
        if fix is None or self.localisation.T_map_odom is None:
            return None
        alarms = false_alarms(len(fix.local), max(fix.inside, len(fix.local)), fix.looked, fix.chance)
        covariance = fix.covariance_at(np.zeros(2))
        return Match(
            fix.pose,
            covariance,
            None,
            fix.local,
            fix.reference,
            fix.second,
            max(alarms / math.log(10.0), -300.0),
        )

    def _search(self, index: MapIndex, trees: Trees, terrain: Float | None) -> None:
        """Search the stems of the last metres in the map, if enough are new since the last search."""
        rows = self._recent(trees, LOCAL)
        rows = rows[trees.confirmed[rows]][:MOST_STEMS]
        driven = self._driven[-1]
        if len(rows) < FEWEST or (driven < self._next and len(rows) < GROWN * self._searched_stems):
            return
        self._next, self._searched_stems = driven + SEARCH_EVERY, len(rows)
        k = self.localisation.searches + 1
        level = FALSE_FIX / (k * (k + 1))
        stems = _stems(trees, rows)
        fix = search_map(stems, index, self._slack, level)
        if fix.reason is None and fix.pose is not None:
            now = fix_near(fix.pose, self._in_view(trees), index, self._slack)
            if now.pose is not None and _log_odds(len(now.local), now.inside, now.chance) > ODDS:
                self.localisation = replace(self.localisation, searches=k)
                self._use(now, now.pose, terrain, is_new=True)
            else:  # the local map is of one place, and the robot in another
                self.localisation = replace(
                    self.localisation, state=State.SEARCHING, searches=k, reason="the stems in view disagree"
                )
            return
        # A robot that was found has left the map; the map is still that of this run.
        was_found = not math.isnan(self.localisation.found_at)
        absent = not was_found and _would_be_found(fix, len(stems), len(index.stems), level)
        state = State.ABSENT if absent else State.SEARCHING
        self.localisation = replace(self.localisation, state=state, searches=k, reason=fix.reason or "")

    def _track(self, index: MapIndex, trees: Trees, terrain: Float | None) -> None:
        """Correct the pose by the stems in view; withdraw it if they contradict it."""
        self._next = self._driven[-1] + TRACK_EVERY
        prior, base = self._prior(), self._followed @ self._pose
        fix = fix_near(self._followed, self._in_view(trees), index, self._slack, Prior(base, prior))
        odds = _log_odds(len(fix.local), fix.inside, fix.chance) if fix.inside >= FEWEST else 0.0
        self._odds = min(self._odds + odds, 0.0)  # cumulative sum (Page 1954)
        # After a pause the prior is wide, and few stems agree with it by chance: as much as for a first fix.
        needed = 0.0 if self.localisation.T_map_odom is not None else ODDS
        if self._odds < -ODDS:
            self._first = len(self._stamp_ns) - 1  # what was seen before is in another place of the local map
            self._search_again("contradicted", is_wrong=True)
        elif fix.inside < FEWEST:
            self._drift(prior)
        elif fix.pose is not None and odds > needed and len(fix.local) >= AGREEING * fix.inside:
            self._use(fix, fix.pose, terrain, is_new=False)
        elif _is_uncertain(prior):
            self._search_again("the stems in view disagree")
        else:
            self.localisation = replace(
                self.localisation, state=State.SEARCHING, T_map_odom=None, covariance=np.zeros((3, 3)),
                stems=len(fix.local), of=fix.inside, reason="the stems in view disagree",
            )  # fmt: skip

    def _prior(self) -> Float:
        """Return the covariance of the base in the map by the last alignment and the drift since then."""
        place = self._followed.apply(np.array([[self._pose.x, self._pose.y]]))[0]
        dx, dy = place - self._place
        way = self._driven[-1] - self._fixed_at
        drift = np.diag([DRIFT_XY**2 * way, DRIFT_XY**2 * way, DRIFT_YAW**2 * way])
        return transported_covariance(self._covariance, float(dx), float(dy)) + drift

    def _use(self, fix: MapFix, pose: Pose2, terrain: Float | None, *, is_new: bool) -> None:
        """Take over a fix with its pose: new, or an alignment of the present one."""
        self._fix, self._followed, self._fixed_at = fix, pose, self._driven[-1]
        self._next = self._driven[-1] + TRACK_EVERY
        odom = np.array([self._pose.x, self._pose.y])
        self._place = at = pose.apply(odom[None])[0]
        self._covariance = fix.covariance_at(odom)
        height = (
            None
            if terrain is None
            else align_heights(pose, terrain, self._terrain, self.stored.terrain[:, 2], at)
        )
        self.localisation = replace(
            self.localisation,
            state=State.FOUND,
            T_map_odom=pose,
            covariance=self._covariance + self._shared,
            stems=len(fix.local),
            of=max(fix.inside, len(fix.local)),
            residual=fix.residual,
            height=self.localisation.height if height is None else height,
            found_at=self._driven[-1] if is_new else self.localisation.found_at,
            reason="",
        )
        if is_new:
            self._odds = 0.0

    def _drift(self, covariance: Float) -> None:
        """Keep the pose with the covariance of `_prior`, but none where the last stems disagreed; search
        again if it is too uncertain for a fix."""
        if _is_uncertain(covariance):
            self._search_again("outside of the map")
        elif self.localisation.T_map_odom is not None:
            self.localisation = replace(
                self.localisation, covariance=covariance + self._shared, stems=0, of=0
            )

    @property
    def _shared(self) -> Float:
        """Covariance of the distortion that the stems around the robot share, shape (3, 3)."""
        variance = (SHARED * self._slack) ** 2
        return np.diag([variance, variance, 0.0])

    def _search_again(self, reason: str, *, is_wrong: bool = False) -> None:
        """Give up the fix; withdraw it if it is wrong."""
        self._fix, self._searched_stems = None, 0
        before = self.localisation
        self.localisation = Localisation(
            driven=before.driven,
            found_at=math.nan if is_wrong else before.found_at,
            searches=before.searches,
            withdrawn=before.withdrawn + is_wrong,
            reason=reason,
        )

    def _in_view(self, trees: Trees) -> MapStems:
        """Return the stems that determine the present pose, in the local frame."""
        view = self._view
        if view is None:
            return _stems(trees, self._recent(trees, RECENT)[:MOST_STEMS])
        sigma = worst_sigma(view.covariance[:, [0, 0, 1], [0, 1, 1]])
        unknown = np.full(len(sigma), np.nan)
        stems = MapStems(self._pose.apply(view.centre), sigma, unknown, unknown)
        return stems.take(stems.usable())

    def _recent(self, trees: Trees, way: float) -> Int:
        """Return the rows of the trees, also of unconfirmed ones, that were seen in the last `way` metres,
        nearest first; for RECENT within REACH of the robot."""
        first = max(int(np.searchsorted(self._driven, self._driven[-1] - way)), self._first)
        seen: Bool = trees.last_seen_ns >= self._stamp_ns[first]
        rows = np.flatnonzero(seen & np.isfinite(trees.position).all(axis=1))
        distance = np.hypot(*(trees.position[rows] - [self._pose.x, self._pose.y]).T)
        order = np.argsort(distance, kind="stable")
        reach = np.inf if way == LOCAL else REACH
        nearest: Int = rows[order[distance[order] <= reach]]
        return nearest


def _stems(trees: Trees, rows: Int) -> MapStems:
    """Return some trees as stems, in the order of the rows."""
    sigma = worst_sigma(trees.covariance[rows][:, [0, 0, 1], [0, 1, 1]])
    dbh = trees.dbh[rows]
    stems = MapStems(trees.position[rows], sigma, dbh, np.where(np.isnan(dbh), np.nan, trees.dbh_sigma[rows]))
    return stems.take(stems.usable())


def _log_odds(k: int, n: int, p: float) -> float:
    """Return the log odds that k of n stems agree because the robot is there, and not by chance with the
    probability p; see `places.agreement`."""
    q = max(AGREEING, p)
    p = min(max(p, 1e-6), 1.0 - 1e-6)
    return k * math.log(q / p) + (n - k) * math.log((1.0 - q) / (1.0 - p))


def _is_uncertain(covariance: Float) -> bool:
    """Return whether a pose of the base in the map is too uncertain for a fix."""
    return bool(max(np.sqrt(np.diag(covariance)[:2])) > SIGMA_XY)


def _would_be_found(fix: MapFix, n: int, of: int, level: float) -> bool:
    """Return whether a search of n stems that found nothing would have found the place with a probability of
    1 - MISSED, if the share AGREEING of the stems, or of the `of` stems of the map if these are fewer, were
    seen in the map."""
    if fix.reason == "too few stems":
        return False
    chance = max(fix.wrong_chance(n), 1e-3)
    needed = next(
        (k for k in range(n + 1) if false_alarms(k, n, fix.looked, chance) <= math.log(level)), n + 1
    )
    return float(binom.cdf(needed - 1, min(n, of), AGREEING)) <= MISSED


__all__ = ["Localisation", "Localiser", "State"]
