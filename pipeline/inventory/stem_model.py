"""Stem model: position, lean, taper and diameter of a stem by its slices, and its verdict."""

from __future__ import annotations

from typing import Final

import numpy as np

from pipeline.detection.verdicts import Check
from pipeline.geometry.poses import Float
from pipeline.inventory.cross_sections import STEP, Slices, without_scatter
from pipeline.inventory.stem_tracing import BREAST, lines
from pipeline.jit import compiled
from pipeline.types.records import Bool, Int32, Verdict

_MIN: Final = "at least"
_MAX: Final = "at most"

LOCAL = 1.2  # m above and below breast height in which the taper is nearly constant
CLOSE = 0.5  # m; largest distance of a slice from breast height for a diameter
MODEL = 0.003  # m; deviation of a trunk from a circle
LEAST_HIGH, LEAST_SLICES = 1.2, 8  # least height of a stem [m], and least number of slices
BEGINS_BELOW = 2.2  # m; a stem begins below this height
FILLED = 0.7  # least share of the slices between the lowest and the highest with a circle
# Largest scatter of the points and unevenness of the slices, as shares of the radius, and offset of the
# centres from the axis, as a share of the radius and in m. They apply to a stem of `USUAL` slices and grow
# with the number of slices.
ROUGH, UNEVEN, CROOKED, WOBBLE = 0.2, 0.08, 0.2, 0.04
USUAL, FORGIVEN = 15.0, (0.8, 1.4)
LEAST_CONTRAST = 2.5  # ratio of densities on the surface and next to it; uniform points give 1 to 1.5
LEAST_POINTS = 14  # median points on a circle; with fewer, chance places circles above one another
UNSURE = 0.08  # largest sigma of the radius as a share of it
LEAN = np.radians(25.0)
WIDENS, NARROWS = 0.015, -0.03  # m of radius per metre of height, over the whole stem
(X, Y, LEAN_X, LEAN_Y, RADIUS, TAPER, VAR_X, VAR_Y, SIGMA_R, COVERAGE, FIRST, LAST, SLICES, SCATTER, SPREAD,
 EVEN, NEAR, TAPER_ALL, POINTS, CONTRAST) = range(20)  # fmt: skip
COLUMNS = 20


@compiled
def describe_stems(slices: Float, height: Float) -> Float:
    """Return the model of each stem, shape (K, COLUMNS), columns as named by the constants X to CONTRAST.
    Position and radius are those at breast height [m]. A stem with circles in fewer than two slices has NaN
    in all columns except the number of slices.

    Args:
        slices: Result of `follow`, shape (K, S, FIGURES).
        height: Heights of the slices, shape (S,) [m].
    """
    out = np.full((slices.shape[0], COLUMNS), np.nan)
    for s in range(slices.shape[0]):
        there = np.isfinite(slices[s, :, 2])
        n = np.count_nonzero(there)
        out[s, 12] = n
        if n < 2:
            continue
        rows, h = slices[s][there], height[there]
        near = np.abs(h - BREAST) <= LOCAL
        if np.count_nonzero(near) < 3:
            # The stem is only visible higher up or lower down: use the slices nearest to breast height.
            order = np.argsort(np.abs(h - BREAST))
            near[order[:5]] = True
        local, at = rows[near], h[near]
        weight = local[:, 8] * np.exp(-(((at - BREAST) / 0.8) ** 2)) + 1e-3
        x, lean_x, sigma_x, _ = lines(at, local[:, 0], weight)
        y, lean_y, sigma_y, _ = lines(at, local[:, 1], weight)
        r, taper, sigma_r, _ = lines(at, local[:, 2], weight)
        out[s, 0], out[s, 1], out[s, 2], out[s, 3], out[s, 4], out[s, 5] = x, y, lean_x, lean_y, r, taper
        # Neighbours share half of their points; the sigma of the fit is that of a single slice.
        floor = np.median(local[:, 3] + local[:, 5]) / (2.0 * local.shape[0]) + MODEL * MODEL
        out[s, 6], out[s, 7] = 2.0 * sigma_x**2 + floor, 2.0 * sigma_y**2 + floor
        out[s, 8] = np.sqrt(2.0 * sigma_r**2 + np.median(local[:, 6]) / local.shape[0] + MODEL * MODEL)
        out[s, 9] = np.median(local[:, 8])
        out[s, 10], out[s, 11] = h.min(), h.max()
        out[s, 13], out[s, 18] = np.median(rows[:, 7]), np.median(rows[:, 9])
        out[s, 19] = np.median(rows[:, 10])
        _evenness(rows, h, out[s])
        out[s, 16] = np.abs(at - BREAST).min()
    return out


