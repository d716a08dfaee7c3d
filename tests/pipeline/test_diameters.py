"""A tree's diameter from all its scans, and the sigma that is told with it."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry import Pose2
from pipeline.parameters import preset
from pipeline.shape.residuals import BEAM
from pipeline.shape.stem import fit_stems
from pipeline.tracking import Tracker
from tests.pipeline.strategies import NOTHING_SEEN, SENSOR, detections

SIGMA, RING_STEP, LOW, HIGH = 0.02, np.radians(2.0), 0.3, 2.0
VIEWS, TREES = 60, 60


def tracker():
    """With the parameters of the preset forest, but a diameter from any arc."""
    return Tracker(preset("forest").tracking.model_copy(update={"dbh_arc_min": 0.0}))


def show(t, k, distance, radius, sigma):
    """One detection straight ahead, seen by a robot at this distance from the tree at (0, 0)."""
    bearing = 2.0 * np.pi * k / 7.0
    pose = Pose2(-distance * np.cos(bearing), -distance * np.sin(bearing), bearing)
    seen = detections([[distance, 0.0]], radius=radius, arc=np.radians(120.0))
    seen.radius_sigma[:] = sigma
    t.process(k, pose, np.zeros((3, 3)), seen, NOTHING_SEEN, 0.0)


def test_a_radius_weighs_by_its_variance_and_the_square_of_its_distance():
    t = tracker()
    views = [(2.0, 0.10, 0.01), (4.0, 0.12, 0.01), (6.0, 0.15, 0.03), (0.2, 0.11, 0.02)]
    for k, (distance, radius, sigma) in enumerate(views):
        show(t, k, distance, radius, sigma)
    distance, radius, sigma = np.array(views).T
    weight = (sigma * np.maximum(distance, 1.0)) ** -2.0
    assert t.trees().dbh[0] == pytest.approx(2.0 * np.average(radius, weights=weight))


def test_more_scans_from_afar_do_not_make_a_diameter_surer_than_edges_are_known():
    sigmas = []
    for n in (7, 70, 700):
        t = tracker()
        for k in range(n):
            show(t, k, 12.0, 0.15, 0.03)
        sigmas.append(t.trees().dbh_sigma[0])
    assert sigmas[0] > sigmas[1] > sigmas[2] > 0.008
    near = tracker()
    for k in range(70):
        show(near, k, 3.0, 0.15, 0.03)
    assert near.trees().dbh_sigma[0] < sigmas[2] + 0.002


def seen_from(rng, radius, lean, distance):
    """What 16 rings of beams with some width see of a leaning trunk straight ahead, (N, 3) [m]."""
    heights = rng.uniform(0.0, RING_STEP * distance) + np.arange(LOW, HIGH, RING_STEP * distance)
    azimuth = rng.uniform(0.0, SENSOR.azimuth_step) + np.arange(-0.3, 0.3, SENSOR.azimuth_step)
    h, a = (v.ravel() for v in np.meshgrid(heights, azimuth, indexing="ij"))
    up = h - 1.3
    across = distance * np.sin(a) - lean[1] * up
    low, high = np.maximum(across - BEAM * distance, -radius), np.minimum(across + BEAM * distance, radius)
    met = high - low > 0.25 * 2.0 * BEAM * distance
    middle = 0.5 * (low + high)[met]
    reach = distance * np.cos(a[met]) + lean[0] * up[met] - np.sqrt(radius**2 - middle**2)
    reach += rng.normal(0.0, SIGMA, len(reach))
    return np.stack([reach * np.cos(a[met]), reach * np.sin(a[met]), h[met]], axis=1)


def test_the_sigma_of_a_diameter_is_what_it_errs():
    """NEES with one degree of freedom: 1 where sigmas are honest, over trunks of 8 to 60 cm that are seen at
    2 to 9 m; its mean over 60 trunks lies within 0.63 and 1.37 in 95 of 100 cases, if errors were normal."""
    nees, error = [], []
    for seed in range(TREES):
        rng = np.random.default_rng(seed)
        radius, lean, near = rng.uniform(0.04, 0.3), rng.normal(0.0, 0.03, 2), rng.uniform(2.0, 6.0)
        distance = rng.uniform(near, near + 3.0, VIEWS)
        views = [seen_from(rng, radius, lean, d) for d in distance]
        bounds = np.concatenate([[0], np.cumsum([len(view) for view in views])])
        stems = fit_stems(np.concatenate(views), bounds, SIGMA, SENSOR.azimuth_step)
        t = tracker()
        for k in range(VIEWS):
            show(t, k, distance[k], stems[k, 5], stems[k, 6])
        trees = t.trees()
        error.append(trees.dbh[0] - 2.0 * radius)
        nees.append((error[-1] / trees.dbh_sigma[0]) ** 2)
    assert 0.4 < np.mean(nees) < 1.6, np.mean(nees)
    assert abs(np.mean(error)) < 0.005, np.mean(error)
    assert np.sqrt(np.mean(np.square(error))) < 0.01, np.sqrt(np.mean(np.square(error)))
