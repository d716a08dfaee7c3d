"""The stored map of a run folder, or of the small file that `stemmap pack` writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from app.batch.run_folder import read_run, read_terrain
from app.cli.stored import reviewed
from app.extensions.maps.localisation import StoredMap
from app.extensions.maps.localisation.stored_map import LARGEST_FILE
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import write_beside


def read_stored_map(path: Path) -> StoredMap:
    """Return the map of a run folder, without the trees that a person rejected, or of a file of
    `stemmap pack`.

    Raises:
        StemmapError: The folder or file cannot be read.
    """
    if path.is_dir():
        with reviewed(path) as folder:
            trees = read_run(folder).trees
        terrain = read_terrain(path) if (path / "terrain.csv").is_file() else np.zeros((0, 3))
        return StoredMap.of(trees, terrain)
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise StemmapError("the file is larger than 64 MB", where=str(path))
        content = path.read_bytes()
    except OSError as error:
        raise StemmapError(
            f"there is no map: {error.strerror}",
            where=str(path),
            remedy="Name a folder that `stemmap map` wrote, or a file of `stemmap pack`",
        ) from None
    return StoredMap.of_bytes(content, str(path))


def write_stored_map(stored: StoredMap, file: Path) -> int:
    """Write a map as a small file; return its size [bytes].

    Raises:
        StemmapError: The file cannot be written.
    """
    content = stored.as_bytes()
    with write_beside(file) as partial:
        partial.write_bytes(content)
    return len(content)
