"""What one observation tells of a tree, and what all of them together tell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing, compiled_within
from pipeline.tracking.track_table import Rows
from pipeline.types.records import Bool, Int, Verdict

SECTORS = 36  # of 10 degrees around a trunk, kept as bits: which sides were seen
WIDTH = 2.0 * np.pi / SECTORS  # rad
ALL_SIDES = (1 << SECTORS) - 1
DBH_OBSERVATIONS = 3  # fewer radii are no diameter yet
TAPER = 0.005  # of the radius per metre of height; stems of pine and spruce lose 0.3 to 0.7 cm a metre
# Below breast height stems swell to their roots: in two scanned plots radii grow by 1.5 to 2 cm a metre
# (docs/trunks.md), others do not swell at all, and half of it is right or wrong by as much for both.
BUTT = 0.01
HALF = 0.5  # m; so far above or below breast height a view counts half: no stem tapers as another
# What more scans do not average out of a radius: how far the edges of a trunk are known, a fifth of half a
# beam's width, and bark, in m; `Tracking` declares how far trunks are not round, and how they taper.
EDGE, UNEVEN = 0.0003, 0.0005
NEAREST = 1.0  # m; a trunk nearer than this counts no more


@compiled_borrowing
def add_observations(
    rows: Int,
    place: Float,
    pose: Float,
    eccentricity: Float,
    radius: Float,
    radius_sigma: Float,
    arc: Float,
    above_breast: Float,
    hits: Int,
    eccentricity_sum: Float,
    eccentricities: Int,
    radius_sum: Float,
    radius_weight: Float,
    radius_reach: Float,
    radius_above: Float,
    radii: Int,
    sides: Int,
) -> None:
    """Add one scan's detections to the columns of their trees (see `TrackTable`), in place.

    Args:
        rows: The tree of each detection, none twice, shape (D,).
        place: Frame of the map, shape (D, 2) [m]; pose: of the robot, shape (3,).
        eccentricity, radius, radius_sigma, arc: See `Detections`, shape (D,); of an arc no more counts than
            one view can show (see `widest_view`).
        above_breast: How far above breast height the radius was measured, shape (D,) [m]; NaN where no
            ground was seen: such a radius counts as it is, and as half a metre off.

    A radius weighs by its variance and by the square of the distance: what a fit does not know of, as the
    width of a beam, errs in proportion to the distance and the same way in every scan, so that a hundred
    views from afar must not outvote a few from near by. For the same reason it weighs by its height: how
    much a stem tapers, nobody knows.
    """
    for d in range(rows.shape[0]):
        t = rows[d]
        hits[t] += 1
        if np.isfinite(eccentricity[d]):
            eccentricity_sum[t] += eccentricity[d]
            eccentricities[t] += 1
        if np.isfinite(radius[d]):
            reach = max(np.hypot(pose[0] - place[d, 0], pose[1] - place[d, 1]), NEAREST)
            # A band of heights sees the thicker foot of a near tree, and its mean lies below breast height.
            known = np.isfinite(above_breast[d])
            above = above_breast[d] if known else 0.0
            weight = 1.0 / ((radius_sigma[d] * reach) ** 2 * (1.0 + (above / HALF) ** 2))
            lost = (TAPER if above >= 0.0 else BUTT) * above
            radius_sum[t] += weight * (radius[d] + lost)
            radius_weight[t] += weight
            radius_reach[t] += weight * reach
            radius_above[t] += weight * (abs(above) if known else HALF)
            radii[t] += 1
        # A view without a circle of its own is of a stem as thick as the others say.
        known_radius = radius[d] if np.isfinite(radius[d]) else radius_sum[t] / max(radius_weight[t], 1e-300)
        dx, dy = pose[0] - place[d, 0], pose[1] - place[d, 1]
        shown = min(arc[d], widest_view(known_radius, np.hypot(dx, dy)))
        sides[t] |= seen_sides(np.arctan2(dy, dx), shown)


@compiled_within
def widest_view(radius: float, distance: float) -> float:
    """How much of a round stem one view shows at most, from tangent to tangent: 2 arccos(r / d) [rad].

    It is less than half of it, however many returns noise throws behind the axis, where a fit counts them.

    Args:
        radius: r > 0, without which nothing is known to be round: 0.
        distance: d, from the sensor to the axis [m]; a sensor within the stem sees nothing of it.
    """
    return 2.0 * np.arccos(min(radius / distance, 1.0)) if radius > 0.0 and distance > 0.0 else 0.0


@compiled_borrowing
def seen_sides(from_bearing: float, arc: float) -> np.int64:
    """Bits of the sectors around a trunk that a view from a direction shows.

    Args:
        from_bearing: Direction from the trunk to the sensor, frame of the map [rad].
        arc: Visible arc around that direction [rad].
    """
    first = int(np.ceil((from_bearing - arc / 2) / WIDTH - 1e-9))
    last = int(np.floor((from_bearing + arc / 2) / WIDTH + 1e-9))
    count, begin = max(min(last - first, SECTORS), 0), first % SECTORS  # whole sectors were seen alone
    run = (np.int64(1) << np.int64(count)) - np.int64(1)
    return ((run << np.int64(begin)) | (run >> np.int64(SECTORS - begin))) & ALL_SIDES


class Telling(NamedTuple):
    """Of the parameters `Tracking`: what the figures of a tree hang on."""

    hits_to_confirm: int
    dbh_arc_min: float
    out_of_round: float
    taper_sigma: float


@compiled
def table_figures(rows: Rows, telling: Telling) -> tuple[Float, Float, Float, Float, Bool]:
    """Coverage [rad], DBH and its sigma [m], mean eccentricity, and which trees are confirmed, each of
    shape (T,), from the columns of a `TrackTable`; NaN for what was not told."""
    T = rows.sides.shape[0]
    coverage, dbh, dbh_sigma, mean = np.empty(T), np.empty(T), np.empty(T), np.full(T, np.nan)
    confirmed = np.empty(T, np.bool_)
    _figure(rows, telling, coverage, dbh, dbh_sigma, mean, confirmed)
    return coverage, dbh, dbh_sigma, mean, confirmed


@compiled_borrowing
def _figure(
    rows: Rows, telling: Telling, coverage: Float, dbh: Float, dbh_sigma: Float, mean: Float, confirmed: Bool
) -> None:
    for t in range(rows.sides.shape[0]):
        coverage[t] = sides_of(rows.sides[t]) * WIDTH
        dbh[t], dbh_sigma[t] = diameter(rows, t, coverage[t], telling)
        if rows.eccentricities[t] > 0:
            mean[t] = rows.eccentricity[t] / rows.eccentricities[t]
        confirmed[t] = is_confirmed(rows.verdict[t], rows.hits[t], telling)


@compiled_borrowing
def sides_of(bits: int) -> int:
    """How many sectors of a trunk were seen."""
    seen = 0
    while bits:
        bits &= bits - 1  # takes the lowest bit away
        seen += 1
    return seen


@compiled_within
def is_confirmed(verdict: int, hits: int, telling: Telling) -> bool:
    """Whether a track is a tree: by what was gathered where that tells anything, else by its hits."""
    return bool(verdict == Verdict.TREE if verdict >= 0 else hits >= telling.hits_to_confirm)


@compiled_within
def diameter(rows: Rows, t: int, coverage: float, telling: Telling) -> tuple[float, float]:
    """DBH and its sigma [m] of the tree of a row, NaN where too little of it was seen.

    The sigma of a diameter D of n views at distances r, of a mean height |h| above or below breast height:

        sigma^2 = 4 (sigma_views^2 / n + (EDGE r + UNEVEN)^2) + (out_of_round D)^2 + (taper_sigma |h|)^2

    The last three do not shrink with n: all views of one tree share its edges, its shape and its butt. What
    the views weigh by their height widens sigma_views too, so that it is told rather too large.
    """
    if not (rows.radii[t] >= DBH_OBSERVATIONS and coverage >= telling.dbh_arc_min - 1e-9):
        return np.nan, np.nan
    weight = rows.radius_weight[t]
    reach, above = rows.radius_reach[t] / weight, rows.radius_above[t] / weight
    dbh = 2.0 * rows.radius[t] / weight
    views = 1.0 / (weight * reach * reach) + (EDGE * reach + UNEVEN) ** 2
    stem = (telling.out_of_round * dbh) ** 2 + (telling.taper_sigma * above) ** 2
    return dbh, np.sqrt(4.0 * views + stem)
