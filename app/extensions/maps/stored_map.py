"""The stored map of a run folder, or of the small file that `stemmap pack` writes."""

from __future__ import annotations

from pathlib import Path
from stat import S_ISREG

import numpy as np

from app.batch.run_folder import read_run, read_terrain
from app.cli.stored import reviewed
from app.extensions.maps.localisation import StoredMap
from app.extensions.maps.localisation.stored_map import A_MAP, LARGEST_FILE
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import write_beside


def read_stored_map(path: Path) -> StoredMap:
    """Return the map of a run folder, without the trees that a person rejected, or of a file of
    `stemmap pack`.

    Raises:
        StemmapError: The folder or file cannot be read, or is not a stored map.
    """
    content = b""
    try:
        path = path.expanduser()
        is_run, is_folder = (path / "run.json").is_file(), path.is_dir()
        if not is_folder and S_ISREG(path.stat().st_mode):  # a device or a pipe may have no end
            with path.open("rb") as file:
                content = file.read(LARGEST_FILE)  # a larger file is no stored map
    except (FileNotFoundError, ValueError, RuntimeError):  # no path, or "~name" of an unknown user
        raise StemmapError("there is no such folder or file", where=str(path), remedy=A_MAP) from None
    except OSError as error:
        raise StemmapError(f"cannot read it: {error.strerror}", where=str(path), remedy=A_MAP) from None
    if is_folder and not is_run:
        raise StemmapError("this folder has no mapped run", where=str(path), remedy=A_MAP)
    if not is_run:
        return StoredMap.of_bytes(content, str(path))
    with reviewed(path) as folder:
        trees = read_run(folder).trees
    terrain = read_terrain(path) if (path / "terrain.csv").is_file() else np.zeros((0, 3))
    return StoredMap.of(trees, terrain)


def write_stored_map(stored: StoredMap, file: Path) -> int:
    """Write a map as a small file; return its size [bytes].

    Raises:
        StemmapError: The file cannot be written.
    """
    content = stored.as_bytes()
    with write_beside(file) as partial:
        partial.write_bytes(content)
    return len(content)
