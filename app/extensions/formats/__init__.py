"""The extension `formats`: readers of files that few have."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from app.extension import Extension

if TYPE_CHECKING:
    from pipeline.io.readers import Format, Source, SourceOptions


def _open_victoria_park(uri: str, path: Path, options: SourceOptions) -> Source:
    """Open the archive; errors are those of the reader."""
    from app.extensions.formats.victoria_park import VictoriaParkSource

    return VictoriaParkSource(uri, path, options)


def _formats() -> tuple[Format, ...]:
    """Return the formats."""
    from pipeline.io.readers import Format

    words = "Victoria Park .zip (LASER.txt, DRS.txt)"
    return (Format(words, (b"PK\x03\x04",), (".zip",), _open_victoria_park),)


EXTENSION = Extension(help="readers of rare files: the archive of Victoria Park", formats=_formats)
