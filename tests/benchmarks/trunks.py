"""Accuracy of the detection of trunks: `python -m tests.benchmarks.trunks [park] [street] [dbh] [sim]`.

park, street: the whole mapper on labelled scans. With `--examples DIR` (as STEMMAP_EXAMPLES keeps them) each
scene is judged by decision trees grown from all other scenes; without, by those of the package, which saw
these scenes: such figures are training scores and not those of new places.
sim: scenes that no training saw (seeds 1 to 5), with exact poses.
dbh: trunk slices with the diameter by tape.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np

from app.common.timers import Stopwatch
from app.extensions.clouds.inventory.cross_sections import FIGURES, best_circle, fit_circle, without_scatter
from app.extensions.learning.examples import SUFFIX, Examples, read_examples
from pipeline.classification.forest import ALL_AROUND, ONE_WAY, Forest, forest_of, package_alone
from pipeline.config import preset
from pipeline.evaluation import evaluate, match
from pipeline.io.readers import open_source
from pipeline.io.readers.base import SourceOptions
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.types.records import Float, Frame, Int
from tests.benchmarks.classes import ByClass
from tests.benchmarks.package_forest.augmentation import FOLDER, copies, is_of
from tests.benchmarks.package_forest.fit import as_json, can_fit, fit_all
from tests.benchmarks.package_forest.labelled_scenes import labelled_points, trunks

DATA = Path(os.environ.get("STEMMAP_DATA", "../shared/data"))
PARKS = [DATA / "park_trunks" / name for name in ("00", "02", "04", "06")]
REACH, MATCH = 25.0, 0.5
TOLERANCE, REACH_OF_A_SLICE, RADIUS_MIN, RADIUS_MAX = 0.02, 0.1, 0.03, 0.6  # m; of circles in merged slices
RINGS = ((0.0, 10.0), (10.0, 15.0), (15.0, 20.0), (20.0, 25.0))
EXACT_POSES = {
    "slam.particles": 1,
    "slam.noise_distance": 0.0,
    "slam.noise_turn_distance": 0.0,
    "slam.noise_turn": 0.0,
}


def main() -> None:
    """Run the requested measurements."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", default=["park", "street", "dbh", "sim"])
    parser.add_argument("--examples", type=Path, help="folder of examples, STEMMAP_EXAMPLES")
    parser.add_argument("--scenes", default="stand,slope,dense")
    parser.add_argument("--seeds", default="1,2,3,4,5")
    parser.add_argument("--every", type=int, default=1, help="make every so many-th simulated scan")
    parser.add_argument("--draw", type=int, default=0, help="seed of the decision trees that are grown")
    arguments = parser.parse_args()
    examples, pasted = [], []
    if arguments.examples is not None:
        examples = [e for file in sorted(arguments.examples.glob(f"*{SUFFIX}")) for e in read_examples(file)]
        kept = arguments.examples / FOLDER
        if "park" in arguments.parts:
            pasted = [e for park in PARKS for e in copies(park, kept, preset("forest"), REACH)]
    for part in arguments.parts:
        if part == "park":
            _real(PARKS, examples, pasted, arguments.draw)
        elif part == "street":
            _real([DATA / "semantickitti" / "000000.bin"], examples, pasted, arguments.draw)
        elif part == "dbh":
            _dbh()
        else:
            for scene in arguments.scenes.split(","):
                _simulated(scene, [int(seed) for seed in arguments.seeds.split(",")], arguments.every)


