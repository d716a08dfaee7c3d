"""Simulated sensors by name: their field of view, their rings, and patterns that do not repeat."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import UsageError
from pipeline.io.readers.simulated import open_simulated
from pipeline.simulation.lidar import SpinningLidar
from pipeline.simulation.lidar_models import LIDARS, RosetteLidar
from pipeline.simulation.scenarios import LIDAR_NAMES
from pipeline.types.records import Float, Scan

#: Rings, lowest and highest elevation [degrees] by data sheet, and returns of a full scan at 10 Hz.
SHEETS = {
    "vlp16": (16, -15.0, 15.0, 28_800),
    "vlp32": (32, -25.0, 15.0, 57_600),
    "os0-128": (128, -45.0, 45.0, 131_072),
    "os1-64": (64, -22.5, 22.5, 65_536),
    "xt32": (32, -16.0, 15.0, 64_000),
    "helios": (32, -55.0, 15.0, 57_600),
    "mid360": (0, -7.0, 52.0, 20_000),
    "avia": (0, -37.0, 37.0, 24_000),
}


def test_the_names_in_uris_are_those_of_the_sensors():
    assert tuple(LIDARS) == LIDAR_NAMES
    with pytest.raises(UsageError, match="lidar = 'os9'"):
        open_simulated("sim:stand?lidar=os9")


def first(uri: str) -> tuple[Scan, Float]:
    """The first scan and the elevations of its points [degrees]."""
    scan = open_simulated(uri).run.sweep(0).scan
    points = scan.points.astype(np.float64)
    return scan, np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))


@pytest.mark.parametrize("name", sorted(SHEETS))
def test_a_sensor_sees_what_its_data_sheet_says(name: str):
    rings, lowest, highest, most = SHEETS[name]
    uri = f"sim:stand?duration=2&lidar={name}"
    scan, elevation = first(uri)
    assert open_simulated(uri).description.sensor.rings == rings
    assert lowest - 0.3 <= elevation.min() <= lowest + 2.5
    assert highest - 2.5 <= elevation.max() <= highest + 0.3
    assert 0.3 * most < len(scan.points) <= most


def test_the_scene_is_the_same_for_all_sensors():
    first_run, *runs = (
        open_simulated(f"sim:wild?seed=3&duration=2&lidar={name}").run for name in LIDAR_NAMES
    )
    for run in runs:
        np.testing.assert_array_equal(run.scene.truth.x, first_run.scene.truth.x)
        np.testing.assert_array_equal(run.motion.drive.yaw, first_run.motion.drive.yaw)
    assert len({run.digest() for run in (first_run, *runs)}) == len(LIDAR_NAMES)


@pytest.mark.parametrize("name", ["mid360", "avia"])
def test_a_rosette_does_not_repeat_and_points_are_in_its_directions(name: str):
    lidar = LIDARS[name]
    assert isinstance(lidar, RosetteLidar)
    now, then = lidar.at_scan(3), lidar.at_scan(4)
    assert np.mean(now.fired() & then.fired()) < 0.5 * np.mean(now.fired())
    beams = now.beams()[now.fired()]
    np.testing.assert_allclose(np.linalg.norm(beams, axis=1), 1.0, atol=1e-12)
    assert now.sees((7.0 * beams).astype(np.float32)).mean() > 0.999
    run = open_simulated(f"sim:stand?duration=2&lidar={name}").run
    scan = run.sweep(0).scan
    directions = scan.points / np.linalg.norm(scan.points, axis=1)[:, None]
    fired = run.lidar.beams()[lidar.fired()]
    nearest = [float(np.max(fired @ direction)) for direction in directions[::500].astype(np.float64)]
    assert min(nearest) > 1.0 - 1e-6


def test_the_sensor_of_a_rosette_is_known_as_that_of_a_recording():
    sensor = open_simulated("sim:stand?lidar=mid360").description.sensor
    assert sensor.name == "Mid-360 (simulated)"
    assert sensor.range_max == 40.0


def test_cells_without_a_ray_show_no_tree(monkeypatch: pytest.MonkeyPatch):
    run = open_simulated("sim:wild?seed=103&duration=2&lidar=avia").run
    seen = run.true_trees().kind.count("tree")
    monkeypatch.setattr(RosetteLidar, "fired", SpinningLidar.fired)
    assert 0 < seen < run.true_trees().kind.count("tree")
