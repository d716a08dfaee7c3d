"""Which sources are whole clouds, and their opening. The web process imports this module."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from app.sources.opening import check_opening
from pipeline.errors import SourceError
from pipeline.io.readers import FILES, SourceOptions, form_of, points_format

if TYPE_CHECKING:
    from app.extensions.clouds.point_cloud import PointCloud
    from app.extensions.clouds.source import CloudSource

WHAT = "a whole cloud"


def takes(uri: str, options: SourceOptions | None = None) -> bool:
    """Return whether a file is a whole cloud; where its contents decide, on Linux in a child process with
    limits. Of a file that cannot be read or takes too long, its format decides."""
    kind, chosen = points_format(uri), options or SourceOptions()
    if kind is None:
        return False

    def is_cloud() -> bool:
        return form_of(Path(uri).expanduser(), chosen).is_cloud

    if not kind.scans or chosen.form != "auto":
        return is_cloud()
    try:
        found = check_opening(is_cloud, uri)
    except SourceError:
        return kind not in FILES
    return is_cloud() if found is None else found


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
