"""Folders of `stemmap map` that lie in the data folders: found here, and read in a process of their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from app.common.settings import Settings
from app.sources import sandbox
from app.store.records import UnknownError

_MOST = 500


def finished_folders(settings: Settings) -> dict[str, Path]:
    """By name; of two with one name the first. Links that lead out of the data folders are left out."""
    found: dict[str, Path] = {}
    for folder in settings.data_folders:
        try:
            paths = sorted(path for path in folder.iterdir() if _is_finished(path, folder))
        except OSError:
            continue
        for path in paths:
            found.setdefault(path.name, path)
    return dict(list(found.items())[:_MOST])


async def read_folder(name: str, settings: Settings) -> dict[str, Any]:
    """The run in a folder.

    Raises:
        UnknownError: There is no such folder.
        StemmapError: It cannot be read.
    """
    path = finished_folders(settings).get(name)
    if path is None:
        raise UnknownError("there is no such run in the data folder", where=name[:200])
    return {**await sandbox.ask({"ask": "finished", "path": str(path)}), "name": name}


def _is_finished(path: Path, folder: Path) -> bool:
    try:
        if path.name.startswith(".") or not path.resolve().is_relative_to(folder.resolve()):
            return False
        return (path / "run.json").is_file() and (path / "trees.csv").is_file()
    except OSError:
        return False
