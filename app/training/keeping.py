"""Stores training examples on disk, because simulating many scenes takes minutes."""

from __future__ import annotations

import hashlib
import math
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from app.training.fit_forest import Examples
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import write_beside


def stored_or_computed(
    folder: Path | None, name: str, make: Callable[[], Iterable[Examples]]
) -> list[Examples]:
    """Return the examples of a scene from the folder, or compute and store them.

    Args:
        folder: Folder of the examples; None stores nothing.
        name: Name of the scene, which must contain everything on which the examples depend.
        make: Computes the examples.

    Raises:
        StemmapError: The stored examples are damaged.
    """
    file = None if folder is None else folder / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.npz"
    if file is not None and file.is_file():
        return _read(file)
    made = list(make())
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        columns = {
            f"{name}{k}": getattr(e, name)
            for k, e in enumerate(made)
            for name in ("axis", "figures", "label")
        }
        with write_beside(file) as partial, partial.open("wb") as out:
            np.savez(
                out,
                scene=made[0].scene,
                simulated=made[0].simulated,
                all_around=made[0].all_around,
                sets=len(made),
                **columns,
            )
    return made


def read_examples(folder: Path) -> list[Examples]:
    """Return all examples of a folder."""
    return [e for file in sorted(folder.glob("*.npz")) for e in _read(file)]


def _read(file: Path) -> list[Examples]:
    try:
        _check_sizes(file)
        with np.load(file, allow_pickle=False) as kept:
            scene, simulated = str(kept["scene"]), bool(kept["simulated"])
            around = bool(kept["all_around"])
            return [
                Examples(scene, simulated, around, kept[f"axis{k}"], kept[f"figures{k}"], kept[f"label{k}"])
                for k in range(int(kept["sets"]))
            ]
    except (zipfile.BadZipFile, OSError, ValueError, KeyError, TypeError, EOFError) as error:
        raise StemmapError(
            f"the stored examples are damaged: {error}",
            where=str(file),
            remedy="Delete the file; it will be computed again",
        ) from None


def _check_sizes(file: Path) -> None:
    """Check that each array is complete and uncompressed, because a few bytes could otherwise claim
    gigabytes.

    Raises:
        ValueError: An array is not.
    """
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            with archive.open(entry) as text:
                if np.lib.format.read_magic(text) != (1, 0):
                    raise ValueError(f"{entry.filename} is of another version")
                shape, _, dtype = np.lib.format.read_array_header_1_0(text)
            packed = entry.compress_type != zipfile.ZIP_STORED
            if packed or math.prod(shape) * dtype.itemsize > entry.file_size:
                raise ValueError(f"{entry.filename} is not complete")
