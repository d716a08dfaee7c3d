"""Sources of records: `open_source` opens a file, a folder or a URI."""

from __future__ import annotations

import re
from pathlib import Path

from pipeline.errors import SourceError, UsageError
from pipeline.io.readers.base import Source, SourceDescription, SourceOptions
from pipeline.io.readers.format_detection import (
    READABLE,
    Opener,
    expected_format,
    file_format,
    folder_opener,
    named,
    recordings_in,
)

__all__ = ["Source", "SourceDescription", "SourceOptions", "open_source"]

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+]+):")
_LIVE = ("udp", "tcp", "ros2")


def open_source(uri: str, options: SourceOptions | None = None) -> Source:
    """Open a run to be read.

    Args:
        uri: A simulated scenario ("sim:stand"), a file or a folder. The format is detected by the contents
            first, then by the name.
        options: Choices of the user.

    Raises:
        SourceError: It does not exist, has an unknown format, or is damaged.
    """
    chosen = options or SourceOptions()
    scheme = _SCHEME.match(uri)
    try:
        if scheme is not None and not Path(uri).exists():
            return _open_scheme(scheme.group(1).lower(), uri, chosen)
        path = Path(uri).expanduser()
        return _opener(path, uri)(uri, path, chosen)
    except RuntimeError as error:  # the home folder of an unknown user
        raise SourceError("there is no such user", where=uri, remedy="Look at the path.") from error
    except (OSError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or "too large for the memory of this machine"
        raise SourceError(
            f"cannot open: {reason}", where=uri, remedy="Look at the path and its rights."
        ) from error


def _open_scheme(scheme: str, uri: str, options: SourceOptions) -> Source:
    if scheme == "sim":
        from pipeline.io.readers.simulated import open_simulated

        return open_simulated(uri, options)
    if scheme == "file":
        return open_source(uri[len("file:") :].removeprefix("//"), options)
    if scheme in ("zenoh", "velodyne", "dds"):
        raise SourceError("a live robot cannot be read as a file", where=uri, remedy="Watch it or map it.")
    if scheme in _LIVE:
        raise SourceError(
            f"this version does not read {scheme}: live",
            where=uri,
            remedy="ROS 2 is heard over Zenoh, as zenoh:tcp/host:7447; or record it and open the file.",
        )
    raise UsageError(f"unknown kind of source {scheme!r}", where=uri, remedy=f"Readable are: {READABLE}.")


def _opener(path: Path, uri: str) -> Opener:
    if "\0" in uri or not path.exists():
        raise SourceError("there is no such file or folder", where=uri, remedy=f"Readable are: {READABLE}.")
    if path.is_dir():
        opener = folder_opener(path)
        if opener is None:
            inside = named(recordings_in(path))
            raise SourceError(
                "the folder is no run" if inside else "nothing in the folder can be read",
                where=uri,
                remedy=f"Open what is in it: {inside}." if inside else f"Readable are: {READABLE}.",
            )
        return opener
    if not path.is_file():
        raise SourceError("neither a file nor a folder", where=uri, remedy=f"Readable are: {READABLE}.")
    with path.open("rb") as file:
        head = file.read(16)
    if not head:
        raise SourceError("the file is empty", where=uri, remedy="Copy the file again, or record it again.")
    kind = file_format(path, head)
    if kind is None:
        promised = expected_format(path)
        what = f"the contents are not those of a {promised.words} file" if promised else "unknown format"
        raise SourceError(what, where=uri, remedy=f"Readable are: {READABLE}.")
    return kind.open
