"""The range sigma of a sensor is measured in its first scan, whatever its pattern."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.io.readers.scan_columns import RANGE_SIGMA_LEAST, RANGE_SIGMA_MOST, beam_spacing, sensor_of
from pipeline.io.readers.simulated import open_simulated
from pipeline.io.readers.velodyne import SENSORS
from pipeline.simulation.lidar import SolidStateLidar, SpinningLidar
from pipeline.types.records import Scan, Sensor

OUSTER = SpinningLidar(1024, 64, lowest=np.radians(-22.5), ring_step=np.radians(45.0 / 63))
#: A dome, of which most of the field of view is above the trunks.
DOME = SpinningLidar(500, 40, lowest=np.radians(-7.0), ring_step=np.radians(59.0 / 39))


def first_scan(uri: str, lidar: SpinningLidar, sigma: float) -> Scan:
    """The first scan of a scenario by a sensor."""
    return replace(open_simulated(uri).run, lidar=replace(lidar, range_sigma=sigma)).sweep(0).scan


@pytest.mark.slow_after(5)
@pytest.mark.parametrize(
    "lidar", [SpinningLidar(), OUSTER, DOME, SolidStateLidar()], ids=["vlp", "os", "dome", "solid"]
)
@pytest.mark.parametrize("uri", ["sim:stand?duration=2", "sim:dense?duration=2", "sim:slope?duration=2"])
@pytest.mark.parametrize("sigma", [0.012, 0.02])
def test_the_noise_of_the_ranges_is_measured(uri: str, lidar: SpinningLidar, sigma: float):
    scan = first_scan(uri, lidar, sigma)
    assert sensor_of(scan).range_sigma == pytest.approx(sigma, rel=0.3 if lidar is DOME else 0.2)
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


@pytest.mark.parametrize("uri", ["sim:stand?duration=2", "sim:wild?seed=101&duration=2"])
def test_the_spacing_of_returns_is_measured_whatever_the_pattern(uri: str):
    """24,000 returns in a cone of 70 degrees are 0.40 degrees apart, 20,000 of a Mid-360 about one degree."""
    for lidar, degrees in ((SpinningLidar(), 0.63), (OUSTER, 0.50), (SolidStateLidar(), 0.38)):
        assert np.degrees(beam_spacing(first_scan(uri, lidar, 0.02))) == pytest.approx(degrees, rel=0.15)
    for name, degrees in (("mid360", 1.05), ("avia", 0.38)):
        scan = open_simulated(f"{uri}&lidar={name}").run.sweep(0).scan
        assert np.degrees(beam_spacing(scan)) == pytest.approx(degrees, rel=0.15)


def test_only_a_coarse_sensor_without_rings_has_the_measured_spacing_as_its_steps():
    coarse = open_simulated("sim:stand?duration=2&lidar=mid360")
    found = sensor_of(replace(coarse.run.sweep(0).scan, ring=None))
    assert found.rings == 0
    assert found.azimuth_step == found.ring_step
    assert found.azimuth_step == pytest.approx(coarse.description.sensor.azimuth_step, rel=0.15)
    dense = sensor_of(replace(first_scan("sim:stand?duration=2", SolidStateLidar(), 0.02), ring=None))
    assert (dense.azimuth_step, dense.ring_step) == (Sensor().azimuth_step, 0.0)


def test_a_thinned_out_scan_with_the_elevations_of_a_vlp_16_is_none():
    whole = first_scan("sim:stand?duration=2", SpinningLidar(), 0.02)
    thin = first_scan("sim:stand?duration=2", SpinningLidar(columns=150), 0.02)
    assert sensor_of(replace(whole, ring=None)).name == "VLP-16"
    found = sensor_of(replace(thin, ring=None))
    assert found.rings == 0
    assert np.degrees(found.azimuth_step) == pytest.approx(2.2, rel=0.2)
