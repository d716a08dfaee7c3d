"""sensor_msgs/PointCloud2: from bytes and a list of fields to a Scan, whatever the layout."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.io.readers.cleaning import POINT_LIMIT, clean_scan
from pipeline.io.readers.point_fields import REFLECTANCE, RING, TIME, first_of, is_ring, point_offsets
from pipeline.io.readers.ros_messages import PointCloud2
from pipeline.types.records import Scan

STEP_LIMIT = 64 << 10
#: NumPy's code by the number of a PointField's datatype.
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class LayoutError(Exception):
    """The header of a cloud contradicts itself or its data."""


def decode_cloud(cloud: PointCloud2, stamp_ns: int) -> Scan:
    """Decode a PointCloud2 message.

    The time of a point is taken from a field named t, time, timestamp, time_offset or offset_time:
    integers are nanoseconds; floating numbers are seconds after the stamp, or since 1970 in the
    unit that their size tells. Times that do not lie within 2 s of the stamp are not used.

    Raises:
        LayoutError: Width, height, steps, fields and length of the data do not fit together.
    """
    table = _table(cloud)
    points = np.empty((len(table), 3), dtype=np.float64 if table["x"].dtype.itemsize > 4 else np.float32)
    for axis, name in enumerate("xyz"):
        points[:, axis] = table[name]
    columns = {name: table[name] for name in table.dtype.names or ()}
    reflectance, ring, time = (first_of(columns, names) for names in (REFLECTANCE, RING, TIME))
    if ring is not None and not is_ring(ring):
        ring = None
    offset_ns = None if time is None else point_offsets(time, stamp_ns)
    return clean_scan(stamp_ns, points, reflectance=reflectance, ring=ring, offset_ns=offset_ns)


def _table(cloud: PointCloud2) -> NDArray[np.void]:
    """The points as a structured array of shape (N,); its size is checked before it is made."""
    width, height = int(cloud.width), int(cloud.height)
    step, row_step, length = int(cloud.point_step), int(cloud.row_step), len(cloud.data)
    count = width * height
    if count > POINT_LIMIT or step > STEP_LIMIT:
        raise LayoutError(f"the header claims {count} points of {step} bytes")
    dtype = _dtype(cloud, step)
    row = row_step if height > 1 else width * step
    if row < width * step:
        raise LayoutError(f"a row of {row} bytes cannot hold {width} points of {step} bytes")
    needed = row * (height - 1) + width * step if count else 0
    if not needed <= length <= max(row, row_step) * height:
        raise LayoutError(f"{count} points of {step} bytes need {needed} bytes, the data has {length}")
    raw = np.ascontiguousarray(cloud.data).view(np.uint8)
    if row == width * step or not count:
        return raw[: count * step].view(dtype)
    rows = [raw[k * row : k * row + width * step].view(dtype) for k in range(height)]
    return np.concatenate(rows)


def _dtype(cloud: PointCloud2, step: int) -> np.dtype[np.void]:
    order = ">" if cloud.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for field in cloud.fields:
        name, offset, count = str(field.name), int(field.offset), int(field.count)
        known = name in (*"xyz", *REFLECTANCE, *RING, *TIME)
        if not known or name in names or int(field.datatype) not in TYPES:
            continue
        code = TYPES[int(field.datatype)]
        if offset + int(code[1]) * max(count, 1) > step:
            raise LayoutError(f"the field {name} lies outside of the {step} bytes of a point")
        names.append(name)
        formats.append(order + code)
        offsets.append(offset)
    lacking = [name for name in "xyz" if name not in names or formats[names.index(name)][1] != "f"]
    if lacking:
        raise LayoutError(f"the cloud has no field {', '.join(lacking)} of floating numbers")
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
