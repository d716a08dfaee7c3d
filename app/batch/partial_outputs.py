"""What `stemmap map` and `export` left in the data folders when they were killed: half a map, in a folder of
its own that begins with a dot. Nothing of it can be gone on with; the recording is mapped again instead."""

from __future__ import annotations

import contextlib
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from app.common.settings import Settings
from app.store.records import UnknownError
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import UNFINISHED, is_held
from pipeline.io.result_files import ROWS

_MOST = 100
# A folder that was written to so lately may belong to a run that goes on.
QUIET_S = 600.0


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A folder that was left.

    Attributes:
        name: Path from the data folder.
        size: Of its files [bytes].
        changed_s: When something was last written there [s since 1970].
        quiet: Whether nobody writes there, as far as can be seen, so that it can be taken away.
    """

    name: str
    size: int
    changed_s: int
    quiet: bool


def unfinished(settings: Settings, now_s: float | None = None) -> list[Unfinished]:
    """What lies in the data folders, the newest first."""
    now_s = time.time() if now_s is None else now_s
    told = [_told(path, name, now_s) for name, path in _found(settings).items()]
    return sorted((each for each in told if each is not None), key=lambda each: -each.changed_s)


def delete(name: str, settings: Settings, now_s: float | None = None) -> None:
    """Take one away.

    Raises:
        UnknownError: There is none of this name.
        StemmapError: It was written to lately, or cannot be deleted.
    """
    path = _found(settings).get(name)
    told = None if path is None else _told(path, name, time.time() if now_s is None else now_s)
    if path is None or told is None:
        raise UnknownError("there is no such unfinished run in the data folder", where=name[:200])
    if is_held(path / ROWS):
        raise StemmapError(
            "a stemmap is writing there", where=name, remedy="Wait until it is done, or end it first"
        )
    if not told.quiet:
        raise StemmapError(
            "it was written to within the last ten minutes",
            where=name,
            remedy="If no stemmap writes there any more, delete it in a while",
        )
    try:
        shutil.rmtree(path)
    except OSError as error:
        raise StemmapError(f"it cannot be deleted: {error.strerror}", where=name) from None


def left_in(folder: Path) -> list[str]:
    """What to say of the halves of maps in a folder that is to be written to, a line each."""
    return [
        f"{path} is left of a run that was ended before its map was whole: delete it, unless another stemmap "
        "is writing there"
        for path in _inside(folder)
    ]


def _found(settings: Settings) -> dict[str, Path]:
    """Folders by their path from the data folder; what is reached by links is left alone."""
    found: dict[str, Path] = {}
    for folder in settings.data_folders:
        for path in [*_inside(folder), *(each for run in _folders(folder) for each in _inside(run))]:
            found.setdefault(path.relative_to(folder).as_posix(), path)
    return dict(list(found.items())[:_MOST])


def _inside(folder: Path) -> list[Path]:
    return [path for path in _folders(folder) if path.name.startswith(UNFINISHED)]


def _folders(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.is_dir() and not path.is_symlink())
    except OSError:
        return []


def _told(path: Path, name: str, now_s: float) -> Unfinished | None:
    """None when it went just now."""
    with contextlib.suppress(OSError):
        stats = [path.stat(), *(file.lstat() for file in path.iterdir())]
        changed = max(stat.st_mtime for stat in stats)
        size = sum(stat.st_size for stat in stats[1:])
        quiet = now_s - changed > QUIET_S and not is_held(path / ROWS)
        return Unfinished(name, size, int(changed), quiet)
    return None
