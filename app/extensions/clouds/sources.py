"""Which sources are whole clouds, and their opening. The web process imports this module."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.sources.opening import check_cloud, is_cloud, open_cloud
from pipeline.io.readers import SourceOptions

if TYPE_CHECKING:
    from app.extensions.clouds.source import CloudSource

WHAT = "a whole cloud"
takes, check = is_cloud, check_cloud


def open_source(uri: str, options: SourceOptions | None = None) -> CloudSource:
    """Open a whole cloud; raises SourceError if it cannot be read."""
    from app.extensions.clouds.source import CloudSource

    return CloudSource(open_cloud(uri, options))
