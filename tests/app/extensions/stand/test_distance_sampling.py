"""Distance sampling against closed forms and drawn stands."""

from __future__ import annotations

import math

import numpy as np
import pytest

from app.extensions.stand.plots import DetectionFunction, fit_half_normal


def fitted(distance, available):
    """The function, which exists."""
    fit = fit_half_normal(distance, available)
    assert fit is not None
    return fit


def found(random, place, sigma):
    """The distances that a half-normal observer keeps."""
    return place[random.random(len(place)) < np.exp(-0.5 * np.square(place / sigma))]


def test_from_one_position_the_scale_is_the_closed_form():
    random = np.random.default_rng(1)
    cells = 50.0 * np.sqrt(np.linspace(0, 1, 200_000))  # so wide that no tree is cut off
    r = found(random, 50.0 * np.sqrt(random.random(20_000)), 6.0)
    fit = fitted(r, cells)
    assert fit.sigma == pytest.approx(math.sqrt(np.square(r).sum() / (2 * len(r))), rel=0.003)
    assert fit.sigma_se == pytest.approx(fit.sigma / (2 * math.sqrt(len(r))), rel=0.02)
    assert fit.trees == len(r)


def test_along_a_straight_path_the_scale_is_the_closed_form():
    random = np.random.default_rng(2)
    r = found(random, random.uniform(0, 40, 5000), 6.0)
    fit = fitted(r, np.linspace(0, 40, 100_000))
    assert fit.sigma == pytest.approx(math.sqrt(np.square(r).mean()), rel=0.003)
    assert fit.sigma_se == pytest.approx(fit.sigma / math.sqrt(2 * len(r)), rel=0.02)


def test_the_corrected_number_is_that_of_the_drawn_stand_with_an_honest_error():
    random = np.random.default_rng(3)
    cells = 15.0 * np.sqrt(np.linspace(0, 1, 3000))
    z, errors = [], []
    for _ in range(200):
        r = found(random, 15.0 * np.sqrt(random.random(300)), 8.0)
        fit = fitted(r, cells)
        p, se = fit.mean(cells)
        error = len(r) / p - 300.0
        spread = math.sqrt(len(r) * (1 - p)) / p
        errors.append(error)
        z.append(error / math.hypot(spread, len(r) / p * se / p))
    assert np.mean(errors) == pytest.approx(0.0, abs=10.0)
    assert np.std(z) == pytest.approx(1.0, abs=0.2)


def test_a_complete_map_is_rarely_corrected():
    random = np.random.default_rng(4)
    cells = 15.0 * np.sqrt(np.linspace(0, 1, 3000))
    fits = [fitted(15.0 * np.sqrt(random.random(150)), cells) for _ in range(200)]
    assert np.mean([math.isinf(fit.sigma) for fit in fits]) > 0.9
    even = DetectionFunction(math.inf, 0.0, 150)
    p, se = even.mean(cells)
    assert p == 1.0
    assert math.isnan(se)  # trees that are missed at every distance are not noticed
    np.testing.assert_array_equal(even.at(cells), 1.0)


def test_few_trees_or_no_area_give_no_function():
    assert fit_half_normal(np.full(19, 3.0), np.linspace(0, 9, 50)) is None
    assert fit_half_normal(np.full(30, 3.0), np.zeros(0)) is None
    assert all(math.isnan(x) for x in DetectionFunction(math.inf, 0.0, 0).mean(np.zeros(0)))
