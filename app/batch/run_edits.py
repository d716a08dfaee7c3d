"""What people add to a run: reviews of its trees, and the reference system of its map.

A review decides whether a mapped tree is a tree in the figures and files that are handed in. The map is not
changed. An annotation of a class other than "tree" rejects the mapped tree at its place.
"""

from __future__ import annotations

import csv
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from app.batch.run_folder import BY_PEOPLE_COLUMNS, ByPeople, crs_unit, read_run
from app.store.records import FRAME, KINDS, SKIPPED, Content, as_truth
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float
from pipeline.io.atomic_files import write_texts
from pipeline.io.result_files import (
    BY_PEOPLE,
    CONFIRMED,
    OPEN,
    REJECTED,
    TREE_COLUMNS,
    csv_in_units,
    csv_text,
    number_text,
)

if TYPE_CHECKING:
    from app.store.store import Store

# Largest distance between an annotation and the same object in a map or a ground truth [m].
SAME_THING = 0.5
# Reviews by the class of the annotation.
_STATES = {**dict.fromkeys(KINDS, REJECTED), "tree": CONFIRMED, SKIPPED: SKIPPED}
# What figures and exports of a run need, besides its trees.
_FILES = ("path.csv", "terrain.csv", "seen.csv", "run.json", "georeference.json")


def reviews_of(numbers: Sequence[int], position: Float, contents: Iterable[Content]) -> dict[int, str]:
    """Return a dict from the number of each reviewed tree to its review: CONFIRMED for the class "tree",
    REJECTED for another class, SKIPPED if no annotation of the tree states a class.

    A tree has at most one annotation. It is one to which no other tree is nearer, and nearer than `reach_of`
    it: the nearest one that states a class, of equally near ones the last. The others belong to no tree. The
    page has the same rule (`paired` in static/js/annotate/annotations.js).

    Args:
        numbers, position: Numbers of the trees, and their positions in the map, shape (T, 2) [m].
        contents: The annotations in the same frame; plots and frames are ignored.
    """
    reviews = [content for content in contents if content.kind in _STATES]
    of_tree = annotation_of_tree(position, reviews)
    return {numbers[row]: _STATES[reviews[k].kind] for row, k in of_tree.items()}


def annotation_of_tree(position: Float, reviews: Sequence[Content]) -> dict[int, int]:
    """Return a dict from the row of each tree that has an annotation to the index of it, see `reviews_of`."""
    from scipy.spatial import cKDTree

    if not reviews or not len(position):
        return {}
    distance, row = cKDTree(position).query([(content.x, content.y) for content in reviews])
    states_class = np.array([content.kind != SKIPPED for content in reviews])
    order = np.lexsort((-distance, states_class))  # the one that counts comes last
    return {int(row[k]): int(k) for k in order if distance[k] < reach_of(reviews[k])}


def reach_of(content: Content) -> float:
    """Return the distance below which an annotation can be about a mapped tree [m]: SAME_THING or, of a
    rejection, its reach. Two trees this near are often two copies of one stem, so that a confirmation holds
    for the copy that a later map has."""
    return SAME_THING if content.reach is None or content.kind == "tree" else content.reach


def reach_at(position: Float, place: tuple[float, float]) -> float | None:
    """Return the distance below which a rejection that is made now can be about a mapped tree [m]; None for
    SAME_THING.

    A rejection is about the nearest tree. In a later map without that tree, it must not belong to the second
    nearest one. The limit is the mean of the distances of both.

    Args:
        position: Positions of the trees that are mapped now, shape (T, 2) [m].
        place: Position of the annotation [m].
    """
    nearest = np.sort(np.hypot(*(position - place).T))[:2]
    if len(nearest) < 2 or nearest[0] >= SAME_THING:
        return None
    reach = float(nearest.mean())
    return reach if reach < SAME_THING else None


def measured_by_people(numbers: Sequence[int], position: Float, contents: Iterable[Content]) -> ByPeople:
    """Return what people measured. An annotation that decides the review of a tree has its diameter; every
    other one of the class "tree" is a tree that the map lacks, as a twin stem or a stem beside a rejected
    stake.

    Args:
        numbers, position, contents: See `reviews_of`.
    """
    reviews = [content for content in contents if content.kind in _STATES]
    of_tree = annotation_of_tree(position, reviews)
    stated = as_truth(reviews)
    is_tree = np.array([content.kind == "tree" for content in reviews], np.bool_)
    measured = is_tree & np.isfinite(stated.dbh)
    tape = {numbers[row]: float(stated.dbh[k]) for row, k in of_tree.items() if measured[k]}
    added = np.setdiff1d(np.flatnonzero(is_tree), list(of_tree.values()))
    return ByPeople(tape, np.stack([stated.x, stated.y], axis=1)[added], stated.dbh[added])


