"""Pictures of path, truth and map for docs/results.md: `python -m tests.benchmarks NAME --pictures DIR`.

Everything is drawn in the frame of the map; truth and odometry are aligned with the path by a rigid motion.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.config import preset
from pipeline.errors import StemmapError, UsageError
from pipeline.evaluation import fit_rigid
from pipeline.io.readers import Source, SourceOptions, open_source
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.types.records import Float, Int, Trees, TruthPath, TruthTrees
from pipeline.types.records import Path as DrivenPath

INK, PATH, TRUTH, ODOMETRY, TREE = "#222222", "#1f6fb4", "#d1495b", "#b0b0b0", "#3a7d44"
WIDTH, DPI, COLOURS = 7.0, 110, 64  # inches; so that a picture stays below 150 kB
GAP_NS = 5_000_000_000  # a longer time without true poses is a gap in the line


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Content of a picture; positions in metres, paths of shape (N, 3) with their times."""

    title: str
    path: DrivenPath
    odometry: Float
    trees: Trees
    truth: TruthPath | None
    truth_name: str
    truth_trees: TruthTrees | None = None


def mapped(source: Source, seed: int, title: str, truth_name: str, truth: TruthPath | None = None) -> Drawn:
    """Map a source with its preset."""
    known = source.description
    mapper = Mapper(preset(known.preset), sensor=known.sensor, T_base_lidar=known.T_base_lidar, seed=seed)
    odometry, frame = [], None
    for step in steps(source.records()):
        frame = mapper.process(step)
        odometry.append((frame.T_odom_base.x, frame.T_odom_base.y))
    if frame is None:
        raise ValueError(f"{known.uri} has no scan")
    of_source = source.truth()
    return Drawn(
        title,
        mapper.path,
        np.array(odometry),
        frame.trees,
        truth or (of_source.path if of_source else None),
        truth_name,
        of_source.trees if of_source else None,
    )


def oxford() -> Drawn:
    """Oxford Evo with the first seed of the benchmark."""
    from app.extensions.formats.tree_manager import TRAJECTORY, trajectory_text
    from tests.benchmarks.cases.oxford import BIAS, DISTANCE, TURN
    from tests.benchmarks.tree_manager_folder import perturbed, read_recorded, write_states

    recorded = read_recorded(_data() / "oxford_evo" / "Evo.npz")
    noise = np.radians([TURN, BIAS]).tolist()
    rng = np.random.default_rng(1)
    told = perturbed(recorded.poses, distance=DISTANCE, turn=noise[0], bias=noise[1], rng=rng)
    with tempfile.TemporaryDirectory(prefix="stemmap-oxford-") as folder:
        write_states(recorded, Path(folder))
        (Path(folder) / TRAJECTORY).write_text(trajectory_text(recorded.stamp_ns, told), encoding="utf-8")
        with closing(open_source(folder)) as source:
            title = "Oxford Evo: 1.5 km in a forest, ready stems, seed 1"
            return mapped(source, 1, title, "recorded trajectory", recorded.truth)


def victoria_park() -> Drawn:
    """Victoria Park from its raw laser scans."""
    with closing(open_source(str(_data() / "victoria_park" / "victoria_park_ascii.zip"))) as source:
        return mapped(source, 1, "Victoria Park: 4 km by car, planar laser, seed 1", "GPS")


def sim_long() -> Drawn:
    """`sim:long` with poor wheel odometry."""
    uri = "sim:long?odometry=poor"
    with closing(open_source(uri, SourceOptions(seed=0))) as source:
        return mapped(source, 0, f"{uri}, seed 0", "true path")


#: Pictures by the names of their benchmarks.
PICTURES: dict[str, tuple[str, Callable[[], Drawn]]] = {
    "oxford": ("oxford.png", oxford),
    "victoria": ("victoria_park.png", victoria_park),
    "loops": ("sim_long.png", sim_long),
}


