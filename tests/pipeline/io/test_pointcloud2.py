"""PointCloud2: any layout of fields is read back, and contradictions are refused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.io.readers.point_times import PointTimes
from pipeline.io.readers.ros_records import LayoutError, cloud_columns
from pipeline.io.readers.scan_columns import scan_of

CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
STAMP_NS = 1_700_000_000_123_456_789


@dataclass
class Field:
    """sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int = 1


@dataclass
class Message:
    """The part of sensor_msgs/PointCloud2 without its header."""

    height: int
    width: int
    fields: list[Field]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: NDArray[np.uint8]


def encode(table: NDArray[np.void], *, height: int = 1, padding: int = 0) -> Any:
    """A message of a structured array, with `padding` bytes after each row."""
    dtype = table.dtype
    names = dtype.names or ()
    fields = [Field(n, dtype.fields[n][1], CODES[dtype.fields[n][0].str[1:]]) for n in names]  # type: ignore[index]
    width = len(table) // height
    rows = np.zeros((height, width * dtype.itemsize + padding), np.uint8)
    rows[:, : width * dtype.itemsize] = np.frombuffer(table.tobytes(), np.uint8).reshape(height, -1)
    big = any(dtype.fields[n][0].str[0] == ">" for n in names)  # type: ignore[index]
    return Message(height, width, fields, big, dtype.itemsize, rows.shape[1], rows.ravel())


@st.composite
def layouts(draw: st.DrawFn) -> np.dtype[np.void]:
    """Fields x, y, z, intensity, ring, t and an unknown one, in any order with any gaps."""
    order = draw(st.sampled_from("<>"))
    xyz = draw(st.sampled_from(["f4", "f8"]))
    codes = {
        **dict.fromkeys("xyz", xyz),
        "intensity": draw(st.sampled_from(["f4", "u1", "u2", "f8"])),
        "ring": draw(st.sampled_from(["u1", "u2", "i4"])),
        "t": "u4",
        "curvature": draw(st.sampled_from(["f4", "i2"])),
    }
    names = draw(st.permutations(sorted(codes)))
    offsets, at = [], 0
    for name in names:
        at += draw(st.integers(0, 5))
        offsets.append(at)
        at += int(codes[name][1])
    formats = [order + codes[name] for name in names]
    step = at + draw(st.integers(0, 9))
    return np.dtype({"names": list(names), "formats": formats, "offsets": offsets, "itemsize": step})


@given(layouts(), st.integers(1, 6), st.integers(1, 8), st.integers(0, 7), st.integers(0, 2**32 - 1))
def test_any_layout_gives_back_what_was_put_in(
    dtype: np.dtype[np.void], height: int, width: int, padding: int, seed: int
):
    rng = np.random.default_rng(seed)
    table = np.zeros(height * width, dtype)
    for axis in "xyz":
        table[axis] = rng.uniform(1.0, 90.0, len(table)) * rng.choice([-1, 1], len(table))
    table["intensity"] = rng.integers(0, 200, len(table))
    table["ring"] = rng.integers(0, 100, len(table))
    table["t"] = rng.integers(0, 100_000_000, len(table))
    gone = rng.random(len(table)) < 0.3
    table["y"][gone] = np.nan
    times = PointTimes("t", 1, "stamp", 10**8)
    scan = scan_of(STAMP_NS, cloud_columns(encode(table, height=height, padding=padding)), times)
    kept = table[~gone]
    assert scan.dropped == np.count_nonzero(gone)
    np.testing.assert_array_equal(scan.points, np.stack([kept[a].astype(np.float32) for a in "xyz"], axis=1))
    np.testing.assert_array_equal(scan.reflectance, kept["intensity"].astype(np.float32))
    np.testing.assert_array_equal(scan.ring, kept["ring"])
    if len(kept):
        np.testing.assert_array_equal(scan.offset_ns, kept["t"])


XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 2**32 - 1, "height": 2**32 - 1},
        {"width": 11},
        {"width": 9, "row_step": 108},
        {"point_step": 0},
        {"point_step": 2**32 - 1},
        {"height": 2},
        {"height": 2, "row_step": 0},
        {"data": np.zeros(119, np.uint8)},
        {"data": np.zeros(1, np.uint8)},
        {"fields": []},
        {"fields": [Field("x", 0, 7), Field("y", 4, 7), Field("z", 2**32 - 1, 7)]},
        {"fields": [Field("x", 0, 7), Field("y", 4, 7), Field("z", 8, 5)]},
        {"fields": [Field("x", 0, 7), Field("y", 4, 7), Field("z", 8, 99)]},
    ],
)
def test_headers_that_contradict_the_data_are_refused(changes: dict[str, object]):
    message = encode(np.ones(10, XYZ))
    assert len(cloud_columns(message)["x"]) == 10
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(LayoutError):
        cloud_columns(message)


def test_a_reflectance_that_is_not_finite_is_replaced_in_the_scan_alone():
    table = np.ones(1, np.dtype([*XYZ.descr, ("intensity", "<f4")]))
    table["intensity"] = np.nan
    message = encode(table)
    message.data.setflags(write=False)
    reflectance = scan_of(STAMP_NS, cloud_columns(message)).reflectance
    assert reflectance is not None
    np.testing.assert_array_equal(reflectance, [0.0])
