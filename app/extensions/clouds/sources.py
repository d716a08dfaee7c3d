"""Which sources are whole clouds, and their opening. The web process imports this module."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.sources.opening import check_opening, is_cloud
from pipeline.io.readers import SourceOptions

if TYPE_CHECKING:
    from app.extensions.clouds.point_cloud import PointCloud
    from app.extensions.clouds.source import CloudSource

WHAT = "a whole cloud"
takes = is_cloud


def check(uri: str, options: SourceOptions | None = None) -> None:
    """Check that a whole cloud can be opened, in a child process with limits, see `check_opening`."""
    from app.extensions.clouds import point_cloud

    check_opening(lambda: point_cloud.open_cloud(uri, options), uri)


def open_cloud(uri: str, options: SourceOptions | None = None) -> PointCloud:
    """Open a whole cloud, see `point_cloud.open_cloud`; on Linux first in a child process with limits.

    Raises:
        SourceError: The cloud cannot be read, or takes more time or memory than a file of its size should.
    """
    from app.extensions.clouds import point_cloud

    check(uri, options)
    return point_cloud.open_cloud(uri, options)


def open_source(uri: str, options: SourceOptions | None = None) -> CloudSource:
    """Open a whole cloud; raises SourceError if it cannot be read."""
    from app.extensions.clouds.source import CloudSource

    return CloudSource(open_cloud(uri, options))
