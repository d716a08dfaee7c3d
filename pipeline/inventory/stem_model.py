"""What a stem is: its place, lean, taper and diameter from its slices, and whether it is a tree at all."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.inventory.circle import without_scatter
from pipeline.inventory.cross_sections import Slices
from pipeline.inventory.stem_tracing import BREAST, lines
from pipeline.jit import compiled
from pipeline.types.records import Bool, Int32, Verdict

LOCAL = 1.2  # m above and below breast height; farther away the taper bends
CLOSE = 0.5  # m; a diameter is told where a slice lies so near to breast height
MODEL = 0.003  # m; what a round trunk leaves out
LEAST_HIGH, LEAST_SLICES = 1.2, 8  # m of height, and slices, that a stem reaches over
HANGS = 2.2  # m; a stem whose lowest slice lies higher hangs from something
FILLED = 0.7  # part of the slices between the lowest and the highest
# Scatter of the points and unevenness of the slices, parts of the radius; middles off the axis, part
# of the radius and m. They hold for a stem of `USUAL` slices: the more there are, the more is forgiven.
ROUGH, UNEVEN, CROOKED, WOBBLE = 0.2, 0.08, 0.2, 0.04
USUAL, FORGIVEN = 15.0, (0.8, 1.4)
LEAST_CONTRAST = 2.5  # times denser on a stem's surface than beside it; evenly strewn points give 1 to 1.5
LEAST_POINTS = 14  # on the circle of a usual slice; with fewer, chance lays circles one above the other
UNSURE = 0.08  # sigma of the radius as a part of it
LEAN = np.radians(25.0)
WIDENS, NARROWS = 0.015, -0.03  # m of radius per metre of height, over the whole stem
(X, Y, LEAN_X, LEAN_Y, RADIUS, TAPER, VAR_X, VAR_Y, SIGMA_R, COVERAGE, FIRST, LAST, SLICES, SCATTER, SPREAD,
 EVEN, NEAR, TAPER_ALL, POINTS, CONTRAST) = range(20)  # fmt: skip
COLUMNS = 20


@compiled
def describe_stems(slices: Float, height: Float) -> Float:
    """The figures of each stem, shape (K, COLUMNS).

    Args:
        slices: shape (K, S, FIGURES), as `follow` gives them; height: of the slices, shape (S,) [m].
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
            # All of it is seen higher up, or lower down: what lies next to breast height.
            order = np.argsort(np.abs(h - BREAST))
            near[order[:5]] = True
        local, at = rows[near], h[near]
        weight = local[:, 8] * np.exp(-(((at - BREAST) / 0.8) ** 2)) + 1e-3
        x, lean_x, sigma_x, _ = lines(at, local[:, 0], weight)
        y, lean_y, sigma_y, _ = lines(at, local[:, 1], weight)
        r, taper, sigma_r, _ = lines(at, local[:, 2], weight)
        out[s, 0], out[s, 1], out[s, 2], out[s, 3], out[s, 4], out[s, 5] = x, y, lean_x, lean_y, r, taper
        # Neighbours share half of their points; the fit's own sigma is what even one slice would leave.
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
    """How far the middles lie off a straight axis [m] and the radii off a cone [m], medians, all slices."""
    even = np.ones(h.shape[0])
    off_x = rows[:, 0].copy()
    off_y, off_r = rows[:, 1].copy(), rows[:, 2].copy()
    for column in (off_x, off_y, off_r):
        a, b, _, _ = lines(h, column, even)
        column -= a + b * (h - BREAST)
        out[17] = b
    out[14] = np.median(np.hypot(off_x, off_y))
    out[15] = np.median(np.abs(off_r))


def judge(stems: Float, r_min: float, r_max: float) -> Int32:
    """The verdict on each stem by its figures alone."""
    verdict = np.full(len(stems), Verdict.TREE, np.int32)
    r, slices = stems[:, RADIUS], stems[:, SLICES]
    span = stems[:, LAST] - stems[:, FIRST]
    taper = stems[:, TAPER_ALL]
    often = np.clip(slices / USUAL, *FORGIVEN)
    rules: list[tuple[Bool, Verdict]] = [
        (np.hypot(stems[:, LEAN_X], stems[:, LEAN_Y]) > np.tan(LEAN), Verdict.OTHER),
        (stems[:, CONTRAST] < LEAST_CONTRAST, Verdict.BUSH),
        ((taper > WIDENS) | (taper < NARROWS), Verdict.BUSH),
        (stems[:, SIGMA_R] > UNSURE * r + MODEL, Verdict.NOT_ROUND),
        (stems[:, SPREAD] > often * np.maximum(WOBBLE, CROOKED * r), Verdict.NOT_ROUND),
        (stems[:, EVEN] > often * np.maximum(UNEVEN * r, 0.008), Verdict.NOT_ROUND),
        (stems[:, SCATTER] > often * np.maximum(ROUGH * r, 0.01), Verdict.NOT_ROUND),
        (slices < FILLED * (span / 0.2 + 1.0), Verdict.BUSH),
        (stems[:, FIRST] > HANGS, Verdict.OTHER),
        ((span < LEAST_HIGH) | (slices < LEAST_SLICES), Verdict.TOO_LOW),
        (r > r_max, Verdict.TOO_THICK),
        (r < r_min, Verdict.TOO_THIN),
        (~np.isfinite(r) | (stems[:, POINTS] < LEAST_POINTS), Verdict.TOO_FEW_POINTS),
    ]
    for refused, why in rules:  # the last word is the plainest reason
        verdict[refused] = why
    return verdict


def diameters(stems: Float, arc_min: float) -> tuple[Float, Float]:
    """Diameter at breast height and its sigma [m], shape (K,), NaN where no arc carries one.

    It is measured across the axis: a level slice of a trunk that leans by theta is an ellipse, wider by
    1 / cos theta along the lean, and the circle through it has the mean of both.

    Args:
        stems: See `describe_stems`.
        arc_min: That must be seen [rad].
    """
    told = (stems[:, COVERAGE] >= arc_min) & (stems[:, NEAR] <= CLOSE) & (stems[:, SLICES] >= 3)
    told &= 2.0 * stems[:, SIGMA_R] < 0.5 * stems[:, RADIUS]
    across = 2.0 / (1.0 + np.sqrt(1.0 + stems[:, LEAN_X] ** 2 + stems[:, LEAN_Y] ** 2))
    radius = without_scatter(stems[:, RADIUS], stems[:, SCATTER])
    dbh, sigma = 2.0 * across * radius, 2.0 * stems[:, SIGMA_R]
    return np.where(told, dbh, np.nan), np.where(told, sigma, np.nan)


def same(stems: Float, verdict: Int32) -> Bool:
    """Which stems are another view of one that comes before them, or of a tree."""
    if len(stems) == 0:
        return np.zeros(0, np.bool_)
    order = np.lexsort((np.arange(len(stems)), -stems[:, SLICES], verdict != Verdict.TREE))
    again = np.zeros(len(stems), np.bool_)
    again[order] = _again(np.nan_to_num(stems[order], nan=1e9), verdict[order] == Verdict.TREE)
    return again


@compiled
def _again(stems: Float, tree: Bool) -> Bool:
    again = np.zeros(stems.shape[0], np.bool_)
    for i in range(stems.shape[0]):
        for j in range(i):
            if again[j]:
                continue
            # Where both were seen, else half-way between them.
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
    """Heights of the middles of all slices [m]."""
    return Slices.middle(np.arange(slices.count))
