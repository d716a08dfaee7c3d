"""What people added to the recording of a run on the page, for the commands that read the run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from app.store.store import Store

T = TypeVar("T")


def stored_on_page(run: Path, read: Callable[[Store, dict[str, Any]], T]) -> T | None:
    """Return what a function reads of the database for the recording of a run; None without a database.

    Args:
        run: Folder of the run.
        read: The function; its arguments are the store and the member `source` of run.json.

    Raises:
        StemmapError: The run or the database cannot be read.
    """
    import os

    from app.batch.run_folder import read_run_record
    from app.common.settings import data_folder
    from app.store.database import FILE_NAME

    folder = data_folder(os.environ)
    if folder is None or not (folder / FILE_NAME).is_file():
        return None
    from app.store.store import Store

    store = Store(folder)
    try:
        return read(store, read_run_record(run)["source"])
    finally:
        store.close()


@contextmanager
def reviewed(run: Path) -> Iterator[Path]:
    """Yield the folder of a run, or a temporary one in which trees.csv has the reviews that people made on
    the page (see `reviewed_run`); the number of rejected trees is then printed to standard error. A path that
    is not a folder is yielded unchecked.

    Raises:
        StemmapError: The run or the database cannot be read.
    """
    import sys

    from app.batch.run_edits import reviewed_run, stored_reviews
    from app.batch.run_folder import read_run
    from app.common.text import count

    contents = stored_on_page(run, stored_reviews) if run.is_dir() else None
    with reviewed_run(run, contents) as folder:
        if folder != run and (rejected := len(read_run(folder).rejected.number)):
            print(f"review: {count(rejected, 'tree')} rejected on the page left out", file=sys.stderr)
        yield folder
