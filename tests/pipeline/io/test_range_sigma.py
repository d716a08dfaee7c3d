"""The range sigma of a sensor is measured in its first scan, whatever its pattern."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.io.readers.scan_columns import RANGE_SIGMA_LEAST, RANGE_SIGMA_MOST, sensor_of
from pipeline.io.readers.simulated import open_simulated
from pipeline.io.readers.velodyne import SENSORS
from pipeline.simulation.lidar import SolidStateLidar, SpinningLidar
from pipeline.types.records import Scan

OUSTER = SpinningLidar(1024, 64, lowest=np.radians(-22.5), ring_step=np.radians(45.0 / 63))


def first_scan(uri: str, lidar: SpinningLidar, sigma: float) -> Scan:
    """The first scan of a scenario by a sensor."""
    return replace(open_simulated(uri).run, lidar=replace(lidar, range_sigma=sigma)).sweep(0).scan


@pytest.mark.parametrize("lidar", [SpinningLidar(), OUSTER, SolidStateLidar()], ids=["vlp", "os", "solid"])
@pytest.mark.parametrize("uri", ["sim:stand?duration=2", "sim:dense?duration=2", "sim:slope?duration=2"])
@pytest.mark.parametrize("sigma", [0.012, 0.02])
def test_the_noise_of_the_ranges_is_measured(uri: str, lidar: SpinningLidar, sigma: float):
    scan = first_scan(uri, lidar, sigma)
    assert sensor_of(scan).range_sigma == pytest.approx(sigma, rel=0.2)
    assert sensor_of(replace(scan, ring=None)).range_sigma == sensor_of(scan).range_sigma


def test_it_stays_between_the_roughness_of_bark_and_the_worst_data_sheet():
    exact, poor = (first_scan("sim:stand?duration=2", SpinningLidar(), sigma) for sigma in (0.0, 0.2))
    assert sensor_of(exact).range_sigma == RANGE_SIGMA_LEAST
    assert sensor_of(poor).range_sigma == RANGE_SIGMA_MOST


def test_a_known_sensor_keeps_its_other_figures():
    scan = first_scan("sim:stand?duration=2", SpinningLidar(), 0.02)
    known = SENSORS[0x24]
    assert sensor_of(scan, known) == replace(known, range_sigma=sensor_of(scan).range_sigma)


@pytest.mark.parametrize("number", [0, 1, 11, 99])
def test_few_points_show_no_noise(number: int):
    points = np.random.default_rng(0).uniform(1.0, 9.0, (number, 3)).astype(np.float32)
    assert sensor_of(Scan(0, points)).range_sigma == RANGE_SIGMA_MOST


def test_points_on_one_beam_or_one_line_are_no_difficulty():
    beam = np.linspace(1.0, 9.0, 200, dtype=np.float32)[:, None] * np.array([[1.0, 0.0, 0.0]], np.float32)
    line = np.stack([beam[:, 0], np.ones(200, np.float32), np.zeros(200, np.float32)], axis=1)
    for points in (beam, line, np.ones((200, 3), np.float32)):
        assert RANGE_SIGMA_LEAST <= sensor_of(Scan(0, points)).range_sigma <= RANGE_SIGMA_MOST
