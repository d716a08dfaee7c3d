"""Fits the random forest of the package: `python -m tests.benchmarks.package_forest --out FILE`.

Real scans come from STEMMAP_DATA. The examples of each scene are stored in the folder STEMMAP_EXAMPLES.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from app.store.forests import write_forest
from tests.benchmarks.package_forest import (
    COPIES,
    STAND_SEEDS,
    STREET,
    STREET_SEEDS,
    UPRIGHT_SEEDS,
    WILD_SEEDS,
    training_examples,
)
from tests.benchmarks.package_forest.fit import as_json, fit_all

PARKS = ("00", "02", "04", "06")  # two scenes are held out for scores


def main() -> None:
    """Collect the examples, fit the forest, and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="JSON file of the forest")
    parser.add_argument("--seed", type=int, default=0, help="random seed (default: 0)")
    arguments = parser.parse_args()
    examples, pasted = training_examples(PARKS)
    stands = [
        f"sim:{name}, seeds {','.join(map(str, seeds))}{lean}, every second one furnished"
        for seeds, lean in ((STAND_SEEDS, ""), (UPRIGHT_SEEDS, " without lean"))
        for name in ("stand", "slope", "dense")
    ]
    scenes = [
        *stands,
        f"sim:wild, {len(WILD_SEEDS)} seeds from {WILD_SEEDS[0]}",
        f"{len(STREET_SEEDS)} streets and parks",
        *(*PARKS, STREET.name),
        *(f"{park}, {COPIES} copies with things pasted in" for park in PARKS),
    ]
    write_forest(as_json(fit_all(examples, pasted, seed=arguments.seed), scenes), arguments.out)
    print(f"{len(examples)} sets of examples, written to {arguments.out}")


if __name__ == "__main__":
    main()
