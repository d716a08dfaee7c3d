"""Training examples: voxel columns with their true class, and their storage on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import StemmapError
from pipeline.io.atomic_files import write_beside
from pipeline.io.checkpoints import record_bytes, record_of
from pipeline.types.records import CLASSES, Float, Int, Verdict

#: Suffix of the files of examples.
SUFFIX = ".examples"
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
        all_around: Which random forest classifies the columns, see `is_seen_all_around`.
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
    """Return the number of the object of each example of all sets, in their order, int64, shape (N,).
    Examples of one set with the same x, y of `axis` belong to one object; objects are numbered from 0 in the
    order of their first example."""
    key = [
        (scene, float(x), float(y))
        for scene, each in enumerate(examples)
        for x, y in each.axis[:, :2].tolist()
    ]
    known: dict[tuple[int, float, float], int] = {}
    return np.array([known.setdefault(each, len(known)) for each in key], np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class _StoredExamples:
    """Content of a file of examples."""

    sets: tuple[Examples, ...]


def stored_or_computed(
    folder: Path | None, name: str, make: Callable[[], Iterable[Examples]]
) -> list[Examples]:
    """Return the examples of a scene from the folder, or compute and store them.

    Args:
        folder: Folder of the examples, which is created; None stores nothing.
        name: Name of the scene, which must contain everything on which the examples depend.
        make: Computes the examples; only called if none are stored.

    Raises:
        StemmapError: The stored examples are damaged, or the new ones cannot be written.
        OSError: The folder cannot be created.
    """
    file = None if folder is None else folder / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}{SUFFIX}"
    if file is not None and file.is_file():
        return read_examples(file)
    made = list(make())
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        with write_beside(file) as partial:
            partial.write_bytes(record_bytes(_StoredExamples(tuple(made))))
    return made


def read_examples(file: Path) -> list[Examples]:
    """Return the examples of a file that `stored_or_computed` wrote; raises StemmapError if it is missing or
    damaged."""
    try:
        return list(record_of(_StoredExamples, file.read_bytes()).sets)
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise StemmapError(
            f"the stored examples are damaged: {error}",
            where=str(file),
            remedy="Delete the file; it will be computed again",
        ) from None
