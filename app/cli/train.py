"""`stemmap train`: the decision trees behind the verdicts, made anew."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import StemmapError

if TYPE_CHECKING:
    from app.training.growing import Examples

HELP = "make the decision trees anew that say what is a tree"
SCENES = "stand,slope,dense"
SEEDS = "11,12,13,14,15,16,17,18"
STREETS, FIRST_STREET = 80, 200  # and the seed of the first
REACH = 25.0  # m, of labelled scans


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "labelled",
        metavar="FOLDER",
        type=Path,
        nargs="*",
        help="scans of one place (velodyne/*.bin, labels/*.label), or one .bin with its .label beside it",
    )
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help="JSON file to write")
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
    from app.training.growing import PLANS, as_json, can_grow, grow
    from app.training.judging import leave_one_out
    from pipeline.files import write_beside
    from pipeline.parameters import preset

    _look_for(arguments)
    examples = _examples(arguments)
    if not examples:
        raise StemmapError("there is nothing to learn from", remedy="Name scenes, or folders with labels")
    for line in leave_one_out(examples, preset("forest").gathering.tree_share):
        print(line)
    scenes = _scenes(arguments)
    grown = {kind: grow(examples, kind) for kind in PLANS if can_grow(examples, kind)}
    text = json.dumps(as_json(grown, scenes), separators=(",", ":"))
    with write_beside(arguments.out) as file:
        file.write_text(text.replace('{"figure"', '\n{"figure"') + "\n", encoding="utf-8")
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
    stands = [name for name in arguments.scenes.split(",") if name]
    names = [f"sim:{name}, seeds {arguments.seeds}, every second one furnished" for name in stands]
    return [*names, f"{arguments.streets} streets and parks", *(folder.name for folder in arguments.labelled)]


def _examples(arguments: argparse.Namespace) -> list[Examples]:
    from functools import partial

    from app.training.keeping import kept_or_made
    from app.training.scenes import labelled_examples, stand_examples, stand_name, street_examples
    from pipeline.parameters import preset

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
