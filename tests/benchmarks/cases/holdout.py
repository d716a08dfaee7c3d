"""Trees in places left out of the training of the classifier, whole clouds, and diameters compared with a
tape.

A place is left out of training as a whole. Park scenes 04 and 07 show the same trees from two positions: a
rigid motion brings 21 of their stems within 0.25 m of one another, and at most 5 stems of any other pair, as
many as of a mirrored scene. So they are one place.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tests.benchmarks.package_forest import DATA, REACH, STREET, training_examples
from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from app.extensions.clouds.records import CloudDescription, WholeCloud
    from app.extensions.clouds.terrain_raster import TerrainRaster
    from app.extensions.learning.examples import Examples
    from pipeline.classification.forest import Forest
    from pipeline.types.records import Float, Float32

NAME = "holdout"
LINE = "Trees in places left out of training, whole clouds, diameters by tape (needs STEMMAP_DATA)"

PARKS = (("00",), ("02",), ("03",), ("04", "07"), ("06",))
KEPT_ASIDE = ("01", "08")  # parks for this figure only, which are not used for training or for any choice
TRAINING_SEEDS = range(3)
RESAMPLES = 10_000
CUT = 4.0  # m; height above the ground at which clouds are cut off
LOW_CUTS = (3.0, 2.5, 2.0)  # m; phones and tablets see stems up to this height
THINNED = 0.3  # share of the points
THINNING_SEEDS = (0, 1)
SPREAD = 4.0  # cm; the reference DBH of a stem is used where the programs agree within this
MATCH = 0.5  # m


@dataclass(frozen=True, slots=True, eq=False)
class MappingResult:
    """Result in one scene.

    Attributes:
        found: Whether each true tree is in the map, shape (T,).
        false: Number of trees of the map that are no true tree; trees on a trunk with fewer than 30 labelled
        points are ignored.
        kinds: Number of false trees by class, which is that of most labelled points at the tree.
    """

    found: Float
    false: int
    kinds: Counter[str]


def run() -> list[Table]:
    """Detection in places left out, whole clouds, and trunk slices."""
    from pipeline.errors import StemmapError

    if not (DATA / "park_trunks").is_dir():
        raise StemmapError("there is no real data", where=str(DATA), remedy="Set STEMMAP_DATA")
    return [*_detection(), _whole_clouds(), _low_clouds(), _tape()]


def _detection() -> list[Table]:
    """Places left out of training, and the parks that were kept aside."""
    examples, pasted = training_examples()
    return [_left_out(examples, pasted), _kept_aside(examples, pasted)]


def _left_out(examples: list[Examples], pasted: list[Examples]) -> Table:
    rows, parks = list[tuple[Cell, ...]](), list[list[MappingResult]]()
    groups = [[DATA / "park_trunks" / name for name in names] for names in PARKS]
    for group in [*groups, [STREET]]:
        fitted = [_fitted_without(group, examples, pasted, seed) for seed in TRAINING_SEEDS]
        outcomes = [[_outcome(scene, forest) for forest in fitted] for scene in group]
        if group == [STREET]:
            rows += [_row("all parks", parks), _row("street", outcomes)]
        else:
            rows.append(_row(" and ".join(f"park {scene.name}" for scene in group), outcomes))
            parks += outcomes
    return _table("Trees in places left out of training, within 25 m", rows, parks)


def _kept_aside(examples: list[Examples], pasted: list[Examples]) -> Table:
    """The kept-aside parks, with the classifier of all other parks."""
    fitted = [_fitted_without([], examples, pasted, seed) for seed in TRAINING_SEEDS]
    outcomes = [[_outcome(DATA / "park_trunks" / name, f) for f in fitted] for name in KEPT_ASIDE]
    rows = [_row(f"park {name}", [of_park]) for name, of_park in zip(KEPT_ASIDE, outcomes, strict=True)]
    rows.append(_row("both", outcomes))
    return _table("Trees in parks kept aside, within 25 m", rows, outcomes)


def _table(title: str, rows: Sequence[tuple[Cell, ...]], parks: Sequence[Sequence[MappingResult]]) -> Table:
    """The table of rows of places, with the kinds of the false trees of parks."""
    columns = (
        "place", "found", "of", "false", "completeness [%]", "95 %", "correctness [%]", "95 %",
    )  # fmt: skip
    kinds = ", ".join(f"{n} {kind}" for kind, n in _kinds(parks).most_common())
    note = f"Sums over {len(TRAINING_SEEDS)} training seeds. False trees of the parks: {kinds}."
    intervals = (
        "95 %: bootstrap over trees; the results of the training seeds share their trees and are averaged."
    )
    return Table(title, columns, tuple(rows), (note, intervals))


def _row(name: str, scenes: Sequence[Sequence[MappingResult]]) -> tuple[Cell, ...]:
    """One row of the table from the results of scenes, each with every training seed."""
    hit, of, false = (
        sum(float(value(o)) for outcomes in scenes for o in outcomes)
        for value in (lambda o: o.found.sum(), lambda o: len(o.found), lambda o: o.false)
    )
    complete, correct = _intervals(scenes)
    return (
        name, int(hit), int(of), int(false), 100.0 * hit / of, complete,
        100.0 * hit / max(hit + false, 1.0), correct,
    )  # fmt: skip


def _intervals(scenes: Sequence[Sequence[MappingResult]]) -> tuple[str, str]:
    """95 % bootstrap intervals of completeness and correctness: true trees are drawn with replacement, the
    number of false trees from a Poisson distribution."""
    import numpy as np

    rng = np.random.default_rng(0)
    found = np.concatenate([np.mean([o.found for o in outcomes], axis=0) for outcomes in scenes])
    false = sum(o.false / len(outcomes) for outcomes in scenes for o in outcomes)
    hits = found[rng.integers(0, len(found), (RESAMPLES, len(found)))].sum(axis=1)
    rates = (hits / len(found), hits / np.maximum(hits + rng.poisson(false, RESAMPLES), 1.0))
    low_high = [np.percentile(100.0 * rate, (2.5, 97.5)) for rate in rates]
    complete, correct = (f"{low:.0f} to {high:.0f}" for low, high in low_high)
    return complete, correct


def _kinds(scenes: Sequence[Sequence[MappingResult]]) -> Counter[str]:
    return sum((o.kinds for outcomes in scenes for o in outcomes), Counter())


def _outcome(scene: Path, forest: Forest) -> MappingResult:
    """One scene mapped by the whole mapper."""
    import numpy as np

    from pipeline.evaluation import match
    from tests.benchmarks.classes import ByClass
    from tests.benchmarks.package_forest.labelled_scenes import labelled_points, trunks
    from tests.benchmarks.trunks import mapped

    frame, _, _ = mapped(str(scene), odometry="static", forest=forest)
    place = frame.trees.position[frame.trees.confirmed]
    points, label = labelled_points(scene)
    truth, any_trunk = trunks(points, label, 30, REACH), trunks(points, label, 1, np.inf)
    truth_of = match(place, truth, MATCH)
    nearest = np.hypot(*(place[:, None] - any_trunk[None]).transpose(2, 0, 1)).min(axis=1, initial=np.inf)
    # A tree of the map beyond the limit can be a true one within it, whose error is between the two.
    inside = np.hypot(place[:, 0], place[:, 1]) <= REACH
    false = (truth_of < 0) & (nearest > MATCH) & inside
    found = np.isin(np.arange(len(truth)), truth_of).astype(np.float64)
    by_class = ByClass()
    by_class.add_labels(place[false], points, label)
    return MappingResult(found, int(false.sum()), by_class.taken)


def _fitted_without(
    scenes: Sequence[Path], examples: list[Examples], pasted: list[Examples], seed: int
) -> Forest:
    """The classifier fitted to all scenes but these."""
    from pipeline.classification.forest import ALL_AROUND, ONE_WAY, forest_of
    from tests.benchmarks.package_forest.augmentation import is_of
    from tests.benchmarks.package_forest.fit import as_json, fit_all

    left_out = {str(scene) for scene in scenes}
    others = [e for e in examples if e.scene not in left_out]
    copies = [e for e in pasted if not any(is_of(e.scene, scene) for scene in left_out)]
    kind = ALL_AROUND if STREET in scenes else ONE_WAY
    return forest_of(as_json(fit_all(others, copies, (kind,), seed), []), kind)


@dataclass(frozen=True, slots=True, eq=False)
class CutCloud:
    """A whole cloud without the points above a height above the ground [m], reduced to a random share of the
    others."""

    cloud: WholeCloud
    ground: TerrainRaster
    height: float
    share: float = 1.0
    seed: int = 0

    @property
    def description(self) -> CloudDescription:
        """See WholeCloud."""
        return self.cloud.description

    @property
    def losses(self) -> dict[str, int]:
        """See WholeCloud."""
        return self.cloud.losses

    def parts(self) -> Iterator[Float32]:
        """See WholeCloud."""
        import numpy as np

        from app.extensions.clouds.terrain_raster import heights_above

        rng = np.random.default_rng(self.seed)
        for part in self.cloud.parts():
            drawn = part[rng.random(len(part)) < self.share]
            yield drawn[heights_above(drawn, self.ground) < self.height]


def _whole_clouds() -> Table:
    from app.extensions.clouds.inventory import map_plot
    from app.extensions.clouds.point_cloud import open_cloud
    from pipeline.config import preset
    from tests.benchmarks.cases.plot import stem_scores

    rows = []
    for name in ("pine_plot", "LPine1"):
        cloud = open_cloud(str(next((DATA / "forest").glob(f"{name}*.laz"))))
        plot = map_plot(cloud, preset("forest"))
        cut_off = map_plot(CutCloud(cloud, plot.ground, CUT), preset("forest"))
        for words, mapped in ((name, plot), (f"{name} below {CUT:g} m", cut_off)):
            place = mapped.trees.position + cloud.description.offset[:2]
            scores = stem_scores(place, mapped.trees.dbh, DATA / "forest" / f"{name}_stems.csv")
            rows.append((words, len(place), *scores))
    columns = (
        "cloud", "trees", "found", "of", "position RMSE [cm]", "DBH RMSE [cm]", "DBH bias [cm]", "DBH scored",
        "position of these [cm]",
    )  # fmt: skip
    note = (
        "pine_plot was looked at while the method was built, LPine1 was not. Below 4 m: the cloud is cut off "
        "at this height above the ground."
    )
    return Table("Stems of whole clouds", columns, tuple(rows), (note,))


def _low_clouds() -> Table:
    """Clouds that end at 2 to 4 m, thinned clouds, and both, compared with the map of the whole cloud."""
    import numpy as np

    from app.extensions.clouds.inventory import map_plot
    from app.extensions.clouds.point_cloud import open_cloud
    from pipeline.config import preset
    from pipeline.evaluation import match

    rows = list[tuple[Cell, ...]]()
    for name in ("pine_plot", "LPine1", "MLS_Clip"):
        cloud = open_cloud(str(next((DATA / "forest").glob(f"{name}*.laz"))))
        whole = map_plot(cloud, preset("forest"))
        cuts = (np.inf, CUT, *LOW_CUTS)
        variants = [(cut, 1.0, 0) for cut in cuts[1:]]
        variants += [(cut, THINNED, seed) for seed in THINNING_SEEDS for cut in cuts]
        for cut, share, seed in variants:
            mapped = map_plot(CutCloud(cloud, whole.ground, cut, share, seed), preset("forest"))
            of = match(mapped.trees.position, whole.trees.position, MATCH)
            wider = 100.0 * (mapped.trees.dbh[of >= 0] - whole.trees.dbh[of[of >= 0]])
            wider = wider[np.isfinite(wider)]
            rms = float(np.sqrt(np.mean(wider**2))) if len(wider) else None
            rows.append((
                name, None if np.isinf(cut) else cut, f"{100.0 * share:.0f} %", seed, int((of >= 0).sum()),
                len(whole.trees.number), int((of < 0).sum()), len(wider), rms,
            ))  # fmt: skip
    columns = (
        "cloud",
        "cut [m]",
        "points",
        "seed",
        "found",
        "of",
        "others",
        "DBH",
        "DBH RMS difference [cm]",
    )
    note = "Of: trees of the whole cloud at full density. Others: trees that are not among these."
    return Table("Stems of whole clouds that are cut off low and thinned", columns, tuple(rows), (note,))


def _tape() -> Table:
    import numpy as np

    from tests.benchmarks.trunks import tape_errors

    error, of = tape_errors()
    row = (len(error), of, float(np.sqrt(np.mean(np.square(error)))), float(np.mean(error)))
    columns = ("slices fitted", "of", "DBH RMSE [cm]", "DBH bias [cm]")
    return Table("Trunk slices against a tape", columns, (row,))
