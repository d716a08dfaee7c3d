"""The orientation of an IMU whose axes are not those of the robot levels no scan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.io.readers.base import Source
from pipeline.types.records import Imu
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, Author, Write, points_of, write_recording


def recorded(opened: Opened, folder: Path, axis: str, degrees: float) -> Source:
    """A recording whose IMU is turned about an axis, without a transform to the robot."""

    def fill(author: Author, write: Write) -> None:
        write("/points", "sensor_msgs/msg/PointCloud2", START_NS, author.cloud(START_NS, points_of(0)))
        reading = author.imu(START_NS, (0.1, 0.2, 0.3))
        setattr(reading.orientation, axis, float(np.sin(np.radians(degrees) / 2)))
        reading.orientation.w = float(np.cos(np.radians(degrees) / 2))
        write("/imu/data", "sensor_msgs/msg/Imu", START_NS, reading)

    return opened(write_recording("mcap", folder, fill))


@pytest.mark.parametrize(
    ("axis", "degrees", "used"),
    [
        ("x", 180.0, False), ("y", 90.0, False), ("x", -90.0, False), ("y", 50.0, False),
        ("y", 40.0, True), ("x", -25.0, True), ("z", 180.0, True),
    ],
)  # fmt: skip
def test_an_imu_with_other_axes_does_not_tell_the_tilt(
    axis: str, degrees: float, used: bool, tmp_path: Path, opened: Opened
):
    source = recorded(opened, tmp_path, axis, degrees)
    (reading,) = [record for record in source.records() if isinstance(record, Imu)]
    assert (reading.orientation is not None) is used
    assert reading.angular_velocity.tolist() == [0.1, 0.2, 0.3]
    said = [text for text in source.description.warnings if "side or back" in text]
    assert len(said) == (not used)
    assert all("/imu/data" in text for text in said)
