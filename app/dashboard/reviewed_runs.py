"""Runs of the store with the reviews of their trees by the present annotations."""

from __future__ import annotations

from typing import Any

import numpy as np

from app.batch.reviews import reviews_of
from app.store.async_store import AsyncStore
from app.store.records import Content
from app.store.store import Store
from pipeline.io.result_files import OPEN, REJECTED


class ReviewedRuns:
    """Reads the runs of the store. Numbers of rejected trees are kept until the run or the annotations of its
    recording change.

    Args:
        store: Asynchronous access to the store.
    """

    def __init__(self, store: AsyncStore) -> None:
        self._store = store
        self._rejected: dict[int, tuple[tuple[int, int], int]] = {}

    async def listed(self) -> list[dict[str, Any]]:
        """Return the runs as `RunRecords.listed`, each with `annotated`, the number of annotations of its
        recording. `trees` does not count the trees that a person rejected."""
        rows, annotated, versions = await self._store.ask(
            lambda store: (store.book.listed(), store.annotation_counts(), store.annotation_versions())
        )
        contents: dict[str, list[Content]] = {}
        for row in rows:
            row["annotated"] = annotated.get(row["run"], 0)
            if row["annotated"]:
                row["trees"] -= await self._rejected_trees(row, versions[row["run"]], contents)
        self._rejected = {row["id"]: self._rejected[row["id"]] for row in rows if row["id"] in self._rejected}
        return rows

    async def whole(self, number: int) -> dict[str, Any]:
        """Return a run as `RunRecords.whole`. Each tree of its map has its `review`; `trees` does not count
        those that a person rejected, and `rejected` is their number. Raises UnknownError for an unknown
        number."""
        return await self._store.ask(lambda store: _reviewed(store, number))

    async def _rejected_trees(
        self, row: dict[str, Any], version: int, contents: dict[str, list[Content]]
    ) -> int:
        """Return the number of rejected trees of a run.

        Args:
            row: The run.
            version: Version of the annotations of its recording, see `Store.annotation_versions`.
            contents: Dict from recordings to their annotations, which is completed.
        """
        number, state = row["id"], (row["changed_ns"], version)
        if number not in self._rejected or self._rejected[number][0] != state:

            def count(store: Store) -> int:
                source = row["source"]
                if source not in contents:
                    contents[source] = store.contents(source)
                return rejected(_reviews(store.book.trees(number), contents[source]))

            self._rejected[number] = state, await self._store.ask(count)
        return self._rejected[number][1]


def rejected(reviews: dict[int, str]) -> int:
    """Return the number of rejected trees in a result of `reviews_of`."""
    return sum(review == REJECTED for review in reviews.values())


def _reviews(trees: list[dict[str, Any]], contents: list[Content]) -> dict[int, str]:
    """Return the result of `reviews_of` for the trees of a stored map."""
    position = np.array([(tree["x"], tree["y"]) for tree in trees], np.float64).reshape(-1, 2)
    return reviews_of([tree["number"] for tree in trees], position, contents)


def _reviewed(store: Store, number: int) -> dict[str, Any]:
    """Return a run, see `ReviewedRuns.whole`."""
    row = store.book.whole(number)
    trees = row["map"]["trees"]
    reviews = _reviews(trees, store.contents(row["source"]))
    for tree in trees:
        tree["review"] = reviews.get(tree["number"], OPEN)
    return {**row, "trees": len(trees) - rejected(reviews), "rejected": rejected(reviews)}
