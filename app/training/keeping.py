"""Keeping: examples on disk, because simulating many scenes takes minutes."""

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


def kept_or_made(folder: Path | None, name: str, make: Callable[[], Iterable[Examples]]) -> list[Examples]:
    """The examples of a scene from the folder, where a name stands for them, or made now and put there (None:
    kept nowhere)."""
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
    """All examples of a folder, scene after scene."""
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
            f"the kept examples are damaged: {error}",
            where=str(file),
            remedy="Remove the file: it is made anew",
        ) from None


def _check_sizes(file: Path) -> None:
    """Every array lies whole in the file, as numpy writes it: else a few bytes could ask for gigabytes.

    Raises:
        ValueError: One does not.
    """
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            with archive.open(entry) as text:
                if np.lib.format.read_magic(text) != (1, 0):
                    raise ValueError(f"{entry.filename} is of another version")
                shape, _, dtype = np.lib.format.read_array_header_1_0(text)
            packed = entry.compress_type != zipfile.ZIP_STORED
            if packed or math.prod(shape) * dtype.itemsize > entry.file_size:
                raise ValueError(f"{entry.filename} does not lie in the file")
