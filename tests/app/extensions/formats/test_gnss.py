"""GNSS fixes in recordings as pose measurements, written by rosbags."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod

from app.extension import VARIABLE
from app.extensions.formats.gnss import BEST_SIGMA, UNKNOWN_SIGMA, Fix, align_fixes
from pipeline.geometry.poses import Pose2
from pipeline.io.readers.ros import RosSource
from pipeline.types.records import PoseMeasurement
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, STEP_NS, Author, Write, write_recording
from tests.pipeline.io.test_more_ros import KINDS, LATITUDE, SIGMA, straight


@pytest.mark.parametrize("kind", KINDS)
def test_fixes_are_poses_in_the_frame_of_the_map(kind: str, tmp_path: Path, opened: Opened):
    source = opened(write_recording(kind, tmp_path, straight))
    measured = [record for record in source.records() if isinstance(record, PoseMeasurement)]
    assert len(measured) == 11
    assert isinstance(source, RosSource)
    fixes = source.readings("gnss")
    assert len(fixes) == 11
    assert {fix.sigma for fix in fixes} == {SIGMA}
    assert fixes[0].latitude == pytest.approx(LATITUDE, abs=1e-5)
    for pose in measured:
        step = (pose.stamp_ns - START_NS) / STEP_NS
        assert pose.is_sound()
        assert pose.T_map_base.x == pytest.approx(40.0 * step / 59, abs=0.5)
        assert pose.T_map_base.y == pytest.approx(0.0, abs=0.5)
        assert SIGMA**2 < pose.covariance[0, 0] < 1.0
    assert source.losses == {"GNSS messages without a fix": 1}
    assert "over 37 m of the drive" in source.description.gnss


@pytest.mark.parametrize(
    ("fill", "why"),
    [
        (lambda author, write: straight(author, write, metres=3.0), "too little to determine the direction"),
        (lambda author, write: straight(author, write, odometry=False), "without odometry"),
    ],
)
def test_fixes_that_cannot_be_laid_into_the_map_are_left_aside_with_a_word(
    fill: Callable[[Author, Write], None], why: str, tmp_path: Path, opened: Opened
):
    source = opened(write_recording("mcap", tmp_path, fill))
    assert any(why in warning for warning in source.description.warnings)
    assert not any(isinstance(record, PoseMeasurement) for record in source.records())
    assert source.description.gnss == ""


@given(
    yaw=st.floats(-3.0, 3.0), latitude=st.floats(-80.0, 80.0), longitude=st.floats(-179.0, 179.0),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_any_plane_is_found_again(yaw: float, latitude: float, longitude: float, seed: int):
    rng = np.random.default_rng(seed)
    way = np.cumsum(rng.normal(0.5, 1.0, (60, 2)), axis=0)
    geod = Geod(ellps="WGS84")
    c, s = np.cos(-yaw), np.sin(-yaw)
    stamps = [k * 10**9 for k in range(60)]
    fixes = []
    for stamp_ns, (x, y) in zip(stamps, way, strict=True):
        east, north = c * x - s * y, s * x + c * y
        lon, lat, _ = geod.fwd(
            longitude, latitude, np.degrees(np.arctan2(east, north)), np.hypot(east, north)
        )
        fixes.append(Fix.of(stamp_ns, lat, lon, [0.01, 0, 0, 0, 0.01, 0, 0, 0, 1], 2))
    found, why = align_fixes(fixes, stamps, way)
    if np.hypot(*np.ptp(way, axis=0)) < 10.0:
        assert found is None
        return
    assert found is not None, why
    assert found.fit.residual < 0.02
    for wanted, fix_ in zip(way, fixes, strict=True):
        pose = found.measurement(fix_).T_map_base
        assert isinstance(pose, Pose2)
        assert np.hypot(pose.x - wanted[0], pose.y - wanted[1]) < 0.05


@pytest.mark.parametrize(
    ("variance", "kind", "sigma"),
    [
        (0.0, 1, UNKNOWN_SIGMA),
        (0.0, 2, UNKNOWN_SIGMA),
        (0.0, 0, UNKNOWN_SIGMA),
        (0.04, 2, 0.2),
        (1e-6, 3, BEST_SIGMA),
    ],
)
def test_variances_of_zero_are_not_filled_in(variance: float, kind: int, sigma: float):
    covariance = [variance, 0, 0, 0, variance, 0, 0, 0, variance]
    assert Fix.of(0, 60.0, 24.0, covariance, kind).sigma == pytest.approx(sigma)


@pytest.mark.parametrize(("east", "north"), [(-0.5, 2.0), (2.0, -0.5), (float("nan"), 1.0), (1.0, 1e8)])
def test_each_variance_of_a_fix_is_checked(east: float, north: float):
    covariance = [east, 0, 0, 0, north, 0, 0, 0, 1]
    with pytest.raises(ValueError, match="variance"):
        Fix.of(0, 60.0, 24.0, covariance, 2)
    assert Fix.of(0, 60.0, 24.0, covariance, 0).sigma == UNKNOWN_SIGMA


def test_fixes_need_the_extension(tmp_path: Path, opened: Opened, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(VARIABLE, "")
    source = opened(write_recording("mcap", tmp_path, straight))
    said = f"GNSS fixes are not used: The extension formats is switched off by {VARIABLE}."
    assert said in source.description.warnings
    assert not any(isinstance(record, PoseMeasurement) for record in source.records())
    assert source.losses == {}
