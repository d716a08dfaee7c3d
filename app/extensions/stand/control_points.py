"""The position of a map in a coordinate reference system from points that are known in both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.extensions.stand import POINT_SIGMA
from pipeline.errors import StemmapError
from pipeline.evaluation import fit_rigid
from pipeline.geometry.poses import Float, Pose2

# A set of control points contradicts itself if its residuals exceed this number of standard deviations.
CONTRADICTION = 4.0
# A scale beyond this difference from 1 is another unit or another set of points.
SCALE = 0.02
SPREAD_MIN = 0.5  # m


@dataclass(frozen=True, slots=True, eq=False)
class ControlFit:
    """Rigid motion from the map to a reference system, fitted by least squares.

    Attributes:
        pose: T_crs_map, pose of the map in the reference system.
        residuals: Known minus transformed position of each point, shape (N, 2) [m].
        rms: Root mean square length of the residuals [m].
        sigma_point: Standard deviation of one coordinate of a point, from the residuals with 2 N - 3 degrees
            of freedom [m].
        sigma: Standard deviation of a coordinate of a position at the centre of the points [m].
        sigma_turn: Standard deviation of the rotation [rad]; inf if all points are at one position in the
            map.
    """

    pose: Pose2
    residuals: Float
    rms: float
    sigma_point: float
    sigma: float
    sigma_turn: float


def fit_control_points(
    local: Float, known: Float, *, names: Sequence[str] = (), point_sigma: float = POINT_SIGMA
) -> ControlFit:
    """Fit the pose of the map to control points.

    Args:
        local: Positions in the map, shape (N, 2) [m].
        known: The same points in the reference system: east, north, shape (N, 2) [m].
        names: Names of the points, for messages; by default their numbers.
        point_sigma: Expected standard deviation of a coordinate [m]. A fit whose `sigma_point` is more than
            CONTRADICTION times this is refused; so are four or more points of which the fit of the others
            excludes one.

    Raises:
        StemmapError: There are fewer than two points, they are at one position in either frame (RMS distance
            from their mean below SPREAD_MIN), or they contradict one another: in their scale, the order of
            their axes, or their residuals. The message names the cause.
    """
    n = len(local)
    if n < 2:
        raise StemmapError(f"{n or 'no'} control {'point is' if n == 1 else 'points are'} too few",
                           remedy="Give two or more points")  # fmt: skip
    names = list(names) or [str(k + 1) for k in range(n)]
    a, b = local - local.mean(axis=0), known - known.mean(axis=0)
    spread_a, spread_b = (float(np.sqrt(np.square(v).sum(axis=1).mean())) for v in (a, b))
    if min(spread_a, spread_b) < SPREAD_MIN:
        raise StemmapError(
            "the control points are at one place", remedy="Give points that are far from one another"
        )
    fit = fit_rigid_pairs(local, known)
    allowed = CONTRADICTION * point_sigma
    every = range(n if n > 2 else 0)  # one point has no fit
    rest = [fit_rigid_pairs(np.delete(local, k, axis=0), np.delete(known, k, axis=0)) for k in every]
    if fit.sigma_point <= allowed and not _has_outlier(local, known, rest, point_sigma):
        return fit
    if fit_rigid_pairs(a, b[:, ::-1]).sigma_point <= min(allowed, 0.2 * fit.sigma_point) and n > 2:
        raise StemmapError(
            "east and north of the control points seem to be exchanged", remedy="Exchange the two columns"
        )
    scaled = fit_rigid_pairs(a, b * spread_a / spread_b)
    if abs(spread_b / spread_a - 1.0) > SCALE and scaled.sigma_point <= min(allowed, 0.2 * fit.sigma_point):
        raise StemmapError(
            f"distances between the control points are {spread_b / spread_a:.3f} times those in the map",
            remedy="Check their unit, which is metres, and which tree each point is",
        )
    text = f"the control points contradict one another: {fit.rms:.2f} m (RMS)"
    if n == 2:
        raise StemmapError(text, remedy="Check which tree each point is, and its coordinates")
    sigmas = np.array([each.sigma_point for each in rest])
    best = int(np.argmin(sigmas))
    if sigmas[best] > allowed:
        raise StemmapError(
            f"{text}, and no single point explains it; {_residual_words(fit.residuals, names)}",
            remedy="Check which tree each point is, and its coordinates",
        )
    residuals = known - rest[best].pose.apply(local)
    # Two points that agree within their expected error are equally suspect: three points can leave two.
    suspects = [names[k] for k in np.flatnonzero(sigmas <= max(point_sigma, sigmas[best]))]
    text += f"; without point {names[best]} {rest[best].rms:.2f} m, {_residual_words(residuals, names)}"
    which = (
        f"point {suspects[0]}" if len(suspects) == 1 else f"the points {', '.join(suspects)}: one is wrong"
    )
    raise StemmapError(text, remedy=f"Check {which}; which tree it is, and its coordinates")


def _has_outlier(local: Float, known: Float, rest: Sequence[ControlFit], point_sigma: float) -> bool:
    """Return whether the fit of the others excludes one of four or more points: it lies CONTRADICTION
    standard deviations away, with the expected deviation, or with that of the others where it is larger.

    A residual beyond k standard deviations in the plane has the probability p = exp(-k^2 / 2). With a
    deviation estimated with f degrees of freedom, its square has an F distribution with 2 and f degrees of
    freedom, whose quantile is (f / 2) (p^(-2 / f) - 1).

    Args:
        local, known: The points, as in `fit_control_points`.
        rest: The fit without each point.
        point_sigma: Expected standard deviation of a coordinate of a point [m].
    """
    others = len(local) - 1
    if others < 3:
        return False  # two points fit always
    freedom = 2 * others - 3
    quantile = 0.5 * freedom * (math.exp(CONTRADICTION**2 / freedom) - 1.0)
    for k, fit in enumerate(rest):
        without = np.delete(local, k, axis=0)
        centre = without.mean(axis=0)
        spread = max(float(np.square(without - centre).sum()), SPREAD_MIN**2)
        variance = 1.0 + 1.0 / others + float(np.square(local[k] - centre).sum()) / spread
        if fit.sigma_point <= point_sigma:
            allowed = (CONTRADICTION * point_sigma) ** 2
        else:
            allowed = 2.0 * quantile * fit.sigma_point**2
        if float(np.square(known[k] - fit.pose.apply(local[k])).sum()) > allowed * variance:
            return True
    return False


def _residual_words(residuals: Float, names: Sequence[str]) -> str:
    """Return a text with the lengths [m] of the six largest residuals, shape (N, 2) [m], and the names of
    their points, the largest first."""
    shown = 6  # points in a message
    lengths = np.hypot(*residuals.T)
    largest = np.argsort(-lengths, kind="stable")[:shown]
    return "residuals " + ", ".join(f"{names[k]}: {lengths[k]:.2f} m" for k in largest)


def fit_rigid_pairs(local: Float, known: Float) -> ControlFit:
    """Return the fit of two or more pairs of points, without any check. Points that are all at one position
    in the map give the rotation 0 with the standard deviation inf.

    Args:
        local: Positions in the map, shape (N, 2) [m].
        known: The same points in the other frame, shape (N, 2) [m].
    """
    n, pose = len(local), fit_rigid(local, known)
    residuals = known - pose.apply(local)
    squares = float(np.square(residuals).sum())
    sigma = math.sqrt(squares / max(2 * n - 3, 1))
    spread = math.sqrt(float(np.square(local - local.mean(axis=0)).sum()))
    return ControlFit(
        pose,
        residuals,
        math.sqrt(squares / n),
        sigma,
        sigma / math.sqrt(n),
        sigma / spread if spread > 0.0 else math.inf,
    )
