"""The runs in the data folders: finished ones, and partial outputs.

`stemmap map` and `export` write to a folder whose name begins with a dot, and rename it at the end. When they
are killed, this partial output remains. It cannot be continued; it can be deleted here.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from app.common.settings import Settings
from app.sources import inspection
from app.store.records import UnknownError
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import UNFINISHED, is_held
from pipeline.io.result_files import ROWS

_FINISHED_LIMIT = 500
_PARTIAL_LIMIT = 100
QUIET_S = 600.0  # a folder that was written to more recently may belong to a running process


def finished_folders(settings: Settings) -> dict[str, Path]:
    """Return the folders of finished runs by name; of two with the same name the first. Links that point
    outside of the data folders are left out."""
    found: dict[str, Path] = {}
    for folder in settings.data_folders:
        try:
            paths = sorted(path for path in folder.iterdir() if _is_finished(path, folder))
        except OSError:
            continue
        for path in paths:
            found.setdefault(path.name, path)
    return dict(list(found.items())[:_FINISHED_LIMIT])


async def read_folder(name: str, settings: Settings) -> dict[str, Any]:
    """Return a finished run, read in a child process.

    Args:
        name: Name in `finished_folders`.
        settings: Settings of the deployment.

    Raises:
        UnknownError: There is no such folder.
        StemmapError: It cannot be read.
    """
    path = finished_folders(settings).get(name)
    if path is None:
        raise UnknownError("there is no such run in the data folders", where=name[:200])
    return {**await inspection.ask({"ask": "finished", "path": str(path)}), "name": name}


def _is_finished(path: Path, folder: Path) -> bool:
    try:
        if path.name.startswith(".") or not path.resolve().is_relative_to(folder.resolve()):
            return False
        return (path / "run.json").is_file() and (path / "trees.csv").is_file()
    except OSError:
        return False


@dataclass(frozen=True, slots=True)
class PartialOutput:
    """A folder that a killed process left.

    Attributes:
        name: Path relative to the data folder.
        size: Size of its files [bytes].
        changed_s: Time of the last change [s since 1970].
        quiet: Whether it can be deleted, because no process writes to it.
    """

    name: str
    size: int
    changed_s: int
    quiet: bool


def partial_outputs(settings: Settings, now_s: float | None = None) -> list[PartialOutput]:
    """Return the partial outputs in the data folders, the newest first.

    Args:
        settings: Settings of the deployment.
        now_s: Present time [s since 1970]; None for the system time.
    """
    now_s = time.time() if now_s is None else now_s
    found = [_described(path, name, now_s) for name, path in _partial_folders(settings).items()]
    return sorted((each for each in found if each is not None), key=lambda each: -each.changed_s)


def delete_partial_output(name: str, settings: Settings, now_s: float | None = None) -> None:
    """Delete a partial output.

    Args:
        name: Its path relative to the data folder.
        settings: Settings of the deployment.
        now_s: Present time [s since 1970]; None for the system time.

    Raises:
        UnknownError: There is none of this name.
        StemmapError: A process may still write to it, or it cannot be deleted.
    """
    path = _partial_folders(settings).get(name)
    output = None if path is None else _described(path, name, time.time() if now_s is None else now_s)
    if path is None or output is None:
        raise UnknownError("there is no such partial output in the data folders", where=name[:200])
    if is_held(path / ROWS):
        raise StemmapError(
            "a stemmap process writes to it", where=name, remedy="Wait until it has ended, or end it"
        )
    if not output.quiet:
        raise StemmapError(
            "it was written to within the last ten minutes",
            where=name,
            remedy="If no stemmap process writes to it any more, delete it later",
        )
    try:
        shutil.rmtree(path)
    except OSError as error:
        raise StemmapError(f"it cannot be deleted: {error.strerror}", where=name) from None


def partial_output_warnings(folder: Path) -> list[str]:
    """Return a warning for each partial output in a folder."""
    return [
        f"{path} is the partial output of a run that was killed: delete it, unless another stemmap process "
        "writes to it"
        for path in _inside(folder)
    ]


def _partial_folders(settings: Settings) -> dict[str, Path]:
    """Folders by their path relative to the data folder, without links."""
    found: dict[str, Path] = {}
    for folder in settings.data_folders:
        for path in [*_inside(folder), *(each for run in _folders(folder) for each in _inside(run))]:
            found.setdefault(path.relative_to(folder).as_posix(), path)
    return dict(list(found.items())[:_PARTIAL_LIMIT])


def _inside(folder: Path) -> list[Path]:
    return [path for path in _folders(folder) if path.name.startswith(UNFINISHED)]


def _folders(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.is_dir() and not path.is_symlink())
    except OSError:
        return []


def _described(path: Path, name: str, now_s: float) -> PartialOutput | None:
    """Return the description of a partial output; None if it has just been deleted."""
    with contextlib.suppress(OSError):
        stats = [path.stat(), *(file.lstat() for file in path.iterdir())]
        changed = max(stat.st_mtime for stat in stats)
        size = sum(stat.st_size for stat in stats[1:])
        quiet = now_s - changed > QUIET_S and not is_held(path / ROWS)
        return PartialOutput(name, size, int(changed), quiet)
    return None
