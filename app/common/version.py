"""Version of the installed distribution."""

from __future__ import annotations


def version() -> str:
    """Return the version, for example "0.1.0"."""
    from importlib.metadata import version as of

    return of("stemmap")
