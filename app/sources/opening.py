"""Opening of files from outside: first in a child process with limits, then in this one.

A damaged or hostile file can take gigabytes, hang, or end the process that opens it. The limits grow with the
size of the file.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from app.common.limited_process import ProcessLimits, run_limited
from app.robot.address import is_live, parse_address
from pipeline.io.readers import Source, SourceOptions, check_existence, is_cloud
from pipeline.io.readers import open_source as _open_source
from pipeline.simulation.scenarios import SCHEME, parse_uri

if TYPE_CHECKING:
    from pipeline.types.records import WholeCloud


def check_address(uri: str) -> bool:
    """Check that a file or folder exists, and the form of the address of a live robot or a simulated run.
    Nothing is opened.

    Returns:
        Whether it is a file or folder, or has an unknown scheme.

    Raises:
        StemmapError: It does not exist, or the address is wrong.
    """
    if is_live(uri):
        parse_address(uri)
    elif uri.startswith(SCHEME) and not Path(uri).exists():
        parse_uri(uri)
    else:
        check_existence(uri)
        return True
    return False


def open_source(uri: str, options: SourceOptions | None = None) -> Source:
    """Open a run, see `pipeline.io.readers.open_source`. A file or folder is first opened in a child process,
    so that it is read twice.

    Raises:
        SourceError: It cannot be read, or takes more time or memory than a file of its size should.
    """
    if is_cloud(uri):
        open_cloud(uri)
    else:
        _check(lambda: _open_source(uri, options).truth(), uri)
    return _open_source(uri, options)


def open_cloud(uri: str) -> WholeCloud:
    """Open a whole cloud, see `pipeline.io.readers.clouds.open_cloud`; first in a child process.

    Raises:
        SourceError: As for `open_source`.
    """
    from pipeline.io.readers.clouds import open_cloud as _open_cloud

    _check(lambda: _open_cloud(uri), uri)
    return _open_cloud(uri)


def check_cloud(uri: str) -> None:
    """Open a whole cloud only in a child process.

    Raises:
        SourceError: As for `open_source`.
    """
    from pipeline.io.readers.clouds import open_cloud as _open_cloud

    _check(lambda: _open_cloud(uri), uri)


def _check(opening: Callable[[], object], uri: str) -> None:
    """Run an opening in a child process if the source is a file or a folder; otherwise do nothing. Raises
    SourceError if it fails or exceeds its limits."""
    size = _size(uri)
    if size is not None:
        run_limited(opening, ProcessLimits.for_size(size), uri)


def _size(uri: str) -> int | None:
    """Return the size of a file, or of all files in a folder [bytes]; None if there is no such path, as for a
    simulated run."""
    with contextlib.suppress(OSError, ValueError, RuntimeError):
        path = Path(uri.removeprefix("file:").removeprefix("//")).expanduser()
        if path.is_dir():
            return sum(inside.stat().st_size for inside in path.rglob("*") if inside.is_file())
        return path.stat().st_size
    return None
