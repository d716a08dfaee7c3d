"""Camera of a recording: which CameraInfo messages and raw pictures are valid."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import product
from typing import Any

import numpy as np
import pytest

from pipeline.geometry.poses import Float, Pose3
from pipeline.io.readers import camera as camera_module
from pipeline.io.readers.camera import PIXEL_LIMIT, find_camera, picture_of
from pipeline.io.readers.container import Channel, Container, Message
from pipeline.io.readers.topics import CAMERA_INFO, IMAGE, standard_types
from pipeline.io.readers.transforms import TransformTree
from pipeline.types.camera import Camera

K = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
T_BASE_CAMERA = Pose3(np.eye(3), np.array([0.3, 0.0, 1.0]))


def make(name: str, **values: Any) -> Any:
    """A message of ROS 2 with a header of the frame "camera"."""
    types = standard_types("cdr").types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 0), "camera")
    return types[name](header=header, **values)


def camera_info(K: Float, width: int = 640, height: int = 480) -> bytes:
    """A CameraInfo without distortion."""
    region = standard_types("cdr").types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    info = make(
        CAMERA_INFO, height=height, width=width, distortion_model="plumb_bob", d=np.zeros(5), k=K.ravel(),
        r=np.eye(3).ravel(), p=np.eye(3, 4).ravel(), binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip
    return bytes(standard_types("cdr").serialize_cdr(info, CAMERA_INFO))


class Recorded(Container):
    """A recording of CameraInfo messages."""

    def __init__(self, *payloads: bytes) -> None:
        self.channels = [Channel(1, "/camera/camera_info", CAMERA_INFO, "cdr", len(payloads))]
        self._payloads = payloads

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield the messages."""
        del start_ns, losses
        return (Message(1, k, payload) for k, payload in enumerate(self._payloads) if 1 in numbers)


def found_camera(*payloads: bytes) -> tuple[Camera | None, str]:
    """The camera by these messages, which is mounted at T_BASE_CAMERA."""
    tree = TransformTree()
    tree.add("base", "camera", T_BASE_CAMERA)
    return find_camera(Recorded(*payloads), tree, "base", "/camera/image")


def changed(row: int, column: int, value: float) -> Float:
    """K with another number."""
    other = K.copy()
    other[row, column] = value
    return other


INVALID = {
    "focal length along x": camera_info(changed(0, 0, 1.0)),
    "focal length along y": camera_info(changed(1, 1, 1.0)),
    "middle not finite": camera_info(changed(0, 2, np.nan)),
    "corner not finite": camera_info(changed(2, 0, np.inf)),
    "no width": camera_info(K, width=0),
    "no height": camera_info(K, height=0),
    "too many pixels": camera_info(K, PIXEL_LIMIT + 1, 1),
    "cut": camera_info(K)[:40],
}


@pytest.mark.parametrize("reason", INVALID)
def test_the_first_valid_camera_info_is_used(reason: str):
    camera, why = found_camera(INVALID[reason], camera_info(2.0 * K), camera_info(K))
    assert why == ""
    assert camera is not None
    np.testing.assert_array_equal(camera.K, 2.0 * K)
    np.testing.assert_array_equal(camera.T_base_camera.t, T_BASE_CAMERA.t)
    assert found_camera(INVALID[reason]) == (None, "no message of /camera/camera_info is valid")


def test_a_picture_of_as_many_pixels_as_are_allowed_has_a_camera():
    camera, _ = found_camera(camera_info(K, PIXEL_LIMIT // 8, 8))
    assert camera is not None
    assert camera.width * camera.height == PIXEL_LIMIT


def test_a_raw_picture_is_used_if_its_rows_are_complete(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(camera_module, "PIXEL_LIMIT", 9)
    channels = {1: Channel(1, "/camera/image", IMAGE, "cdr")}
    for width, height, step, more in product(range(4), range(4), range(5), (-1, 0, 1)):
        data = np.arange(max(step * height + more, 0), dtype=np.uint8)
        image = make(
            IMAGE, height=height, width=width, encoding="mono8", is_bigendian=0, step=step, data=data
        )
        payload = bytes(standard_types("cdr").serialize_cdr(image, IMAGE))
        picture = picture_of(Message(1, 0, payload), channels, 7)
        rows = [data[k * step : (k + 1) * step] for k in range(height)]
        complete = all(len(row) == step and len(row[:width]) == width for row in rows)
        assert (picture is not None) == (complete and width > 0 and height > 0)
        if picture is not None:
            assert (picture.width, picture.height, picture.step) == (width, height, step)
            assert picture.data == data.tobytes()
    wide = make(
        IMAGE, height=2, width=5, encoding="mono8", is_bigendian=0, step=5, data=np.zeros(10, np.uint8)
    )
    payload = bytes(standard_types("cdr").serialize_cdr(wide, IMAGE))
    assert picture_of(Message(1, 0, payload), channels, 7) is None
