"""Messages of Livox are known to plain DDS."""

from __future__ import annotations

import pytest

from pipeline.io.readers.sensor_families import CUSTOM_TYPES
from tests.pipeline.io.livox_messages import COUNT, custom, rosette
from tests.pipeline.io.recordings import Author


@pytest.mark.parametrize("kind", CUSTOM_TYPES)
def test_it_is_known_to_plain_dds(kind: str):
    pytest.importorskip("cyclonedds")
    from app.extensions.dds.link import idl_type

    author = Author("mcap")
    payload = bytes(author.store.serialize_cdr(custom(author, kind, 0), kind))
    decoded = idl_type(kind).deserialize(payload)
    assert len(decoded.points) == COUNT
    assert decoded.points[7].offset_time == rosette(0)["offset_time"][7]
