"""`stemmap train`: trains the random forest that classifies the columns, from scenes or from annotations."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.flags import plain
from app.cli.flags import seed as whole_seed
from app.common.text import count
from pipeline.errors import StemmapError, UsageError

if TYPE_CHECKING:
    from app.store.store import Store
    from app.training.annotated_runs import AnnotatedRun
    from app.training.examples import Examples

HELP = "train the random forest that classifies trees"
SCENES = "stand,slope,dense"
SEEDS = "11,12,13,14,15,16,17,18"
STREETS, WILD_STANDS, FIRST = 80, 24, 200  # numbers of scenes, and the seed of the first of each kind
COPIES = 48
REACH = 25.0  # m, of labelled scans


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "places",
        metavar="SOURCE",
        nargs="*",
        help="labelled scans of one place (velodyne/*.bin, labels/*.label), or one .bin with its .label; "
        "with --annotations annotated runs (default: all)",
    )
    parser.add_argument(
        "--annotations",
        action="store_true",
        help="extend the forest of the package with the annotations of the dashboard, and print the "
        "scores of the present and the new forest on objects that were not used for training",
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        help="JSON file to write (default with --annotations: the data folder)",
    )
    parser.add_argument("--seed", type=whole_seed, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument("--scenes", default=SCENES, help=f"simulated scenes (default: {SCENES})")
    parser.add_argument(
        "--seeds",
        default=SEEDS,
        help=f"seeds of the simulated scenes; every second one has more objects (default: {SEEDS})",
    )
    parser.add_argument(
        "--streets", type=int, default=STREETS, help=f"number of simulated streets (default: {STREETS})"
    )
    parser.add_argument(
        "--wild", type=int, default=WILD_STANDS, help=f"number of stands of sim:wild (default: {WILD_STANDS})"
    )
    parser.add_argument(
        "--copies", type=int, default=COPIES, help=f"copies of each one-way scene (default: {COPIES})"
    )
    parser.add_argument("--every", type=int, default=4, help="use every N-th simulated scan (default: 4)")
    parser.add_argument(
        "--examples",
        metavar="DIR",
        type=Path,
        help="folder that stores the examples of each scene, so that they are computed once",
    )


def run(arguments: argparse.Namespace) -> int:
    """Collect examples, print the scores on scenes that are left out, and write the forest. With
    --annotations, annotated runs are used instead of scenes.

    Returns:
        0.

    Raises:
        StemmapError: --out is missing without --annotations, its folder or labelled scans do not exist, or
            there are no or too few examples.
    """
    if arguments.annotations:
        return learn_from_annotations(arguments.places, arguments.out, arguments.seed)
    if arguments.out is None:
        raise UsageError("--out is missing", remedy="Add --out FILE")
    arguments.labelled = [Path(place) for place in arguments.places]
    from app.store.forests import write_forest
    from app.training.fit_forest import as_json, fit_all
    from app.training.validation import leave_one_out
    from pipeline.config import preset

    _look_for(arguments)
    examples = _examples(arguments)
    if not examples:
        raise StemmapError("there are no examples", remedy="Name scenes, or folders with labelled scans")
    pasted = _pasted(arguments)
    for line in leave_one_out(examples, pasted, preset("forest").classification.tree_share):
        print(line)
    scenes = _scenes(arguments)
    write_forest(as_json(fit_all(examples, pasted, seed=arguments.seed), scenes), arguments.out)
    print(f"{len(examples)} sets of examples, written to {arguments.out}")
    return 0


def _look_for(arguments: argparse.Namespace) -> None:
    """Check that the folder of --out and the labelled scans exist, before scenes are simulated for an hour.

    Raises:
        StemmapError: One does not exist.
    """
    if not arguments.out.absolute().parent.is_dir():
        raise StemmapError("the folder for --out does not exist", where=str(arguments.out.parent))
    for place in arguments.labelled:
        files = [place.with_suffix(".label")] if place.is_file() else [place / "velodyne", place / "labels"]
        missing = [file for file in files if not file.exists()]
        if missing:
            raise StemmapError(
                "there are no labelled scans", where=str(place), remedy=f"{missing[0]} is missing"
            )


def _scenes(arguments: argparse.Namespace) -> list[str]:
    """Return a description of the training data for the JSON file."""
    stands = [name for name in arguments.scenes.split(",") if name]
    names = [f"sim:{name}, seeds {arguments.seeds}, every second one furnished" for name in stands]
    copied = [
        f"{folder.name}, {arguments.copies} copies with things pasted in" for folder in _one_way(arguments)
    ]
    labelled = [folder.name for folder in arguments.labelled]
    wild = f"sim:wild, {arguments.wild} seeds from {FIRST}"
    return [*names, wild, f"{arguments.streets} streets and parks", *labelled, *copied]


def _examples(arguments: argparse.Namespace) -> list[Examples]:
    """Return the examples of all scenes, stored or computed: simulated stands, sim:wild, streets and parks,
    and labelled scans."""
    from functools import partial

    from app.training.examples import stored_or_computed
    from app.training.labelled_scenes import labelled_examples, stand_examples, stand_name, street_examples
    from pipeline.config import preset

    forest = preset("forest")
    names = [name for name in arguments.scenes.split(",") if name]
    sigma = ("0.02", "0.03", "0.01")
    found: list[Examples] = []
    for name in names:
        for n, seed in enumerate(arguments.seeds.split(",")):
            uri, furnished = f"sim:{name}?seed={seed}&odometry=exact&sigma={sigma[n % 3]}", n % 2 == 1
            make = partial(stand_examples, uri, forest, arguments.every, furnished=furnished)
            found += stored_or_computed(arguments.examples, stand_name(uri, furnished), make)
    for seed in range(FIRST, FIRST + arguments.wild):
        uri = f"sim:wild?seed={seed}&odometry=exact"
        make = partial(stand_examples, uri, forest, arguments.every)
        found += stored_or_computed(arguments.examples, uri, make)
    for seed in range(FIRST, FIRST + arguments.streets):
        # Parks seen by a forward-looking sensor also serve the sensors that see all around.
        for one_way in (False, True):
            make = partial(street_examples, seed, one_way, forest, REACH)
            found += stored_or_computed(arguments.examples, f"{'park' if one_way else 'street'} {seed}", make)
    for folder in arguments.labelled:
        found += stored_or_computed(
            arguments.examples, str(folder), partial(labelled_examples, folder, forest, REACH)
        )
    return found


def _pasted(arguments: argparse.Namespace) -> list[Examples]:
    """Return the examples of copies of the labelled forward-looking scans with additional poles and trees."""
    from app.training.augmentation import FOLDER, copies
    from pipeline.config import preset

    kept = None if arguments.examples is None else arguments.examples / FOLDER
    forest = preset("forest")
    return [
        e for folder in _one_way(arguments) for e in copies(folder, kept, forest, REACH, arguments.copies)
    ]


def _one_way(arguments: argparse.Namespace) -> list[Path]:
    """Return the labelled scans of forward-looking sensors; opens each of them."""
    from app.training.labelled_scenes import looks_all_around

    return [folder for folder in arguments.labelled if not looks_all_around(folder)]


# --- from annotations ------------------------------------------------------------


def learn_from_annotations(names: list[str], out: Path | None, seed: int) -> int:
    """Train a random forest with annotations, print its scores and those of the present one, and write it;
    return 0. Warnings and progress go to standard error.

    Args:
        names: Annotated runs by URI or by their name in the dashboard; empty for all.
        out: File to write; None for the data folder.
        seed: Random seed.

    Raises:
        StemmapError: There is no data folder, a run is unknown, the folder for `out` does not exist, or there
            are too few annotations.
    """
    from contextlib import closing

    from app.common.settings import from_environment
    from app.store.forests import Forests, name_of, write_forest
    from app.store.store import Store
    from app.training.learning import learn, table_lines
    from pipeline.config import preset

    settings = from_environment()
    if settings.folder is None:
        raise StemmapError("there is no data folder with annotations", remedy="Set STEMMAP_FOLDER")
    if out is not None and not out.absolute().parent.is_dir():
        raise StemmapError("the folder for --out does not exist", where=str(out.parent))
    with closing(Store(settings.folder)) as store:
        runs = _chosen(store, names)
    learned = learn(
        runs,
        preset("forest").classification,
        settings.folder,
        date=time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime()),
        seed=seed,
        progress=lambda words: print(plain(words), file=sys.stderr) if sys.stderr.isatty() else None,
    )
    for line in table_lines(learned):
        print(plain(line))
    for warning in learned.warnings:
        print(f"warning: {plain(warning)}", file=sys.stderr)
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
    from app.training.annotated_runs import annotated_run

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