def draw(drawn: Drawn, file: Path) -> None:
    """Write a PNG with axes in metres, equal on both axes."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    path = np.column_stack([drawn.path.x, drawn.path.y])
    odometry = fit_rigid(drawn.odometry, path).apply(drawn.odometry)
    truth = None if drawn.truth is None else _truth_in_map(drawn.truth, drawn.path)
    shown = drawn.trees.position[drawn.trees.confirmed]
    everything = np.concatenate([path, odometry, shown] + ([] if truth is None else [truth]))
    low, high = np.nanmin(everything, axis=0), np.nanmax(everything, axis=0)
    ratio = float((high - low)[1] / (high - low)[0])
    figure, axes = plt.subplots(figsize=(WIDTH, float(np.clip(WIDTH * ratio + 1.2, 3.5, 8.5))), dpi=DPI)
    if drawn.truth_trees is not None:
        t = drawn.truth_trees
        is_tree = np.array([kind == "tree" for kind in t.kind])
        axes.scatter(
            t.x[is_tree],
            t.y[is_tree],
            s=26,
            facecolors="none",
            edgecolors=INK,
            linewidths=0.6,
            label="true trees",
        )
    axes.scatter(
        shown[:, 0], shown[:, 1], s=5, color=TREE, linewidths=0, label=f"trees of the map ({len(shown)})"
    )
    axes.plot(*odometry.T, color=ODOMETRY, lw=1.0, label="odometry alone", zorder=0)
    if truth is not None:
        axes.plot(*truth.T, color=TRUTH, lw=2.6, alpha=0.55, label=drawn.truth_name)
    axes.plot(*path.T, color=PATH, lw=1.0, label="path")
    axes.set_aspect("equal")
    axes.set_xlabel("x [m], ahead of the first pose")
    axes.set_ylabel("y [m]")
    axes.set_title(drawn.title, fontsize=10)
    axes.grid(lw=0.3, alpha=0.5)
    axes.legend(fontsize=7, loc="best", framealpha=0.9)
    figure.tight_layout()
    figure.savefig(file, bbox_inches="tight", pad_inches=0.08)
    plt.close(figure)
    _with_few_colours(file)


def _truth_in_map(truth: TruthPath, path: DrivenPath) -> Float:
    """The true positions in the frame of the map, with NaN where they pause, shape (N, 2)."""
    common = (truth.stamp_ns >= path.stamp_ns[0]) & (truth.stamp_ns <= path.stamp_ns[-1])
    stamp, true = truth.stamp_ns[common], np.column_stack([truth.x, truth.y])[common]
    if truth.same_frame:
        return _broken(stamp, true)
    at = [np.interp(stamp - stamp[0], path.stamp_ns - stamp[0], column) for column in (path.x, path.y)]
    return _broken(stamp, fit_rigid(true, np.column_stack(at)).apply(true))


def _broken(stamp_ns: Int, xy: Float) -> Float:
    gaps = np.flatnonzero(np.diff(stamp_ns) > GAP_NS) + 1
    return np.insert(xy, gaps, np.nan, axis=0)


def _with_few_colours(file: Path) -> None:
    """Reduce the picture to a palette, which halves the file."""
    from PIL import Image

    with Image.open(file) as picture:
        few = picture.convert("RGB").quantize(COLOURS)
    few.save(file, optimize=True)


def _data() -> Path:
    return Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[3] / "shared" / "data"))


def draw_all(names: Sequence[str], folder: Path) -> Iterator[Path]:
    """Draw the pictures of the named benchmarks, or of all, and yield the files as they are written.

    Raises:
        StemmapError: There is no such folder, or a benchmark has no picture.
    """
    without = [name for name in names if name not in PICTURES]
    if without:
        raise UsageError(f"{without[0]!r} has no picture", remedy=f"Pictures: {', '.join(PICTURES)}")
    if not folder.is_dir():
        raise StemmapError("there is no such folder to write to", where=str(folder))
    for name in names or PICTURES:
        file_name, made = PICTURES[name]
        draw(made(), folder / file_name)
        yield folder / file_name
