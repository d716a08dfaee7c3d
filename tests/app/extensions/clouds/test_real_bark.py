"""Fit of single scans on real bark, branches and buttresses: virtual scans of a real pine plot."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pipeline.detection.cylinder_fit import fit_stems
from pipeline.io.readers import open_source
from pipeline.io.readers.simulated import SimulatedSource

DATA = Path(os.environ.get("STEMMAP_DATA", "../shared/data")) / "forest"
SCANS = range(10, 500, 35)
REACH, BESIDE = 7.0, 0.15  # m; from the sensor, and around a stem's bark
LOW, HIGH = 0.3, 2.0  # m above the foot of a stem, as the preset forest looks
LEAST = 20  # points


@pytest.fixture(scope="module")
def fits():
    """Of each stem in each scan, shape (N, 4): error of the diameter, its sigma, error of the centre along
    the ray and across it [m]."""
    if not (DATA / "pine_plot.laz").exists():
        pytest.skip(f"no real data at {DATA}")
    uri = f"sim:cloud?file={DATA / 'pine_plot.laz'}&truth={DATA / 'pine_plot_stems.csv'}&odometry=exact"
    with closing(open_source(uri)) as source:
        assert isinstance(source, SimulatedSource)
        truth = source.truth()
        assert truth.trees is not None
        run, trees = source.run, truth.trees
        return np.concatenate([fits_of_scan(run, trees, k) for k in SCANS])


def fits_of_scan(run, trees, k):
    """Rows of `fits` for scan k of a virtual run."""
    scan, offsets = run.sweep(k).scan, run.lidar.column_offsets_ns().astype(np.int64)
    R, o = run.motion.sensor_at((k * run.lidar.period_ns + offsets) / 1e9, run.T_base_lidar)
    column = np.searchsorted(offsets, scan.offset_ns)
    points = np.einsum("nij,nj->ni", R[column], scan.points.astype(np.float64)) + o[column]
    eye = o[len(o) // 2]
    rows = []
    for x, y, dbh in zip(trees.x, trees.y, trees.dbh, strict=True):
        around = np.hypot(run.surfels.points[:, 0] - x, run.surfels.points[:, 1] - y) < 0.45
        height = points[:, 2] - np.percentile(run.surfels.points[around, 2], 2.0)
        near = np.hypot(points[:, 0] - x, points[:, 1] - y) < 0.5 * dbh + BESIDE
        seen = points[near & (height > LOW) & (height < HIGH)] - eye
        true = np.array([x, y]) - eye[:2]
        if len(seen) < LEAST or np.hypot(*true) > REACH:
            continue
        s = fit_stems(
            seen, np.array([0, len(seen)]), run.lidar.range_sigma, run.lidar.sensor.azimuth_step, np.zeros(1)
        )[0]
        ahead, error = true / np.hypot(*true), s[:2] - true
        across = ahead[0] * error[1] - ahead[1] * error[0]
        rows.append((2.0 * s[5] - dbh, 2.0 * s[6], ahead @ error, across))
    return np.array(rows).reshape(-1, 4)


@pytest.mark.slow
def test_diameters_on_real_bark_are_near_those_of_other_tools(fits):
    """The reference is at breast height; many stems are seen lower, where they are 1 to 3 cm wider."""
    error, sigma = fits[:, 0], fits[:, 1]
    assert len(error) > 50
    assert 0.0 < np.median(error) < 0.04, np.median(error)
    assert abs(np.average(error, weights=sigma**-2.0)) < 0.03, np.average(error, weights=sigma**-2.0)
    assert np.mean(np.abs(error) < 0.08) > 0.7, np.mean(np.abs(error) < 0.08)


def test_a_large_error_has_a_large_sigma(fits):
    error, sigma = fits[:, 0], fits[:, 1]
    assert np.mean(np.abs(error) < 3.0 * sigma) > 0.75, np.mean(np.abs(error) < 3.0 * sigma)


def test_centres_on_real_bark_lie_on_the_axis(fits):
    assert abs(np.median(fits[:, 2])) < 0.015, np.median(fits[:, 2])
    assert abs(np.median(fits[:, 3])) < 0.01, np.median(fits[:, 3])
    assert np.sqrt(np.median(fits[:, 2] ** 2)) < 0.03
