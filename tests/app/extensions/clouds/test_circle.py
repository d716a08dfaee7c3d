"""Circle fit of slices: the effects of scatter and lean on a diameter are removed."""

from __future__ import annotations

import numpy as np
import pytest

from app.extensions.clouds.inventory import map_plot
from app.extensions.clouds.inventory.cross_sections import FIGURES, best_circle, fit_circle, without_scatter
from pipeline.config import preset
from tests.app.extensions.clouds.made import Made
from tests.pipeline.plots import ground, stem


def fitted(xy):
    """The figures of the circle through points of a slice."""
    circle = np.zeros(FIGURES)
    assert best_circle(xy, 0.03, 0.03, 0.6, circle) > 0.0
    assert fit_circle(xy, 0.1, 0.03, 0.6, circle)
    return circle


@pytest.mark.parametrize(("radius", "sigma"), [(0.08, 0.01), (0.15, 0.02), (0.15, 0.001), (0.3, 0.02)])
def test_scatter_across_the_bark_does_not_make_a_trunk_thicker(radius, sigma):
    """The mean distance from the middle of points that err by sigma in x and y is r + sigma^2 / 2 r."""
    rng = np.random.default_rng(3)
    angle = rng.uniform(0.0, 2.0 * np.pi, 20_000)
    xy = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(0.0, sigma, (len(angle), 2))
    assert np.hypot(*xy.T).mean() == pytest.approx(radius + 0.5 * sigma**2 / radius, abs=4e-4)
    circle = fitted(xy)
    assert without_scatter(circle[2], circle[7]) == pytest.approx(radius, abs=4e-4 + 0.1 * sigma**2 / radius)
    assert np.hypot(*circle[:2]) < 1e-3


@pytest.mark.parametrize("lean", [(0.0, 0.0), (0.3, 0.0), (-0.15, 0.2)])
def test_the_diameter_of_a_leaning_stem_is_measured_across_its_axis(lean):
    """A stem that is round across its axis has level slices that are wider along the lean."""
    rng = np.random.default_rng(4)
    points = stem(0.0, 0.0, 0.2, rng, taper=0.0, sigma=0.003, height=6.0, per_m2=1200)
    axis = np.array([*lean, 1.0]) / np.sqrt(1.0 + lean[0] ** 2 + lean[1] ** 2)
    # Turn the upright stem so that its axis leans, about breast height.
    v = np.cross([0.0, 0.0, 1.0], axis)
    K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    R = np.eye(3) + K + K @ K / (1.0 + axis[2])
    foot = points[:, 2].min()
    turned = (points - [0.0, 0.0, foot + 1.3]) @ R.T + [3.0, 3.0, foot + 1.3]
    m = map_plot(Made(np.concatenate([ground(6.0, 0.05, rng), turned])), preset("forest"))
    assert len(m.trees.number) == 1
    assert m.trees.dbh[0] == pytest.approx(0.4, abs=0.005)
