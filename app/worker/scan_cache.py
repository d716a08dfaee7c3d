"""Where a run keeps what its scans showed, so that the next opening of the recording finds it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from app.robot.source import LiveSource
from pipeline.io.readers.base import Source
from pipeline.remapping import KeptScans, name_of

Keep = Callable[[Source, str, int], KeptScans]

_LARGE = Path("/var/tmp")  # noqa: S108 - the system's other place may be memory; the file has no name


def keep_without_name(_source: Source, _odometry: str, _seed: int) -> KeptScans:
    """For as long as the run is open."""
    return KeptScans(_LARGE if _LARGE.is_dir() else None)


def keep_in(folder: Path) -> Keep:
    """In a folder for all recordings, or without a name where the source has no digest or is a robot's.

    Args:
        folder: Made when it is needed.
    """

    def keep(source: Source, odometry: str, seed: int) -> KeptScans:
        digest = source.description.digest
        if not digest or isinstance(source, LiveSource):
            return keep_without_name(source, odometry, seed)
        name = name_of(folder, digest, f"{source.description.uri}\n{odometry}\n{seed}")
        return KeptScans(folder, name=name)

    return keep
