"""Opening of sources and of whole clouds, with the formats of the extensions."""

import app.sources  # noqa: F401 - adds these formats
from app.sources.one_step import OneStepSource, open_one_step
from tests.pipeline.io.conftest import opened

__all__ = ["open_cloud", "opened"]


def open_cloud(uri: str) -> OneStepSource:
    """The whole cloud in a file."""
    cloud = open_one_step(uri)
    assert cloud is not None
    return cloud
