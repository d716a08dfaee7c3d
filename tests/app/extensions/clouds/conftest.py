"""The formats of the extensions are known."""

import app.sources  # noqa: F401 - adds these formats
