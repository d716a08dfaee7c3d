"""The landmarks of one particle: sharpened, joined where two stand for one tree, and given up."""

from __future__ import annotations

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Bool, Float32, Int, Int32

VARIANCE_MIN = 1e-4  # m^2; views of one trunk share an error of about a centimetre


@compiled
def kalman_update(m: Float, Sigma: Float, z: Float, R: Float, looks: float) -> None:
    """m, Sigma of a resting landmark after measuring its position z with covariance R (xx, xy, yy).

    Successive views of a trunk share their error, so Sigma never falls below R / looks.
    """
    a, b, d = Sigma[0] + R[0], Sigma[1] + R[1], Sigma[2] + R[2]  # S = Sigma + R, H = I
    det = a * d - b * b
    k00 = (Sigma[0] * d - Sigma[1] * b) / det  # K = Sigma S^-1
    k01 = (Sigma[1] * a - Sigma[0] * b) / det
    k10 = (Sigma[1] * d - Sigma[2] * b) / det
    k11 = (Sigma[2] * a - Sigma[1] * b) / det
    y0, y1 = z[0] - m[0], z[1] - m[1]
    m[0] += k00 * y0 + k01 * y1
    m[1] += k10 * y0 + k11 * y1
    # K R is (I - K) Sigma for K = Sigma S^-1, and stays positive in floating point.
    xx = k00 * R[0] + k01 * R[1]
    xy = 0.5 * (k00 * R[1] + k01 * R[2] + k10 * R[0] + k11 * R[1])
    yy = k10 * R[1] + k11 * R[2]
    Sigma[0], Sigma[1], Sigma[2] = (
        max(xx, VARIANCE_MIN, R[0] / looks),
        xy,
        max(yy, VARIANCE_MIN, R[2] / looks),
    )


@compiled
def merge_duplicates(
    mean: Float,
    covariance: Float,
    hits: Int32,
    score: Float32,
    birth: Int,
    near: Int,
    seen: Bool,
    gate: float,
) -> None:
    """Join each landmark that was seen with those nearby that were not, where both may be one tree.

    Two that this scan sees are two. Of two that are one the older keeps its birth; the other one is
    left without score, to be removed.
    """
    for j in near:
        if not seen[j]:
            continue
        for k in near:
            if seen[k] or score[k] <= 0.0:
                continue
            a = covariance[j, 0] + covariance[k, 0]
            b = covariance[j, 1] + covariance[k, 1]
            d = covariance[j, 2] + covariance[k, 2]
            y0, y1 = mean[k, 0] - mean[j, 0], mean[k, 1] - mean[j, 1]
            if y0 * y0 + y1 * y1 > gate * gate * (a + d):  # the trace bounds the larger eigenvalue
                continue
            det = a * d - b * b
            if d * y0 * y0 - 2.0 * b * y0 * y1 + a * y1 * y1 > gate * gate * det:
                continue
            kalman_update(mean[j], covariance[j], mean[k].copy(), covariance[k].copy(), 1e9)
            hits[j] += hits[k]
            score[j] = max(score[j], score[k])
            birth[j] = min(birth[j], birth[k])
            score[k] = 0.0


@compiled
def remove_gone(
    mean: Float,
    covariance: Float,
    hits: Int32,
    score: Float32,
    birth: Int,
    count: Int32,
    p: int,
    near: Int,
) -> None:
    """Take away landmarks without score; the last one moves to the free place."""
    for i in range(near.shape[0] - 1, -1, -1):
        j = near[i]
        if score[j] <= 0.0:
            last = count[p] - 1
            mean[j], covariance[j] = mean[last], covariance[last]
            hits[j], score[j], birth[j] = hits[last], score[last], birth[last]
            count[p] = last