def mapped(
    uri: str, *, odometry: str, every: int = 1, forest: Forest | None = None, exact: bool = False
) -> tuple[Frame, Float, Stopwatch]:
    """A run mapped to its end: the last frame, the path (N, 2) [m], and the times. Of a simulated run every
    so many-th scan is made."""
    parameters = preset("forest").replace(EXACT_POSES if exact else {})
    watch = Stopwatch(scans=100_000)
    frame: Frame | None = None
    with closing(open_source(uri)) as source:
        about = source.description
        mapper = Mapper(
            parameters,
            sensor=about.sensor,
            T_base_lidar=about.T_base_lidar,
            seed=0,
            timer=watch,
            forests=package_alone if forest is None else lambda _name, _around: forest,
        )
        records = source.records(every=every) if isinstance(source, SimulatedSource) else source.records()
        for step in steps(records, odometry="static" if odometry == "static" else "auto"):
            with watch.whole_scan():
                frame = mapper.process(step)
    assert frame is not None
    return frame, np.stack([mapper.path.x, mapper.path.y], axis=1), watch


def _real(scenes: Iterable[Path], examples: list[Examples], pasted: list[Examples], draw: int) -> None:
    total, by_class = np.zeros(4, np.int64), ByClass()
    by_ring = np.zeros((len(RINGS), 3), np.int64)
    for scene in scenes:
        forest = _grown_without(scene, examples, pasted, draw) if examples else None
        frame, _, watch = mapped(str(scene), odometry="static", forest=forest)
        place = frame.trees.position[frame.trees.confirmed]
        place = place[np.hypot(place[:, 0], place[:, 1]) <= REACH]
        points, label = labelled_points(scene)
        score, rings, false = _score(place, points, label)
        by_class.add_labels(false, points, label)
        total += score
        by_ring += rings
        print(f"{scene.parent.name}/{scene.name}: {_rates(*score)}   {watch.scan_ms:.1f} ms a scan")
    print(f"all: {_rates(*total)}" + ("" if examples else "   (seen in training)"))
    for (near, far), (hit, of, false) in zip(RINGS, by_ring, strict=True):
        print(f"  {near:.0f} to {far:.0f} m: {hit} of {of} found, {false} false")
    print(by_class.table("Wrongly taken, by what most points there are").markdown())


def _rates(hit: int, of: int, false: int, poles: int) -> str:
    return (
        f"{hit} of {of} trees ({100 * hit / max(of, 1):.0f} %), {false} false "
        f"(correct {100 * hit / max(hit + false, 1):.0f} %), {poles} of them poles"
    )


def _score(place: Float, points: Float, label: Int) -> tuple[Int, Int, Float]:
    """Found, of, false, poles among the false; the first three by distance; and places of the false ones.

    Trees on a labelled trunk of fewer than 30 points, or beyond 25 m, are ignored.
    """
    truth = trunks(points, label, 30, REACH)
    small = trunks(points, label, 1, np.inf)
    poles = points[label == 80][:, :2]
    truth_of = match(place, truth, MATCH)
    false = (truth_of < 0) & (_away(place, small) > MATCH)
    found = np.zeros(len(truth), np.bool_)
    found[truth_of[truth_of >= 0]] = True
    on_pole = false & (_away(place, poles) < 0.4)
    rings = np.zeros((len(RINGS), 3), np.int64)
    for k, (near, far) in enumerate(RINGS):
        of = (np.hypot(*truth.T) >= near) & (np.hypot(*truth.T) < far)
        there = (np.hypot(*place.T) >= near) & (np.hypot(*place.T) < far)
        rings[k] = np.count_nonzero(found & of), np.count_nonzero(of), np.count_nonzero(false & there)
    return np.array([found.sum(), len(truth), false.sum(), on_pole.sum()]), rings, place[false]


def _away(place: Float, other: Float) -> Float:
    from scipy.spatial import cKDTree

    if len(other) == 0 or len(place) == 0:
        return np.full(len(place), np.inf)
    distance: Float = cKDTree(other).query(place)[0]
    return distance