@compiled
def _evenness(rows: Float, h: Float, out: Float) -> None:
    """Write into `out` the median distances of the centres from a straight axis and of the radii from a cone
    [m], and the change of the radius per metre of height.

    Args:
        rows: Circles of a stem, shape (M, FIGURES).
        h: Their heights, shape (M,) [m].
        out: Model of the stem, shape (COLUMNS,), modified in place.
    """
    even = np.ones(h.shape[0])
    off_x = rows[:, 0].copy()
    off_y, off_r = rows[:, 1].copy(), rows[:, 2].copy()
    for column in (off_x, off_y, off_r):
        a, b, _, _ = lines(h, column, even)
        column -= a + b * (h - BREAST)
        out[17] = b
    out[14] = np.median(np.hypot(off_x, off_y))
    out[15] = np.median(np.abs(off_r))


def classify_stems(stems: Float, r_min: float, r_max: float) -> Int32:
    """Return the verdict of each stem, int32, shape (K,): that of the first of its checks that fails, else
    TREE; TOO_FEW_POINTS for a stem without a radius (NaN).

    Args:
        stems: Result of `describe_stems`.
        r_min, r_max: Minimum and maximum radius of a tree [m].
    """
    verdict = np.full(len(stems), Verdict.TREE, np.int32)
    for check in reversed(stem_checks(stems, r_min, r_max)):  # the first check that fails is written last
        verdict[check.fails] = check.verdict
    return verdict


def stem_checks(stems: Float, r_min: float, r_max: float) -> tuple[Check, ...]:
    """Return the checks of `classify_stems` in their order, with all values and limits, as an explanation.
    Limits that differ from stem to stem are 1, and the values are shares of them."""
    r, slices = stems[:, RADIUS], stems[:, SLICES]
    span = stems[:, LAST] - stems[:, FIRST]
    taper, lean = stems[:, TAPER_ALL], np.hypot(stems[:, LEAN_X], stems[:, LEAN_Y])
    often = np.clip(slices / USUAL, *FORGIVEN)
    every = span / STEP + 1.0
    points, first = stems[:, POINTS], stems[:, FIRST]
    few = ~np.isfinite(r) | (points < LEAST_POINTS)
    checks = [
        Check(Verdict.TOO_FEW_POINTS, "points per circle", "", points, _MIN, LEAST_POINTS, "", few),
        Check(Verdict.TOO_THIN, "radius", "m", r, _MIN, r_min, "detection.radius_min", r < r_min),
        Check(Verdict.TOO_THICK, "radius", "m", r, _MAX, r_max, "detection.radius_max", r > r_max),
        Check(Verdict.TOO_LOW, "traced height", "m", span, _MIN, LEAST_HIGH, "", span < LEAST_HIGH),
        Check(Verdict.TOO_LOW, "slices", "", slices, _MIN, LEAST_SLICES, "", slices < LEAST_SLICES),
        Check(Verdict.OTHER, "lowest slice", "m", first, _MAX, BEGINS_BELOW, "", first > BEGINS_BELOW),
        Check(Verdict.BUSH, "share of slices", "", slices / every, _MIN, FILLED, "", slices < FILLED * every),
    ]
    for figure, value, limit in (
        ("scatter of the points", stems[:, SCATTER], often * np.maximum(ROUGH * r, 0.01)),
        ("unevenness of the radii", stems[:, EVEN], often * np.maximum(UNEVEN * r, 0.008)),
        ("offset from a straight axis", stems[:, SPREAD], often * np.maximum(WOBBLE, CROOKED * r)),
        ("sigma of the radius", stems[:, SIGMA_R], UNSURE * r + MODEL),
    ):
        name = f"{figure}, share of the limit"
        checks.append(Check(Verdict.NOT_ROUND, name, "", value / limit, _MAX, 1.0, "", value > limit))
    contrast, leans = stems[:, CONTRAST], lean > np.tan(LEAN)
    lean_deg = np.degrees(np.arctan(lean))
    return (
        *checks,
        Check(Verdict.BUSH, "radius gained per metre", "m", taper, _MAX, WIDENS, "", taper > WIDENS),
        Check(Verdict.BUSH, "radius lost per metre", "m", -taper, _MAX, -NARROWS, "", taper < NARROWS),
        Check(Verdict.BUSH, "contrast", "", contrast, _MIN, LEAST_CONTRAST, "", contrast < LEAST_CONTRAST),
        Check(Verdict.OTHER, "lean", "deg", lean_deg, _MAX, float(np.degrees(LEAN)), "", leans),
    )


