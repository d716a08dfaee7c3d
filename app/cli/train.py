"""`stemmap train`: the decision trees behind the verdicts, made anew."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.choices import seed as whole_seed
from pipeline.errors import StemmapError, UsageError

if TYPE_CHECKING:
    from app.training.fit_forest import Examples

HELP = "make the decision trees anew that say what is a tree"
SCENES = "stand,slope,dense"
SEEDS = "11,12,13,14,15,16,17,18"
STREETS, FIRST_STREET = 80, 200  # and the seed of the first
REACH = 25.0  # m, of labelled scans


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "places",
        metavar="SOURCE",
        nargs="*",
        help="scans of one place (velodyne/*.bin, labels/*.label), or one .bin with its .label beside it; "
        "with --annotations runs that were annotated (default: all that were)",
    )
    parser.add_argument(
        "--annotations",
        action="store_true",
        help="let the decision trees of the package learn from what was annotated in the dashboard, and show "
        "what old and new ones are worth on things that they did not see",
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        help="JSON file to write (with --annotations: into the data folder, to be used by its name)",
    )
    parser.add_argument(
        "--seed", type=whole_seed, default=0, metavar="N", help="of every random number (default: 0)"
    )
    parser.add_argument("--scenes", default=SCENES, help=f"simulated scenes (default: {SCENES})")
    parser.add_argument(
        "--seeds",
        default=SEEDS,
        help=f"of the simulated scenes, every second one with more furniture (default: {SEEDS})",
    )
    parser.add_argument(
        "--streets", type=int, default=STREETS, help=f"simulated streets (default: {STREETS})"
    )
    parser.add_argument(
        "--every", type=int, default=4, help="make every so many-th simulated scan (default: 4)"
    )
    parser.add_argument(
        "--examples",
        metavar="DIR",
        type=Path,
        help="keep the examples of each scene here, and take them from here",
    )


def run(arguments: argparse.Namespace) -> int:
    """Gather examples, grow the trees, print what they are worth on scenes left out, write them."""
    if arguments.annotations:
        from app.cli.learning import learn_from_annotations

        return learn_from_annotations(arguments.places, arguments.out, arguments.seed)
    if arguments.out is None:
        raise UsageError("there is no file to write to", remedy="Name it with --out FILE")
    arguments.labelled = [Path(place) for place in arguments.places]
    from app.training.fit_forest import as_json, grow_all
    from app.training.learned_forests import write_forest
    from app.training.leave_one_out import leave_one_out
    from pipeline.config import preset

    _look_for(arguments)
    examples = _examples(arguments)
    if not examples:
        raise StemmapError("there is nothing to learn from", remedy="Name scenes, or folders with labels")
    pasted = _pasted(arguments)
    for line in leave_one_out(examples, pasted, preset("forest").classification.tree_share):
        print(line)
    scenes = _scenes(arguments)
    write_forest(as_json(grow_all(examples, pasted, seed=arguments.seed), scenes), arguments.out)
    print(f"{len(examples)} sets of examples, written to {arguments.out}")
    return 0


def _look_for(arguments: argparse.Namespace) -> None:
    """Say what is missing before scenes are simulated for an hour."""
    if not arguments.out.absolute().parent.is_dir():
        raise StemmapError("there is no such folder to write to", where=str(arguments.out.parent))
    for place in arguments.labelled:
        files = [place.with_suffix(".label")] if place.is_file() else [place / "velodyne", place / "labels"]
        missing = [file for file in files if not file.exists()]
        if missing:
            raise StemmapError(
                "there are no labelled scans", where=str(place), remedy=f"{missing[0]} is looked for"
            )


def _scenes(arguments: argparse.Namespace) -> list[str]:
    """What was learned from, in a few lines of the JSON."""
    from app.training.augmentation import COPIES

    stands = [name for name in arguments.scenes.split(",") if name]
    names = [f"sim:{name}, seeds {arguments.seeds}, every second one furnished" for name in stands]
    copied = [f"{folder.name}, {COPIES} copies with things pasted in" for folder in _one_way(arguments)]
    labelled = [folder.name for folder in arguments.labelled]
    return [*names, f"{arguments.streets} streets and parks", *labelled, *copied]


def _examples(arguments: argparse.Namespace) -> list[Examples]:
    from functools import partial

    from app.training.keeping import kept_or_made
    from app.training.scenes import labelled_examples, stand_examples, stand_name, street_examples
    from pipeline.config import preset

    forest = preset("forest")
    names = [name for name in arguments.scenes.split(",") if name]
    sigma = ("0.02", "0.03", "0.01")
    found: list[Examples] = []
    for name in names:
        for n, seed in enumerate(arguments.seeds.split(",")):
            uri, furnished = f"sim:{name}?seed={seed}&odometry=exact&sigma={sigma[n % 3]}", n % 2 == 1
            make = partial(stand_examples, uri, forest, arguments.every, furnished=furnished)
            found += kept_or_made(arguments.examples, stand_name(uri, furnished), make)
    for seed in range(FIRST_STREET, FIRST_STREET + arguments.streets):
        # Parks seen one way teach the all-around sensors too.
        for one_way in (False, True):
            make = partial(street_examples, seed, one_way, forest, REACH)
            found += kept_or_made(arguments.examples, f"{'park' if one_way else 'street'} {seed}", make)
    for folder in arguments.labelled:
        found += kept_or_made(
            arguments.examples, str(folder), partial(labelled_examples, folder, forest, REACH)
        )
    return found


def _pasted(arguments: argparse.Namespace) -> list[Examples]:
    """The labelled scans of sensors that look one way once more, with poles and trees pasted into them."""
    from app.training.augmentation import FOLDER, copies
    from pipeline.config import preset

    kept = None if arguments.examples is None else arguments.examples / FOLDER
    forest = preset("forest")
    return [e for folder in _one_way(arguments) for e in copies(folder, kept, forest, REACH)]


def _one_way(arguments: argparse.Namespace) -> list[Path]:
    """The labelled scans of sensors that look one way."""
    from app.training.scenes import looks_all_around

    return [folder for folder in arguments.labelled if not looks_all_around(folder)]
