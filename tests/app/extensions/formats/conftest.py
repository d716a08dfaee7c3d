"""The fixture that opens sources, with the formats of the extensions."""

import app.sources  # noqa: F401 - adds these formats
from tests.pipeline.io.conftest import opened

__all__ = ["opened"]
