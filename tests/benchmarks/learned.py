"""Effect of annotations of simulated streets and parks: `python -m tests.benchmarks.learned`.

Every column of the scenes counts as annotated; scenes are left out as wholes, see
`app.extensions.learning.learning`.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from app.extensions.learning.examples import UNKNOWN, Examples
from app.extensions.learning.learning import Rates, validate
from pipeline.classification.forest import ALL_AROUND, CLASSES, FILE, ONE_WAY, read_forests, standard_forest
from pipeline.config import Parameters, preset
from pipeline.types.records import Verdict
from tests.benchmarks.package_forest.labelled_scenes import street_examples

REACH = 25.0  # m
APART = 1000.0  # m between two scenes, each of which begins at the origin


def main() -> None:
    """Print found and false trees of the random forest of the package, and of the refined forest."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--one-way", action="store_true", help="a sensor that looks one way")
    parser.add_argument("--first", type=int, default=400, help="seed of the first scene")
    parser.add_argument("--scenes", type=int, default=20)
    asked = parser.parse_args()
    p, kind = preset("forest"), ONE_WAY if asked.one_way else ALL_AROUND
    scenes = [_annotated(k, asked.first + k, asked.one_way, p) for k in range(asked.scenes)]
    base, (old,) = read_forests(FILE, kind)
    told = validate(
        scenes, base, kind, standard_forest(not asked.one_way), p.classification.tree_share, seed=0
    )
    print(f"{told.folds} parts, no {told.by} in two of them; {len(old.trees.root)} decision trees")
    print(f"old: {_words(told.old)}\nnew: {_words(told.new)}")


def _annotated(place: int, seed: int, one_way: bool, parameters: Parameters) -> Examples:
    last = list(street_examples(seed, one_way, parameters, REACH))[-1]
    sure = (last.label != UNKNOWN) & (last.label != CLASSES.index(Verdict.OTHER))
    axis = last.axis[sure].copy()
    axis[:, 0] += APART * place
    return replace(last, axis=axis, figures=last.figures[sure], label=last.label[sure])


def _words(rates: Rates) -> str:
    return f"{rates.TA.count} of {rates.TA.of} trees, {rates.FA.count} false of {rates.FA.of}"


if __name__ == "__main__":
    main()