def by_people_text(people: ByPeople, numbers: Sequence[int], position: Float) -> str:
    """Return the text of by_people.csv; "" without rows.

    Args:
        people: What people measured, in the coordinates of the files.
        numbers, position: Numbers and positions of the trees, see `reviews_of`, in these coordinates.
    """
    places = dict(zip(numbers, position.tolist(), strict=True))
    rows = [(str(number), *places[number], dbh) for number, dbh in sorted(people.tape.items())]
    rows += [("", *place, dbh) for place, dbh in zip(people.added.tolist(), people.added_dbh, strict=True)]
    cells = [
        (name, number_text(x, 3), number_text(y, 3), number_text(100.0 * d, 1)) for name, x, y, d in rows
    ]
    return csv_text(BY_PEOPLE_COLUMNS, cells) if cells else ""


def stored_reviews(store: Store, source: Mapping[str, Any]) -> list[Content] | None:
    """Return the annotations of a recording that review trees, in the frame of the map; None if it never had
    an annotation in this store, so that the reviews in the files of a run are those of another machine.

    Args:
        store: The store.
        source: Member `source` of run.json.
    """
    if not store.was_reviewed(key := recording_key(source)):
        return None
    return [content for content in store.contents(key) if content.kind in (*KINDS, SKIPPED)]


@contextmanager
def reviewed_run(folder: FilePath, contents: Sequence[Content] | None) -> Iterator[FilePath]:
    """Yield a folder with the run of `folder` in which trees.csv has the reviews by annotations of its
    recording, and no others, and by_people.csv what people measured; the folder itself if there are neither
    annotations nor reviews. A temporary folder is removed afterwards; errors name `folder` instead.

    Args:
        folder: Folder that `stemmap map` wrote.
        contents: Annotations in the frame of the map; None yields `folder` unchecked.

    Raises:
        StemmapError: A file of the run is missing or damaged.
    """
    if contents is None:
        yield folder
        return
    run = read_run(folder)  # checks the files
    reviewed = len(run.rejected.number) or {*run.reviews.values()} - {OPEN}
    if not (contents or reviewed or (folder / BY_PEOPLE).is_file()):
        yield folder
        return
    offset = run.record["source"].get("offset_m", (0.0, 0.0))
    placed = [replace(each, x=each.x + offset[0], y=each.y + offset[1]) for each in contents]
    text = (folder / "trees.csv").read_text(encoding="utf-8")
    if text.startswith("tree,x,"):
        text = csv_in_units(text, crs_unit(run.record), to_metres=True)
    rows = list(csv.DictReader(text.splitlines()))
    numbers = [int(float(row["tree"])) for row in rows]
    position = np.array([(float(row["x_m"]), float(row["y_m"])) for row in rows]).reshape(-1, 2)
    reviews = reviews_of(numbers, position, placed)
    texts = [
        [{**row, "review": reviews.get(number, OPEN)}.get(name, "") for name in TREE_COLUMNS]
        for number, row in zip(numbers, rows, strict=True)
    ]
    with TemporaryDirectory(prefix="stemmap-run-") as there:
        for name in _FILES:
            if (folder / name).is_file():
                shutil.copy2(folder / name, FilePath(there) / name)  # with its date, which the report states
        written = {"trees.csv": csv_text(TREE_COLUMNS, texts)}
        if measured := by_people_text(measured_by_people(numbers, position, placed), numbers, position):
            written[BY_PEOPLE] = measured
        write_texts(FilePath(there), written)
        try:
            yield FilePath(there)
        except StemmapError as error:
            where = error.where.replace(there, str(folder))
            raise type(error)(error.what, where=where, remedy=error.remedy) from error


def recording_key(source: Mapping[str, Any]) -> str:
    """Return the key of a recording in the store, from the member `source` of run.json."""
    return str(source.get("sha256") or source.get("uri"))


def stored_frame(store: Store, source: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the reference system that the store has for a recording, in the form of `MapFrame.record`; None
    if there is none.

    Args:
        store: The store.
        source: Member `source` of run.json.
    """
    contents = store.contents(recording_key(source), FRAME)
    return contents[0].values["frame"] if contents and contents[0].values else None
