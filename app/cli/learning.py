"""`stemmap train --annotations`: decision trees that learn from what was annotated in the dashboard."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.choices import plain
from app.common.text import count
from pipeline.errors import StemmapError, UsageError

if TYPE_CHECKING:
    from app.store.store import Store
    from app.training.annotated_runs import AnnotatedRun


def learn_from_annotations(names: list[str], out: Path | None, seed: int) -> int:
    """Learn, print the table of old against new, and keep the new decision trees. Nothing uses them yet.

    Args:
        names: Runs as they were opened, or as the dashboard calls them; none for all.
        out: File to write; None for the data folder.
        seed: Of every random number.
    """
    from contextlib import closing

    from app.common.settings import from_environment
    from app.store.store import Store
    from app.training.learned_forests import Forests, name_of, write_forest
    from app.training.learning import Asked, learn
    from app.training.table import table_lines
    from pipeline.config import preset

    settings = from_environment()
    if settings.folder is None and not settings.database:
        raise StemmapError("there is no data folder with annotations", remedy="Name it with STEMMAP_FOLDER")
    if out is not None and not out.absolute().parent.is_dir():
        raise StemmapError("there is no such folder to write to", where=str(out.parent))
    with closing(Store(settings.folder, database=settings.database)) as store:
        runs = _chosen(store, names)
    forests = Forests(settings.folder)
    asked = Asked(
        in_force=preset("forest").classification,
        forests=forests,
        seen=(),
        seed=seed,
        date=time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime()),
        kept=settings.folder and settings.folder / "examples",
        progress=lambda words: print(plain(words), file=sys.stderr) if sys.stderr.isatty() else None,
    )
    learned = learn(runs, asked)
    for line in table_lines(learned):
        print(plain(line))
    for warning in learned.warnings:
        print(f"warning: {plain(warning)}", file=sys.stderr)
    if out is None:
        name = forests.keep(learned.data)
        print(f"kept as {name}: use them with --set classification.forest={name}")
    else:
        write_forest(learned.data, out)
        print(f"{name_of(learned.data)}, written to {out}")
    return 0


def _chosen(store: Store, names: list[str]) -> list[AnnotatedRun]:
    from app.training.annotated_runs import annotated_run

    sources = store.annotated_sources()
    known = {word: source for source in sources for word in (source.source, source.request.uri, source.name)}
    unknown = [name for name in names if name not in known and str(Path(name).absolute()) not in known]
    if unknown:
        told = ", ".join(source.name for source in sources[:10]) or "none"
        raise UsageError(
            f"nobody annotated a run {unknown[0]!r}",
            remedy=f"{count(len(sources), 'annotated run')}: {told}",
        )
    if not sources:
        raise StemmapError(
            "nothing was annotated yet", remedy="Open a run with `stemmap RUN` and its tab Annotate"
        )
    wanted = [known.get(name) or known[str(Path(name).absolute())] for name in names] or sources
    return [annotated_run(source) for source in {source.source: source for source in wanted}.values()]
