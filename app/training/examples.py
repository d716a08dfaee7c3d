"""Training examples: voxel columns with their true class, and their storage on disk."""

from __future__ import annotations

import hashlib
import math
import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.classification.forest import CLASSES
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import write_beside
from pipeline.types.records import Float, Int, Verdict

UNKNOWN = -1
TREE = CLASSES.index(Verdict.TREE)
POLE = CLASSES.index(Verdict.POLE)
UPRIGHT = (POLE, CLASSES.index(Verdict.PERSON))


@dataclass(frozen=True, slots=True, eq=False)
class Examples:
    """Columns of one scene with their true class.

    Attributes:
        scene: Name of the scene. All examples of a scene are used for training, or all for validation.
        simulated: Whether the scene is simulated.
        all_around: Whether its sensor sees all around.
        axis: Axes of the columns, shape (N, 5), see `find_columns`.
        figures: Features, shape (N, features).
        label: Index in CLASSES, UNKNOWN where the class cannot be decided, int64, shape (N,).
    """

    scene: str
    simulated: bool
    all_around: bool
    axis: Float
    figures: Float
    label: Int


def object_numbers(examples: Sequence[Examples]) -> Int:
    """Return a number from 0 on for each example of all sets in their order, int64, shape (N,), equal for all
    examples of one object, that is of one position in one set."""
    key = [
        (scene, float(x), float(y))
        for scene, each in enumerate(examples)
        for x, y in each.axis[:, :2].tolist()
    ]
    known: dict[tuple[int, float, float], int] = {}
    return np.array([known.setdefault(each, len(known)) for each in key], np.int64)


def stored_or_computed(
    folder: Path | None, name: str, make: Callable[[], Iterable[Examples]]
) -> list[Examples]:
    """Return the examples of a scene from the folder, or compute and store them.

    Args:
        folder: Folder of the examples, which is created; None stores nothing.
        name: Name of the scene, which must contain everything on which the examples depend.
        make: Computes the examples, at least one set, all of one scene; only called if none are stored.

    Raises:
        StemmapError: The stored examples are damaged, or cannot be written.
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
    """Return all examples of the .npz files in a folder, by file name; [] without files.

    Raises:
        StemmapError: A file is damaged.
    """
    return [e for file in sorted(folder.glob("*.npz")) for e in _read(file)]


def _read(file: Path) -> list[Examples]:
    """Return the examples of a file; raises StemmapError if it is damaged. Pickled objects are refused."""
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
