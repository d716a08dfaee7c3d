"""Training examples: voxel columns with their true class, their storage on disk, and their collection from
annotated runs, which are mapped again as they were mapped before."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from app.common.text import version
from app.robot.source import LiveSource, open_any
from app.sources.one_step import is_one_step
from app.sources.request import SourceRequest, with_odometry
from app.store.records import Content
from app.store.store import AnnotatedSource
from pipeline.classification.features import COUNT, NAMES
from pipeline.classification.forest import PACKAGE, is_seen_all_around
from pipeline.config import PRESETS, Parameters, preset
from pipeline.errors import ParameterError, SourceError, StemmapError
from pipeline.io.atomic_files import write_beside
from pipeline.io.checkpoints import record_bytes, record_of
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.types.records import CLASSES, Columns, Float, Int, Verdict

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


# --- annotated runs ---------------------------------------------------------------------------------

# Numbers of observations at which an object gives an example, because trees are classified from the first
# scans on.
SEEN = (3, 10, 30)
# Largest distance between an annotation and its column [m].
REACH = {"tree": 0.4, "pole": 0.35, "person": 0.5, "bush": 0.9, "other": 0.9}
CLASS_OF_KIND = {kind: CLASSES.index(Verdict[kind.upper()]) for kind in REACH}


class ExampleCollector:
    """Collects the features of the columns at annotations, scan by scan.

    Args:
        annotations: Annotations of the run, in the frame of its map; their kinds are keys of REACH.
    """

    def __init__(self, annotations: Sequence[Content]) -> None:
        from scipy.spatial import cKDTree

        self._annotations = annotations
        self._place = np.array([[a.x, a.y] for a in annotations]).reshape(-1, 2)
        self._reach = np.array([REACH[a.kind] for a in annotations])
        self._nearest = cKDTree(self._place) if len(annotations) else None
        self._marked: list[list[Float]] = [[] for _ in annotations]
        self._last: list[Float | None] = [None for _ in annotations]
        self._before: Columns | None = None

    def add(self, columns: Columns | None) -> None:
        """Add the columns after a scan. None, no columns, and the same object as in the last call are
        ignored.

        For each annotation, the features of its column (see `_pairs`) are copied as the newest ones. A
        further copy is stored once for each number of SEEN, in the first call in which the column was
        observed at least this number of times; at most one further copy is stored per call.
        """
        if columns is None or columns is self._before or self._nearest is None or not len(columns.axis):
            return
        self._before = columns
        for annotation, row in self._pairs(columns.axis[:, :2]):
            figures, marks = columns.figures[row].copy(), self._marked[annotation]
            self._last[annotation] = figures
            if len(marks) < len(SEEN) and columns.present[row] >= SEEN[len(marks)]:
                marks.append(figures)

    def examples(self, scene: str, *, all_around: bool) -> Examples:
        """Return the examples of all annotations with a column, so far. An annotation gives at most four:
        those after 3, 10 and 30 observations and the newest, which is the last. Annotations without a column
        give none.

        `axis` of an example is x, y of the annotation and three zeros, so that all examples of one object
        have the same.

        Args:
            scene: Name of the scene.
            all_around: Which random forest classifies the columns, see `is_seen_all_around`.
        """
        axis, rows, label = [], [], []
        for a, marked, last in zip(self._annotations, self._marked, self._last, strict=True):
            taken = [] if last is None else [*marked, last]
            rows += taken
            axis += [[a.x, a.y, 0.0, 0.0, 0.0]] * len(taken)
            label += [CLASS_OF_KIND[a.kind]] * len(taken)
        return Examples(
            scene,
            False,
            all_around,
            np.array(axis, np.float64).reshape(-1, 5),
            np.array(rows, np.float64).reshape(-1, COUNT),
            np.array(label, np.int64),
        )

    def _pairs(self, place: Float) -> list[tuple[int, int]]:
        """Return pairs (index of an annotation, row of its column), each annotation at most once. The column
        is the nearest one to the annotation, of the columns to which no other annotation is nearer and that
        are within REACH for the kind of the annotation.

        Args:
            place: Positions x, y of the columns in the map, shape (K, 2) [m].
        """
        assert self._nearest is not None  # noqa: S101 - `add` has checked
        distance, annotation = self._nearest.query(place)
        near = np.flatnonzero(distance <= self._reach[annotation])
        order = near[np.argsort(distance[near], kind="stable")]
        _, first = np.unique(annotation[order], return_index=True)
        return [(int(annotation[row]), int(row)) for row in order[first]]


Progress = Callable[[str], None]

PROGRESS_SCANS = 50  # scans between two progress messages


@dataclass(frozen=True, slots=True)
class AnnotatedRun:
    """An annotated run.

    Attributes:
        name, digest: Name and digest of the source.
        request: Source, odometry, seed, topics and mounting with which it was mapped.
        parameters: Parameters with which it was mapped.
        annotations: Annotations in the frame of its map.
    """

    name: str
    digest: str
    request: SourceRequest
    parameters: Parameters
    annotations: tuple[Content, ...]


def annotated_run(source: AnnotatedSource) -> AnnotatedRun:
    """Return the run of an annotated source, with its parameters: those of its preset ("forest" for an
    unknown one) with the changes of its request. Names that this version does not know are dropped; if it
    does not accept a value, all changes are dropped."""
    request = source.request
    start = preset(request.preset if request.preset in PRESETS else "forest")
    known = {name: value for name, value in request.parameters.items() if name in start.flat()}
    try:
        parameters = start.replace(known)
    except ParameterError:  # annotated with other bounds
        parameters = start
    return AnnotatedRun(source.name, source.source, request, parameters, source.annotations)


def examples_of(run: AnnotatedRun, kept: Path | None, progress: Progress) -> Examples:
    """Return the examples of a run: those stored in the folder, else the run is mapped and they are stored.

    Args:
        run: The run.
        kept: Folder of the examples; None stores nothing.
        progress: Called with a progress message every 50 scans while the run is mapped.

    Raises:
        SourceError: The run cannot be read, is live or no drive, or is another recording.
        StemmapError: The stored examples are damaged, or the examples cannot be written.
        OSError: The folder cannot be created.
    """
    (found,) = stored_or_computed(kept, _key(run), partial(_map_again, run, progress))
    return found


def _key(run: AnnotatedRun) -> str:
    """Return a SHA-256 (hex) of everything on which the examples depend: recording, choices, parameters,
    annotations, features and version."""
    parts = [
        run.digest,
        run.request.seed,
        run.request.odometry,
        run.request.kept_choices(),
        run.parameters.flat(),
        [[a.x, a.y, a.kind] for a in run.annotations],
        [*NAMES, *SEEN, *sorted(REACH.items())],
        version(),
    ]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _map_again(run: AnnotatedRun, progress: Progress) -> list[Examples]:
    """Map a run from its source, classified by columns whatever its method was, and return its examples as a
    list of one set.

    Args:
        run: The run.
        progress: Called with a progress message every 50 scans.

    Raises:
        SourceError: The run cannot be read, is live or no drive, or is another recording.
    """
    request = run.request
    if is_one_step(request.uri, request.options()):
        what = "it has no scans to learn from"
        raise SourceError(what, where=request.uri, remedy="Annotate a drive")
    with closing(open_any(request.uri, request.options())) as source:
        if isinstance(source, LiveSource):
            raise SourceError(
                "a live run cannot be mapped again", where=request.uri, remedy="Annotate its recording"
            )
        known = source.description
        if (known.digest or known.uri) != run.digest:
            raise SourceError("this is another recording than the annotated one", where=request.uri)
        moving, chosen = with_odometry(source, request.odometry)
        # Columns and features do not depend on the forest.
        parameters = run.parameters.replace(
            {"classification.method": "columns", "classification.forest": PACKAGE}
        )
        mapper = Mapper(
            parameters, sensor=known.sensor, T_base_lidar=known.T_base_lidar, seed=run.request.seed
        )
        collector = ExampleCollector(run.annotations)
        for step in steps(moving.records(), odometry=chosen.steps):
            collector.add(mapper.process(step).columns)
            if step.index % PROGRESS_SCANS == 0:
                of = f" of {known.scans:,}" if known.scans else ""
                progress(f"Mapping {run.name}: scan {step.index:,}{of}")
        xy = np.column_stack([mapper.path.x, mapper.path.y])
        return [collector.examples(run.name, all_around=is_seen_all_around(known.sensor.rings, xy))]
