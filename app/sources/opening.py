"""Opens any source: recordings and simulated runs, or a robot that is heard live."""

from __future__ import annotations

from app.robot.address import is_live
from app.robot.source import LiveSource, open_live
from pipeline.io.readers import Source, SourceOptions, open_source


def open_any(uri: str, options: SourceOptions) -> Source | LiveSource:
    """Open what a user named.

    Raises:
        SourceError: It is not there, of a kind that cannot be read, or damaged.
    """
    return open_live(uri, options) if is_live(uri) else open_source(uri, options)
