"""`stemmap train`: trains the random forest that classifies the columns with annotations."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.flags import plain, print_warnings
from app.cli.flags import seed as whole_seed
from app.common.text import count
from pipeline.errors import StemmapError, UsageError

if TYPE_CHECKING:
    from app.extensions.learning.examples import AnnotatedRun
    from app.store.store import Store

HELP = "extend the random forest that classifies trees with annotations"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("runs", metavar="RUN", nargs="*", help="annotated runs by URI or name (default: all)")
    parser.add_argument(
        "--out", metavar="FILE", type=Path, help="JSON file to write (default: in the data folder)"
    )
    parser.add_argument("--seed", type=whole_seed, default=0, metavar="N", help="random seed (default: 0)")
    parser.epilog = "Prints the scores of the present and the new forest on objects that were not used."


def run(arguments: argparse.Namespace) -> int:
    """Train a forest with the annotations of the runs that the arguments name by URI or by their name in the
    dashboard (all without any), print its scores and those of the forest of the preset "forest", and write it
    to `--out`, or without it to the data folder; return 0. Warnings and, on a terminal, progress go to
    standard error.

    Raises:
        StemmapError: There is no data folder, a run is unknown, the folder for `--out` does not exist, there
            are too few annotations, or a file cannot be read or written; see also `learn`.
    """
    from contextlib import closing

    from app.common.settings import from_environment
    from app.extensions.learning.learning import learn, table_lines
    from app.store.forests import Forests, name_of, write_forest
    from app.store.store import Store
    from pipeline.config import preset

    settings, out = from_environment(), arguments.out
    if settings.folder is None:
        raise StemmapError("there is no data folder with annotations", remedy="Set STEMMAP_FOLDER")
    if out is not None and not out.absolute().parent.is_dir():
        raise StemmapError("the folder for --out does not exist", where=str(out.parent))
    with closing(Store(settings.folder)) as store:
        runs = _chosen(store, arguments.runs)
    learned = learn(
        runs,
        preset("forest").classification,
        settings.folder,
        seed=arguments.seed,
        progress=lambda words: print(plain(words), file=sys.stderr) if sys.stderr.isatty() else None,
    )
    for line in table_lines(learned):
        print(plain(line))
    print_warnings(learned.warnings)
    if out is None:
        name = Forests(settings.folder).keep(learned.data)
        print(f"stored as {name}; use it with --set classification.forest={name}")
    else:
        write_forest(learned.data, out)
        print(f"{name_of(learned.data)}, written to {out}")
    return 0


def _chosen(store: Store, names: list[str]) -> list[AnnotatedRun]:
    """Return the annotated runs of the names, each once, or all of them.

    Args:
        store: The store.
        names: Digest, URI, path or file name of each run; empty for all. A file name that several runs share
            stands for one of them.

    Raises:
        UsageError: A name is unknown.
        StemmapError: There are no annotations at all.
    """
    from app.extensions.learning.examples import annotated_run

    sources = store.annotated_sources()
    known = {word: source for source in sources for word in (source.source, source.request.uri, source.name)}
    unknown = [name for name in names if name not in known and str(Path(name).absolute()) not in known]
    if unknown:
        names_known = ", ".join(source.name for source in sources[:10]) or "none"
        raise UsageError(
            f"there is no annotated run {unknown[0]!r}",
            remedy=f"{count(len(sources), 'annotated run')}: {names_known}",
        )
    if not sources:
        raise StemmapError(
            "there are no annotations",
            remedy="Open a run with `stemmap RUN` and annotate trees in the tab Annotate",
        )
    wanted = [known.get(name) or known[str(Path(name).absolute())] for name in names] or sources
    return [annotated_run(source) for source in {source.source: source for source in wanted}.values()]
