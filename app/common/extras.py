"""Optional packages."""

from __future__ import annotations

import importlib
from typing import Any

from pipeline.errors import StemmapError


def needed(module: str, extra: str, purpose: str) -> Any:  # noqa: ANN401 - a module
    """Import an optional module and return it.

    Args:
        module: Its name.
        extra: The extra of this package that installs it.
        purpose: What needs it, a plural for the message, such as "GIS files".

    Raises:
        StemmapError: It, or a module that it needs, is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise StemmapError(
            f"{purpose} need the package {module}", remedy=f"Install it with: pip install 'stemmap[{extra}]'"
        ) from None
