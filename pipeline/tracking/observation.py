"""Attributes of a tree from its observations: observed sides, diameter at breast height, eccentricity,
confirmation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.config.stages import Tracking
from pipeline.detection.cylinder_fit import BEAM
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.tracking.track_table import Rows
from pipeline.types.records import Bool, Int, Verdict
from pipeline.types.units import SECOND_NS

SECTORS = 36  # of 10 degrees around a trunk; one bit for each that was seen
WIDTH = 2.0 * np.pi / SECTORS  # rad
ALL_SIDES = (1 << SECTORS) - 1
DBH_OBSERVATIONS = 3  # minimum number of radii for a diameter
TAPER = 0.005  # radius per metre of height; stems of pine and spruce taper by 0.3 to 0.7 cm a metre
# Below breast height stems widen towards their roots: in two scanned plots radii grow by 1.5 to 2 cm a metre
# (docs/trunks.md), in others not at all. Half of the larger value has the same error for both.
BUTT = 0.01
HALF = 0.5  # m; distance from breast height at which a radius has half the weight, since the taper varies
# Errors of a radius that more scans do not reduce: each edge of a trunk is known to a fifth of half the width
# of a beam, or of half the distance between returns if that is larger; bark is uneven [m].
EDGE, UNEVEN = 0.2, 0.0005
#: A circle fitted by least squares to ONE_VIEW [rad] of a stem of radius r (1 + a cos 2 (angle - b)) has a
#: radius that is wrong by RADIUS_GAIN a r cos 2 b, and over all b the RMS error of each coordinate of its
#: centre is CENTRE_GAIN times that of a r cos 2 b. Views from all sides cancel both: the radius like the
#: second harmonic of their direction, the centre mainly like the first one, since it turns with the view.
ONE_VIEW, RADIUS_GAIN, CENTRE_GAIN = np.radians(140.0), 2.0, 2.3
#: Least diameter of a trunk, in distances between returns: a sampled shape is resolved from two samples on
#: (Nyquist). What returns measure of thinner trunks depends on the prior and on the undergrowth.
RESOLVED = 2.0
#: Diameter above which the largest standard deviation of a reported diameter grows in proportion [m], since
#: errors by the shape of a stem do. A fixed limit would leave out thick stems, so that those with a diameter
#: are too thin on average. With 0.3, a limit of 3 cm is 10 % of the diameter.
THICK = 0.3
NEAREST = 1.0  # m; the weight of a radius is limited to that at this distance


@compiled_borrowing
def add_observations(
    tracks: Rows,
    rows: Int,
    position: Float,
    pose: Float,
    eccentricity: Float,
    radius: Float,
    radius_sigma: Float,
    arc: Float,
    above_breast: Float,
    spacing: float,
) -> None:
    """Add the detections of one scan to the columns of their tracks, in place: hits, sums of eccentricities
    and radii, and observed sides. NaN in eccentricity or radius adds nothing to its sum.

    A radius is converted to breast height, by TAPER from above and by BUTT from below. It is weighted by its
    inverse variance and by the inverse square of its distance: the errors that the sigma of a fit does not
    include, such as the width of a beam, grow with the distance and are the same in every scan, so a hundred
    distant views must not outweigh a few near ones. The weight also decreases with the distance from breast
    height, since the taper of the stem is unknown.

    Args:
        tracks: The tracks.
        rows: Row of the track of each detection, without duplicates, shape (D,).
        position: Positions of the detections in the map, shape (D, 2) [m].
        pose: Pose x, y [m], yaw [rad] of the robot in the map, shape (3,).
        eccentricity, radius, radius_sigma, arc: See `Detections`, shape (D,). The arc is limited to what one
            view can show, see `widest_view`.
        above_breast: Height of the radius above breast height, shape (D,) [m]; NaN where the ground is
            unknown, which counts as HALF with the radius unchanged.
        spacing: Angle between neighbouring returns of the sensor [rad].
    """
    for d in range(rows.shape[0]):
        t = rows[d]
        tracks.hits[t] += 1
        if np.isfinite(eccentricity[d]):
            tracks.eccentricity[t] += eccentricity[d]
            tracks.eccentricities[t] += 1
        dx, dy = pose[0] - position[d, 0], pose[1] - position[d, 1]
        if np.isfinite(radius[d]):
            reach = max(np.hypot(dx, dy), NEAREST)
            # Of a near tree the height band shows mainly the thicker foot, so that the mean height of the
            # cluster is below breast height.
            is_known = np.isfinite(above_breast[d])
            above = above_breast[d] if is_known else 0.0
            weight = 1.0 / ((radius_sigma[d] * reach) ** 2 * (1.0 + (above / HALF) ** 2))
            lost = (TAPER if above >= 0.0 else BUTT) * above
            tracks.radius[t] += weight * (radius[d] + lost)
            tracks.radius_weight[t] += weight
            tracks.radius_reach[t] += weight * reach
            tracks.radius_spacing[t] += weight * spacing * reach
            tracks.radius_above[t] += weight * (abs(above) if is_known else HALF)
            tracks.radii[t] += 1
        # A view without a fitted circle takes the radius of the other views.
        mean_radius = tracks.radius[t] / max(tracks.radius_weight[t], 1e-300)
        widest = widest_view(radius[d] if np.isfinite(radius[d]) else mean_radius, np.hypot(dx, dy))
        tracks.sides[t] |= seen_sides(np.arctan2(dy, dx), min(arc[d], widest))


@compiled_borrowing
def widest_view(radius: float, distance: float) -> float:
    """Return the largest part of a round stem that one view can show, 2 arccos(r / d) [rad].

    It is less than half of the stem. A fit may claim more where noise puts returns behind the axis.

    Args:
        radius: Radius r [m]; 0 for an unknown radius, of which nothing counts.
        distance: Distance d from the sensor to the axis [m]; inside the stem the result is 0.
    """
    return 2.0 * np.arccos(min(radius / distance, 1.0)) if radius > 0.0 and distance > 0.0 else 0.0


@compiled_borrowing
def seen_sides(from_bearing: float, arc: float) -> np.int64:
    """Return the bits of the sectors around a trunk that a view shows as a whole. Bit k is the sector from 10
    k to 10 (k + 1) degrees; a sector that the view shows in part does not count.

    Args:
        from_bearing: Direction from the trunk to the sensor, frame of the map [rad].
        arc: Visible arc around that direction [rad].
    """
    first = int(np.ceil((from_bearing - arc / 2) / WIDTH - 1e-9))
    last = int(np.floor((from_bearing + arc / 2) / WIDTH + 1e-9))
    count, begin = max(min(last - first, SECTORS), 0), first % SECTORS
    run = (np.int64(1) << np.int64(count)) - np.int64(1)
    return ((run << np.int64(begin)) | (run >> np.int64(SECTORS - begin))) & ALL_SIDES


class FigureLimits(NamedTuple):
    """Parameters of the attributes in the tree table, see `Tracking`.

    Attributes:
        hits_to_confirm: Minimum number of detections of a tree without a class of a voxel column.
        confirm_ns: Minimum time between the first and the last detection of such a tree [ns].
        dbh_arc_min: Minimum observed arc for a diameter [rad].
        dbh_sigma_max: Maximum standard deviation of a diameter up to THICK [m].
        out_of_round: Standard deviation of the diameters of a stem in all directions, as a fraction of the
            DBH.
        taper_sigma: Standard deviation of the taper, change of the diameter per height [m/m].
    """

    hits_to_confirm: int
    confirm_ns: int
    dbh_arc_min: float
    dbh_sigma_max: float
    out_of_round: float
    taper_sigma: float


def limits_of(p: Tracking) -> FigureLimits:
    """Return the limits by the parameters of the tracker."""
    return FigureLimits(
        p.hits_to_confirm, round(p.confirm_time * SECOND_NS), np.radians(p.dbh_arc_min), p.dbh_sigma_max,
        p.out_of_round, p.taper_sigma,
    )  # fmt: skip


@compiled
def table_figures(tracks: Rows, limits: FigureLimits) -> tuple[Float, Float, Float, Float, Float, Bool]:
    """Return the attributes of all tracks for the tree table, each of shape (T,).

    Returns:
        Observed arc [rad]; DBH [m]; its standard deviation [m]; standard deviation of each coordinate of the
        centre by the shape of the stem [m], see `shape_sigma`; mean eccentricity; and which tracks are trees,
        see `is_confirmed`. DBH and its standard deviation are NaN where `diameter` has none, the eccentricity
        is NaN without a finite one.
    """
    T = tracks.sides.shape[0]
    coverage, dbh, dbh_sigma, mean = np.empty(T), np.empty(T), np.empty(T), np.full(T, np.nan)
    centre_sigma, confirmed = np.empty(T), np.empty(T, np.bool_)
    _fill_figures(tracks, limits, coverage, dbh, dbh_sigma, centre_sigma, mean, confirmed)
    return coverage, dbh, dbh_sigma, centre_sigma, mean, confirmed


@compiled_borrowing
def _fill_figures(
    tracks: Rows,
    limits: FigureLimits,
    coverage: Float,
    dbh: Float,
    dbh_sigma: Float,
    centre_sigma: Float,
    mean: Float,
    confirmed: Bool,
) -> None:
    """Write the results of `table_figures` into the arrays after `limits`, shape (T,), in place; `mean`,
    which contains NaN before, is written for tracks with an eccentricity."""
    for t in range(tracks.sides.shape[0]):
        coverage[t] = sides_of(tracks.sides[t]) * WIDTH
        dbh[t], dbh_sigma[t] = diameter(tracks, t, coverage[t], limits)
        centre_sigma[t] = shape_sigma(tracks.radius[t], tracks.radius_weight[t], coverage[t], limits)
        if tracks.eccentricities[t] > 0:
            mean[t] = tracks.eccentricity[t] / tracks.eccentricities[t]
        confirmed[t] = is_confirmed(tracks, t, limits)


@compiled_borrowing
def one_sidedness(coverage: float, order: int) -> float:
    """Return the mean of cos(order b) over views in directions b that show an observed arc [rad] together: 1
    for one view. From all around it is 0 in the second order, and 0.5, an upper bound, in the first."""
    w = min(order * 0.5 * max(coverage - ONE_VIEW, 0.0), np.pi)
    return np.sin(w) / w if w > 0.0 else 1.0


@compiled_borrowing
def shape_sigma(radius: float, weight: float, coverage: float, limits: FigureLimits) -> float:
    """Return the standard deviation of each coordinate of the centre of a stem because it is not round [m]; 0
    without a radius.

    Args:
        radius, weight: Weighted sum of the radii [m], and the sum of the weights.
        coverage: Observed arc [rad].
        limits: See FigureLimits.
    """
    if not weight > 0.0:
        return 0.0
    return CENTRE_GAIN * limits.out_of_round * radius / weight * one_sidedness(coverage, 1)


@compiled_borrowing
def sides_of(bits: int) -> int:
    """Return the number of observed sectors: the number of set bits of a mask without sign."""
    seen = 0
    while bits:
        bits &= bits - 1  # clears the lowest bit
        seen += 1
    return seen


@compiled_borrowing
def is_confirmed(tracks: Rows, t: int, limits: FigureLimits) -> bool:
    """Return whether the track in row t is a tree: by the class of its voxel column if it has one, else by
    the number of its detections, the time between the first and the last one, and a positive score (hits
    minus misses)."""
    if tracks.verdict[t] >= 0:
        return bool(tracks.verdict[t] == Verdict.TREE)
    seen_ns = tracks.stamp_ns[t] - tracks.first_ns[t]
    is_seen = tracks.hits[t] >= limits.hits_to_confirm and seen_ns >= limits.confirm_ns
    return bool(is_seen and tracks.score[t] > 0.0)


@compiled_borrowing
def diameter(tracks: Rows, t: int, coverage: float, limits: FigureLimits) -> tuple[float, float]:
    """Return DBH [m] and its standard deviation [m] of the tree in row t; both NaN with fewer than
    DBH_OBSERVATIONS radii, an observed arc below `limits.dbh_arc_min`, a diameter below RESOLVED distances
    between returns at the mean distance of the views, or a standard deviation above `limits.dbh_sigma_max`
    (in proportion to D for D > THICK).

    For a diameter D of n views at distances r, with a mean distance |h| from breast height:

    sigma^2 = 4 (sigma_views^2 / n + (EDGE b + UNEVEN)^2) + (out_of_round D)^2 (1 + (RADIUS_GAIN f)^2)
              + (taper_sigma |h|)^2

    where b is the larger of BEAM r and half the distance between returns, and f the `one_sidedness` of the
    views in the second order. The last three terms do not shrink with n: all views share the edges, the shape
    and the foot of the tree. The weights by height also widen sigma_views, so that the sigma is conservative.

    Args:
        tracks: The tracks.
        t: Row.
        coverage: Observed arc [rad].
        limits: See FigureLimits.
    """
    if not (tracks.radii[t] >= DBH_OBSERVATIONS and coverage >= limits.dbh_arc_min - 1e-9):
        return np.nan, np.nan
    weight = tracks.radius_weight[t]
    reach, above = tracks.radius_reach[t] / weight, tracks.radius_above[t] / weight
    dbh = 2.0 * tracks.radius[t] / weight
    spacing = tracks.radius_spacing[t] / weight
    if dbh < RESOLVED * spacing:
        return np.nan, np.nan
    edge = EDGE * max(BEAM * reach, 0.5 * spacing)
    views = 1.0 / (weight * reach * reach) + (edge + UNEVEN) ** 2
    shape = 1.0 + (RADIUS_GAIN * one_sidedness(coverage, 2)) ** 2
    stem = (limits.out_of_round * dbh) ** 2 * shape + (limits.taper_sigma * above) ** 2
    sigma = np.sqrt(4.0 * views + stem)
    if sigma > limits.dbh_sigma_max * max(1.0, dbh / THICK):
        return np.nan, np.nan
    return dbh, sigma