def diameters(stems: Float, arc_min: float) -> tuple[Float, Float]:
    """Return diameter at breast height and its sigma [m], shape (K,) each.

    Both are NaN for a stem whose visible arc is less than `arc_min`, with fewer than three slices, without a
    slice within CLOSE of breast height, or with a sigma of the diameter above half of the radius.

    The diameter is measured across the axis: a level slice of a trunk with lean theta is an ellipse, wider by
    1 / cos theta along the lean, and the circle through it has the mean of both. The bias by the scatter of
    the points is subtracted, see `without_scatter`.

    Args:
        stems: Result of `describe_stems`.
        arc_min: Least visible arc [rad].
    """
    known = (stems[:, COVERAGE] >= arc_min) & (stems[:, NEAR] <= CLOSE) & (stems[:, SLICES] >= 3)
    known &= 2.0 * stems[:, SIGMA_R] < 0.5 * stems[:, RADIUS]
    across = 2.0 / (1.0 + np.sqrt(1.0 + stems[:, LEAN_X] ** 2 + stems[:, LEAN_Y] ** 2))
    radius = without_scatter(stems[:, RADIUS], stems[:, SCATTER])
    dbh, sigma = 2.0 * across * radius, 2.0 * stems[:, SIGMA_R]
    return np.where(known, dbh, np.nan), np.where(known, sigma, np.nan)


def is_repeated(stems: Float, verdict: Int32) -> Bool:
    """Return which stems are duplicates, shape (K,): of stems at the same place, the trees come first, then
    those with more slices, then the earlier ones; the others are repeated. A stem whose position is unknown
    (NaN) is not repeated.

    Args:
        stems: Result of `describe_stems`, shape (K, COLUMNS); where there is no model, X and Y may be known.
        verdict: Result of `classify_stems`, shape (K,).
    """
    order = np.lexsort((np.arange(len(stems)), -stems[:, SLICES], verdict != Verdict.TREE))
    order = order[np.isfinite(stems[order, X])]
    again = np.zeros(len(stems), np.bool_)
    again[order] = _again(np.nan_to_num(stems[order]), verdict[order] == Verdict.TREE)
    return again


@compiled
def _again(stems: Float, tree: Bool) -> Bool:
    """Return whether each stem is at the place of an earlier one that is not repeated itself, shape (K,).

    Args:
        stems: Models in the order of precedence, without NaN, shape (K, COLUMNS).
        tree: Whether each is a tree; a tree is repeated only within the radius of the earlier stem, another
            stem also next to it.
    """
    again = np.zeros(stems.shape[0], np.bool_)
    for i in range(stems.shape[0]):
        for j in range(i):
            if again[j]:
                continue
            # At the middle of the heights that both have, else half-way between them.
            low, high = max(stems[i, 10], stems[j, 10]), min(stems[i, 11], stems[j, 11])
            at = 0.5 * (low + high) - BREAST
            dx = stems[i, 0] - stems[j, 0] + at * (stems[i, 2] - stems[j, 2])
            dy = stems[i, 1] - stems[j, 1] + at * (stems[i, 3] - stems[j, 3])
            near = max(stems[j, 4], 0.05) if tree[i] else max(stems[i, 4], stems[j, 4]) + 0.1
            if dx * dx + dy * dy < near * near:
                again[i] = True
                break
    return again


def middles(slices: Slices) -> Float:
    """Return the heights above the ground of the middles of all slices, shape (S,) [m]."""
    return Slices.middle(np.arange(slices.count))
