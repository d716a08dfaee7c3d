"""Half-normal distance sampling: the probability that a tree is found, by the distance from which it was in
view (Buckland et al. 2001; Astrup et al. 2014 for laser scanning)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float

LEAST_TREES = 20
# Gain of the log-likelihood over constant detection that the half-normal model needs (chi-square, one degree
# of freedom, 5 %). Without this rule a complete map would be corrected upwards by the noise of the fit.
GAIN = 1.92


@dataclass(frozen=True, slots=True)
class DetectionFunction:
    """Probability of detection g(r) = exp(-r^2 / (2 sigma^2)).

    Attributes:
        sigma: Scale [m]; inf if detection does not decrease with distance.
        sigma_se: Standard error of `sigma` [m]; 0 for inf.
        trees: Number of trees of the fit.
    """

    sigma: float
    sigma_se: float
    trees: int

    def at(self, distance: Float) -> Float:
        """Return the probability at distances [m], in their shape; 1 for an infinite `sigma`, NaN for a
        distance of NaN."""
        return (
            np.exp(-0.5 * np.square(distance / self.sigma)) if math.isfinite(self.sigma) else distance * 0 + 1
        )

    def mean(self, available: Float) -> tuple[float, float]:
        """Return the mean probability over an area and its standard error (delta method), 0 for an infinite
        `sigma`; both NaN if `available` is empty.

        Args:
            available: Distance of each cell of the area [m], cells of equal size, shape (K,).
        """
        if not len(available):
            return math.nan, math.nan
        g = self.at(available)
        p = float(g.mean())
        if not math.isfinite(self.sigma):
            return p, 0.0
        slope = float((g * np.square(available)).mean()) / self.sigma**3
        return p, slope * self.sigma_se


CERTAIN = DetectionFunction(math.inf, 0.0, 0)


def fit_half_normal(distance: Float, available: Float) -> DetectionFunction | None:
    """Fit the half-normal function by maximum likelihood, given the distances that the area offers.

    The likelihood of a distance is g(r) A(r) / sum g A, where A(r) is the number of cells at that distance,
    so it holds for plots of any shape. With A(r) proportional to r (one position) the estimate is sigma^2 =
    sum r^2 / (2 n); with constant A(r) (a straight path) it is sum r^2 / n.

    Args:
        distance: Distance of each tree found [m], shape (N,); finite.
        available: Distance of each cell of the area [m], shape (K,); finite.

    Returns:
        The function; sigma is inf if constant detection explains the distances as well, else from 1/20 to 20
        times the largest distance of the area. None if there are fewer than LEAST_TREES trees or no cells.
    """
    from scipy.optimize import minimize_scalar

    n = len(distance)
    if n < LEAST_TREES or not len(available):
        return None
    trees = np.square(distance)
    cells, counts = np.unique(np.round(np.square(available), 3), return_counts=True)
    share = counts / counts.sum()

    def loss(log_sigma: float) -> float:
        k = 0.5 * math.exp(-2.0 * log_sigma)
        return float(k * trees.sum() + n * math.log(float(np.sum(share * np.exp(-k * cells)))))

    farthest = math.sqrt(max(float(cells[-1]), 1e-6))
    bounds = (math.log(farthest / 20.0), math.log(farthest * 20.0))
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-6})
    if -float(found.fun) < GAIN:  # the loss of constant detection is 0
        return DetectionFunction(math.inf, 0.0, n)
    h = 1e-3
    curvature = (loss(found.x + h) - 2.0 * float(found.fun) + loss(found.x - h)) / h**2
    sigma = math.exp(float(found.x))
    se = sigma / math.sqrt(curvature) if curvature > 0.0 else math.inf
    return DetectionFunction(sigma, se, n)
