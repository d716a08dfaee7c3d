"""The extension `dds`: live robots of ROS 2 on plain DDS, without a Zenoh router."""

from __future__ import annotations

from app.extension import Extension

EXTENSION = Extension(
    help="live robots on plain DDS, as dds:?domain=0&interface=ADDRESS",
    addresses={"dds": "app.extensions.dds.address"},
)
