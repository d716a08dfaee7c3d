"""Stem model: position, lean, taper and diameter of a stem by its slices, and its verdict."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.extensions.clouds.inventory.cross_sections import STEP, TUKEY, slice_heights, without_scatter
from pipeline.classification.column_extraction import BREAST
from pipeline.classification.features import NAMES
from pipeline.classification.forest import CLASSES
from pipeline.classification.voxel_map import SLICE, SLICES
from pipeline.detection.cylinder_fit import MODEL
from pipeline.detection.verdicts import AT_LEAST, AT_MOST, Check
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Int32, Verdict

LOCAL = 1.0  # m above and below breast height in which the taper is nearly constant
BESIDE = 0.3  # m outside of a stem; bark, root flares and branches form columns here that are no trees
LEAST_HIGH = 1.2  # m; least height of a stem
FILLED = 2.0 / 3.0  # least share of the slices between the lowest and the highest with a circle
STRAIGHT = 0.1  # largest offset from a straight axis and an even taper, as a share of the radius
LONG = 2.4  # m; undergrowth is lower, so that a stem of this traced height needs no votes
LEAST_CONTRAST = 2.5  # ratio of densities on the surface and next to it; uniform points give 1 to 1.5
DOUBTED_CONTRAST = 2.0 * LEAST_CONTRAST  # of a short stem that the votes do not support; chance gives up to 4
WIDENS = 0.02  # m of radius per metre of height; stems become thinner upwards
SURE = 0.5  # share of the votes for pole, person or wall that rejects a stem

TOP, HEADROOM, LOOKED = (NAMES.index(name) for name in ("highest return", "headroom", "looked at up to"))

#: Model of a stem. Position [m], lean (shift per metre of height), radius [m] and taper (change of the radius
#: per metre of height) are those at breast height; `near` is the distance of the nearest slice from it [m].
#: `taper_sigma` is the standard deviation of the taper, `first` and `last` are the heights of the lowest and
#: highest slice [m], `slices` their number. The visible arc `coverage` [rad], `points`, `scatter` [m] and
#: `contrast` are medians over the slices near breast height, see `fit_circle`;
#: `crooked` and `uneven` are the median distances of the centres from a straight axis and of the radii from a
#: cone beyond the errors of the fits [m].
STEM = np.dtype(
    [
        (name, np.float64)
        for name in (
            "x", "y", "lean_x", "lean_y", "radius", "taper", "taper_sigma", "var_x", "var_y", "radius_sigma",
            "near", "first", "last", "slices", "coverage", "points", "scatter", "contrast", "crooked",
            "uneven",
        )
    ]
)  # fmt: skip
Stems = NDArray[Any]  # of the type STEM


@compiled
def fit_line(height: Float, value: Float, weight: Float) -> tuple[float, float, float, float]:
    """Fit a line through values over height robustly. Return the value at breast height, its change per metre
    of height, and the standard deviations of both. A weak prior keeps the slope near 0.

    Args:
        height: Heights above the ground, shape (N,) [m], N at least 1.
        value, weight: Values and their weights, shape (N,); the sum of weights is positive.
    """
    n = height.shape[0]
    a, b, scale = np.median(value), 0.0, 1.0
    saa, sab, sbb = 1.0, 0.0, 1.0
    for turn in range(12):
        off = np.abs(value - a - b * (height - BREAST))
        scale = max(np.median(off) / 0.6745, 0.001)
        saa, sab, sbb, ta, tb = 0.0, 0.0, (scale / 0.1) ** 2, 0.0, 0.0
        for i in range(n):
            u2 = (off[i] / (TUKEY * scale)) ** 2 if turn > 0 else 0.0
            if u2 >= 1.0:
                continue
            w, t = weight[i] * (1.0 - u2) ** 2, height[i] - BREAST
            saa += w
            sab += w * t
            sbb += w * t * t
            ta += w * value[i]
            tb += w * t * value[i]
        D = saa * sbb - sab * sab
        a, b = (sbb * ta - sab * tb) / D, (saa * tb - sab * ta) / D
    D = saa * sbb - sab * sab
    return a, b, scale * np.sqrt(sbb / D), scale * np.sqrt(saa / D)


def describe_stems(circles: Float) -> Stems:
    """Return the model of each stem, STEM of shape (K,). A stem with circles in fewer than two slices has NaN
    in all columns except the number of slices.

    Args:
        circles: Result of `trace`, shape (K, S, FIGURES).
    """
    out = np.full(len(circles), np.nan, STEM)
    height = slice_heights()
    for stem, rows in zip(out, circles, strict=True):
        there = np.isfinite(rows[:, 2])
        stem["slices"] = np.count_nonzero(there)
        if stem["slices"] >= 2:
            _describe(stem, rows[there], height[there])
    return out


def _describe(stem: Any, rows: Float, h: Float) -> None:  # noqa: ANN401 - a row of a structured array
    """Fill all fields of a stem but `slices`, by robust lines through its circles near breast height, or near
    the slices next to it.

    Args:
        stem: Row of the type STEM; changed in place.
        rows: Circles of the stem, shape (N, FIGURES), N at least 2.
        h: Heights of the circles above the ground, shape (N,) [m].
    """
    away = np.abs(h - BREAST)
    # A stem that is only visible higher up or lower down is described by the slices nearest to breast height.
    width = max(LOCAL, 1.5 * float(np.sort(away)[:5][-1]))
    near = away < width
    local, at = rows[near], h[near]
    weight = local[:, 8] * (1.0 - (away[near] / width) ** 2) ** 2
    stem["x"], stem["lean_x"], sigma_x, _ = fit_line(at, local[:, 0].copy(), weight)
    stem["y"], stem["lean_y"], sigma_y, _ = fit_line(at, local[:, 1].copy(), weight)
    stem["radius"], stem["taper"], sigma_r, sigma_t = fit_line(at, local[:, 2].copy(), weight)
    # Neighbours share half of their points; the sigma of the fit is that of a single slice.
    floor = np.median(local[:, 3] + local[:, 5]) / (2.0 * len(local)) + MODEL**2
    stem["var_x"], stem["var_y"] = 2.0 * sigma_x**2 + floor, 2.0 * sigma_y**2 + floor
    stem["radius_sigma"] = np.sqrt(2.0 * sigma_r**2 + np.median(local[:, 6]) / len(local) + MODEL**2)
    stem["taper_sigma"] = np.sqrt(2.0) * sigma_t  # neighbours share half of their points
    stem["near"], stem["first"], stem["last"] = away.min(), h.min(), h.max()
    stem["coverage"] = np.median(local[:, 8])
    stem["scatter"], stem["points"], stem["contrast"] = np.median(local[:, [7, 9, 10]], axis=0)
    axis = np.array([stem["x"], stem["y"], stem["radius"]])
    off = local[:, :3] - axis - (at[:, None] - BREAST) * [stem["lean_x"], stem["lean_y"], stem["taper"]]
    crooked, uneven = np.median(np.hypot(*off[:, :2].T)), np.median(np.abs(off[:, 2]))
    # The error of a single circle is no property of the stem: the median of normal errors is removed.
    by_noise = np.median(0.5 * (local[:, 3] + local[:, 5])), np.median(local[:, 6])
    stem["crooked"] = np.sqrt(max(crooked**2 - 2 * np.log(2.0) * by_noise[0], 0.0))
    stem["uneven"] = np.sqrt(max(uneven**2 - 0.6745**2 * by_noise[1], 0.0))


def classify_stems(stems: Stems, share: Float, r_min: float, r_max: float) -> Int32:
    """Return the verdict of each stem, int32, shape (K,): that of the first of its checks that fails, else
    TREE. A stem without a model (circles in fewer than two slices) has the class of most votes instead,
    NO_ARC in place of TREE.

    Args:
        stems: Result of `describe_stems`.
        share: Shares of the votes of the random forest, in the order of CLASSES, shape (K, 6).
        r_min, r_max: Minimum and maximum radius of a tree [m].
    """
    verdict = np.full(len(stems), Verdict.TREE, np.int32)
    for check in reversed(stem_checks(stems, share, r_min, r_max)):  # the first that fails is written last
        verdict[check.fails] = check.verdict
    unknown = np.isnan(stems["radius"])
    strongest = np.array(CLASSES, np.int32)[share.argmax(axis=1)]
    verdict[unknown] = np.where(strongest == Verdict.TREE, Verdict.NO_ARC, strongest)[unknown]
    return verdict


def stem_checks(stems: Stems, share: Float, r_min: float, r_max: float) -> tuple[Check, ...]:
    """Return the checks of `classify_stems` in their order, with all values and limits, as an explanation:
    radius, height, distance from breast height, slices, contrast, taper, roundness, votes. Limits that differ
    from stem to stem are 1, and the values are shares of them. For a stem without a model all values except
    the votes are NaN.

    Args:
        stems: Result of `describe_stems`, shape (K,).
        share: Shares of the votes of the random forest, in the order of CLASSES, shape (K, 6).
        r_min, r_max: Minimum and maximum radius of a tree [m].
    """
    r, span, contrast = stems["radius"], stems["last"] - stems["first"], stems["contrast"]
    taper = stems["taper"] - stems["taper_sigma"]  # what is sure of it
    upright = share[:, [CLASSES.index(Verdict.TREE), CLASSES.index(Verdict.POLE)]].sum(axis=1)
    doubted = (upright < SURE) & (span < LONG)
    surface = np.minimum(contrast / DOUBTED_CONTRAST, stems["coverage"] / np.pi)
    filled = stems["slices"] / (np.rint(span / STEP) + 1.0)
    checks = [
        Check(Verdict.TOO_THIN, "radius", "m", np.maximum(r, 0.0), AT_LEAST, r_min, "detection.radius_min"),
        Check(Verdict.TOO_THICK, "radius", "m", r, AT_MOST, r_max, "detection.cloud_radius_max"),
        Check(Verdict.TOO_LOW, "traced height", "m", span, AT_LEAST, LEAST_HIGH),
        Check(Verdict.OTHER, "distance of a slice from breast height", "m", stems["near"], AT_MOST, LOCAL),
        Check(Verdict.BUSH, "share of slices", "", filled, AT_LEAST, FILLED),
        Check(Verdict.BUSH, "contrast", "", contrast, AT_LEAST, LEAST_CONTRAST),
        Check(
            Verdict.BUSH,
            "contrast or arc of a short stem without votes, share of the limit",
            "",
            np.where(doubted, surface, np.nan),
            AT_LEAST,
            1.0,
        ),
        Check(Verdict.BUSH, "radius gained per metre", "m", taper, AT_MOST, WIDENS),
    ]
    limit = STRAIGHT * r + MODEL
    for figure, name in (
        ("unevenness of the radii", "uneven"),
        ("offset from a straight axis", "crooked"),
        ("sigma of the radius", "radius_sigma"),
    ):
        share_of_limit = stems[name] / limit
        checks.append(
            Check(Verdict.NOT_ROUND, f"{figure}, share of the limit", "", share_of_limit, AT_MOST, 1.0)
        )
    for kind in (Verdict.POLE, Verdict.PERSON, Verdict.WALL):
        votes = share[:, CLASSES.index(kind)]
        checks.append(Check(kind, f"votes for {kind.label}", "", votes, AT_MOST, SURE))
    return tuple(checks)


def ends_are_seen(stems: Stems, features: Float, r_min: float, r_max: float) -> Bool:
    """Return whether the space above each column was observed, so that the end of a column is the end of an
    object, shape (K,).

    A scanner that does not look up, such as a phone, sees each stem to another height. Where the view ends
    within the heights that the features describe, the headroom above the round stems shows by how much it
    varies: up to three standard deviations, by the median, an end shows nothing. Nearly all stems of a cloud
    that sees the crowns, or that a plane cuts, reach the upper end of the view.

    Args:
        stems: Result of `describe_stems`, shape (K,).
        features: Features of the columns, see `find_columns`, shape (K, COUNT).
        r_min, r_max: Minimum and maximum radius of a tree [m].
    """
    headroom, limited = features[:, HEADROOM], features[:, LOOKED] < SLICES * SLICE - 0.5 * SLICE
    known = limited & np.isfinite(stems["radius"])
    no_votes = np.full((len(stems), len(CLASSES)), SURE)
    for check in stem_checks(stems, no_votes, r_min, r_max):
        known &= ~check.fails
    spread = float(np.median(headroom[known])) / 0.6745 if known.any() else 0.0
    return np.asarray(~limited | (headroom > 3.0 * spread))


def are_stumps(stems: Stems, features: Float, share: Float, r_min: float, r_max: float) -> Bool:
    """Return which candidates are stumps, shape (K,): round as a stem, but the highest return of the column
    is below breast height.

    Args:
        stems: Result of `describe_stems`, shape (K,).
        features: Features of the columns, see `find_columns`, shape (K, COUNT).
        share: Shares of the votes of the random forest, in the order of CLASSES, shape (K, 6).
        r_min, r_max: Minimum and maximum radius of a tree [m].
    """
    stump = (
        np.isfinite(stems["radius"]) & (features[:, TOP] < BREAST) & (stems["contrast"] >= DOUBTED_CONTRAST)
    )
    for check in stem_checks(stems, share, r_min, r_max):
        if check.verdict not in (Verdict.TOO_LOW, Verdict.OTHER, *CLASSES):
            stump &= ~check.fails
    return np.asarray(stump)


def diameters(stems: Stems, arc_min: float) -> tuple[Float, Float]:
    """Return diameter at breast height and its sigma [m], shape (K,) each.

    Both are NaN for a stem whose visible arc is less than `arc_min`, with fewer than three slices, without a
    slice within half of LOCAL of breast height, or with a sigma of the radius from a quarter of the radius
    on.

    The diameter is measured across the axis: a level slice of a trunk with lean theta is an ellipse, wider by
    1 / cos theta along the lean, and the circle through it has the mean of both. The bias by the scatter of
    the points is subtracted, see `without_scatter`.

    Args:
        stems: Result of `describe_stems`.
        arc_min: Minimum visible arc [rad].
    """
    known = (stems["coverage"] >= arc_min) & (stems["near"] <= 0.5 * LOCAL) & (stems["slices"] >= 3)
    known &= stems["radius_sigma"] < 0.25 * stems["radius"]
    across = 2.0 / (1.0 + np.sqrt(1.0 + stems["lean_x"] ** 2 + stems["lean_y"] ** 2))
    radius = without_scatter(stems["radius"], stems["scatter"])
    dbh, sigma = 2.0 * across * radius, 2.0 * stems["radius_sigma"]
    return np.where(known, dbh, np.nan), np.where(known, sigma, np.nan)


def is_repeated(stems: Stems, axes: Float, verdict: Int32) -> Bool:
    """Return which stems are duplicates, shape (K,). Of stems at the same position, one is kept: a tree
    before others, then the one with more slices, then the earlier one.

    Two stems are at the same position if the axis of one is inside of the other at the middle of the heights
    that both have, or half-way between them. A stem without a model (circles in fewer than two slices) is at
    the axis of its column. A stem that is not a tree is also a duplicate up to BESIDE outside of a kept stem.

    Args:
        stems: Result of `describe_stems`, shape (K,).
        axes: Axes of the columns of the stems, see `find_columns`, shape (K, 5).
        verdict: Result of `classify_stems`, shape (K,).
    """
    order = np.lexsort((np.arange(len(stems)), -stems["slices"], verdict != Verdict.TREE))
    known = np.isfinite(stems["radius"])
    columns = ("x", "y", "lean_x", "lean_y", "radius", "first", "last")
    x, y, lean_x, lean_y, radius, first, last = (stems[name].copy() for name in columns)
    for column, of_axis in zip((x, y, lean_x, lean_y), axes.T, strict=False):
        column[~known] = of_axis[~known]
    radius[~known], first[~known], last[~known] = 0.0, BREAST, BREAST
    again = np.zeros(len(stems), np.bool_)
    kept = np.zeros(0, np.int64)
    for i in order:
        at = 0.5 * (np.maximum(first[i], first[kept]) + np.minimum(last[i], last[kept])) - BREAST
        dx = x[i] - x[kept] + at * (lean_x[i] - lean_x[kept])
        dy = y[i] - y[kept] + at * (lean_y[i] - lean_y[kept])
        reach = np.maximum(radius[i], radius[kept]) + (0.0 if verdict[i] == Verdict.TREE else BESIDE)
        again[i] = (dx * dx + dy * dy < reach * reach).any()
        if not again[i]:
            kept = np.append(kept, i)
    return again
