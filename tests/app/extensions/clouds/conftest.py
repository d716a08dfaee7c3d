"""The formats of the extensions are known."""

import app.sources.opening  # noqa: F401 - adds these formats
