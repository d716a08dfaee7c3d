"""The random forest of the package: its training examples, and its fit to them.

`python -m tests.benchmarks holdout` fits forests to the same examples without the place that it scores.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from app.common.settings import data_folder
from app.extensions.learning.examples import Examples, stored_or_computed
from pipeline.config import preset
from pipeline.errors import StemmapError
from tests.benchmarks.package_forest.augmentation import FOLDER, copies
from tests.benchmarks.package_forest.labelled_scenes import (
    labelled_examples,
    stand_examples,
    stand_name,
    street_examples,
)

DATA = Path(os.environ.get("STEMMAP_DATA", "../shared/data"))
PARKS = ("00", "02", "03", "04", "07", "06")
STREET = DATA / "semantickitti" / "000000.bin"
STAND_SEEDS, UPRIGHT_SEEDS, EVERY = range(11, 17), range(31, 37), 4
STREET_SEEDS, WILD_SEEDS = range(200, 240), range(200, 224)
REACH = 25.0  # m
COPIES = 8  # of each park scene with inserted objects


def training_examples(names: Sequence[str] = PARKS) -> tuple[list[Examples], list[Examples]]:
    """Examples of all simulated and labelled scenes, and of the copies with inserted objects; stored in the
    data folder, or in the folder STEMMAP_EXAMPLES. `names` are the park scenes that are used."""
    kept = examples_folder()
    p, found = preset("forest"), list[Examples]()
    for uri, furnished, upright in _stands():
        make = partial(stand_examples, uri, p, EVERY, furnished=furnished, upright=upright)
        found += stored_or_computed(kept, stand_name(uri, furnished, upright), make)
    for seed in WILD_SEEDS:
        uri = f"sim:wild?seed={seed}&odometry=exact"
        found += stored_or_computed(kept, uri, partial(stand_examples, uri, p, EVERY))
    for seed in STREET_SEEDS:
        for one_way in (False, True):
            make = partial(street_examples, seed, one_way, p, REACH)
            found += stored_or_computed(kept, f"{'park' if one_way else 'street'} {seed}", make)
    parks = [DATA / "park_trunks" / name for name in names]
    for scene in (*parks, STREET):
        found += stored_or_computed(kept, str(scene), partial(labelled_examples, scene, p, REACH))
    return found, [e for scene in parks for e in copies(scene, kept / FOLDER, p, REACH, COPIES)]


def examples_folder() -> Path:
    """Folder in which the examples of training scenes are stored."""
    if named := os.environ.get("STEMMAP_EXAMPLES"):
        return Path(named)
    folder = data_folder(os.environ)
    if folder is None:
        raise StemmapError("there is no data folder", remedy="Set STEMMAP_EXAMPLES to a folder")
    return folder / "training"


def _stands() -> Iterator[tuple[str, bool, bool]]:
    """The simulated stands, and for each whether it has more objects that are not trees (every second one)
    and stems without lean."""
    sigma = ("0.02", "0.03", "0.01")
    for seeds, upright in ((STAND_SEEDS, False), (UPRIGHT_SEEDS, True)):
        for name in ("stand", "slope", "dense"):
            for n, seed in enumerate(seeds):
                yield f"sim:{name}?seed={seed}&odometry=exact&sigma={sigma[n % 3]}", n % 2 == 1, upright