def _grown_without(scene: Path, examples: list[Examples], pasted: list[Examples], draw: int) -> Forest:
    """Decision trees from all scenes but this one."""
    others = [e for e in examples if e.scene.rstrip("/") != str(scene)]
    if len(others) == len(examples):
        raise SystemExit(f"the examples know no scene {scene}: train with the same path")
    kind = ALL_AROUND if next(e for e in examples if e not in others).all_around else ONE_WAY
    if not can_fit(others, kind):
        raise SystemExit(f"no other scene teaches a sensor that looks {kind}")
    beside = [e for e in pasted if not is_of(e.scene, str(scene))]
    return forest_of(as_json(fit_all(others, beside, (kind,), draw), []), kind)


def _simulated(scene: str, seeds: list[int], every: int) -> None:
    by_class = ByClass()
    for seed in seeds:
        uri = f"sim:{scene}?seed={seed}&odometry=exact"
        frame, path, watch = mapped(uri, odometry="auto", every=every, exact=True)
        with closing(open_source(uri)) as source:
            truth = source.truth()
        assert truth is not None
        assert truth.trees is not None
        e = evaluate(frame.trees, truth.trees, preset("forest").evaluation, path)
        by_class.add_map(frame.trees, truth.trees, path, preset("forest").evaluation)
        ms = watch.stage_ms
        stages = ("ground", "voxel grid", "clustering", "shape", "detection", "gathering")
        print(
            f"{uri} every {every}: complete {e.TA.count}/{e.TA.of}, "
            f"correct {100 * (e.correctness or 0):.1f} %, "
            f"TR {e.TR.count}/{e.TR.of}, {e.spurious} where nothing stands, "
            f"position {100 * (e.position_rmse or np.nan):.1f} cm, DBH {100 * (e.dbh_rmse or np.nan):.2f} cm "
            f"(bias {100 * (e.dbh_bias or np.nan):+.2f}, {e.dbh_count} trees), "
            f"ground to verdict {sum(ms.get(s, 0.0) for s in stages):.1f} ms",
            flush=True,
        )
    print(by_class.table(f"sim:{scene}: wrongly taken").markdown(), flush=True)


def _dbh() -> None:
    error, of = tape_errors()
    print(f"{len(error)} of {of} slices have a circle")
    print(f"trunk_dbh: RMSE {np.sqrt(np.mean(np.square(error))):.2f} cm, bias {np.mean(error):+.2f} cm")


def tape_errors() -> tuple[list[float], int]:
    """Fitted diameter less that by tape of each trunk slice with a circle [cm], and the number of slices."""
    folder = DATA / "trunk_dbh"
    error, of = list[float](), 0
    for name, tape in _tape(folder / "dbh_reference.csv"):
        with closing(open_source(str(folder / name), SourceOptions(form="scan"))) as source:
            points = next(r.points for r in source.records() if hasattr(r, "points")).astype(np.float64)
        of += 1
        # Merged from several views, as a whole cloud is, so the visible side of the trunk is not known from a
        # ray.
        circle = np.zeros(FIGURES)
        xy = points[:, :2] - points[:, :2].mean(axis=0)
        best_circle(xy, TOLERANCE, RADIUS_MIN, RADIUS_MAX, circle)
        if not fit_circle(xy, REACH_OF_A_SLICE, RADIUS_MIN, RADIUS_MAX, circle):
            print(f"{name}: no circle, tape {tape:.1f} cm", file=sys.stderr)
            continue
        radius = float(without_scatter(circle[2], circle[7]))
        error.append(200.0 * radius - tape)
        said = f"{200 * radius:.1f} +- {200 * np.sqrt(circle[6]):.1f} cm"
        seen = f"{np.degrees(circle[8]):.0f} degrees seen"
        print(f"{name}: {said}, tape {tape:.1f} cm, {seen}", file=sys.stderr)
    return error, of


def _tape(file: Path) -> Iterator[tuple[str, float]]:
    with file.open(newline="") as rows:
        for row in csv.DictReader(rows):
            yield row["file"], float(row["dbh_cm"])


if __name__ == "__main__":
    main()
