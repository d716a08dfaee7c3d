"""Stand figures of simulated stands compared with their exact ground truth."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from pathlib import Path

import numpy as np

from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table, verdict

NAME = "stand"
LINE = "Stand figures and their standard errors against the truth of simulated stands"

SEEDS = range(1, 21)
RADIUS = 15.0
#: Stand, duration of the drive [s] and minimum diameter [m] of each question.
STAND = "sim:stand?seed={seed}&duration=40"
DENSE = "sim:dense?seed={seed}&duration=30"
SHORT = "sim:dense?seed={seed}&duration=10"
WILD = "sim:wild?seed={seed}&duration=25"
KEYS = ("n_ha", "g_ha")
VARIANTS = ("_plain", "", "_corrected")
NAMES = {"_plain": "whole plot", "": "observed area", "_corrected": "observed area, detection corrected"}


def run() -> list[Table]:
    """The stand with its standard errors, the dense stand with and without corrections, and undergrowth."""
    return [
        _table("sim:stand, 40 s of drive", STAND, errors_asked=True),
        _table("sim:dense, one pass of 30 s", DENSE, errors_asked=False),
        _table("sim:dense, one pass of 10 s", SHORT, errors_asked=False),
        _table("sim:wild, 25 s of drive", WILD, errors_asked=False),
    ]


def _table(title: str, uri: str, *, errors_asked: bool) -> Table:
    chosen = chosen_seeds(SEEDS)
    errors: dict[str, list[float]] = {key + end: [] for key in KEYS for end in VARIANTS}
    inside: dict[str, list[bool]] = {name: [] for name in errors}
    parts: list[float] = []
    for seed in chosen:
        found, true, part = figures_and_truth(uri.format(seed=seed))
        parts.append(part)
        for name in errors:
            value, se = found[name]
            expected = true[name.split("_")[0]]
            errors[name].append(value / expected - 1.0)
            inside[name].append(abs(value - expected) <= se)
    rows: list[tuple[Cell, ...]] = []
    for name, values in errors.items():
        key = name.split("_")[0]
        e = 100.0 * np.array(values)
        plain = name.endswith("_plain")
        rows.append(
            (
                f"{key.upper()}/ha",
                NAMES[name.removeprefix(key + "_ha")],
                float(e.mean()),
                float(e.std(ddof=1) / np.sqrt(len(e))) if len(e) > 1 else None,
                float(np.sqrt(np.square(e).mean())),
                None if plain else 100.0 * float(np.mean(inside[name])),
            )
        )
    worst = max(abs(float(np.mean(errors[key]))) for key in KEYS)
    covered = [100.0 * float(np.mean(inside[key])) for key in KEYS]
    notes = [
        f"Plot: circle of {RADIUS:g} m around the middle of the path; truth: all its true trees from 7 cm. "
        f"On average {100.0 * np.mean(parts):.0f} % of the plot is observed.",
        "Within 1 SE: share of seeds whose truth is inside one standard error without the counting error.",
    ]
    if errors_asked:
        honest = all(abs(c - 68.0) <= 15.0 for c in covered)
        notes.append(f"Asked for: mean error of N and G at most 3 %: {verdict(worst <= 0.03)}.")
        notes.append(f"Asked for: 53 to 83 % of the seeds within one standard error: {verdict(honest)}.")
    else:
        bias = abs(float(np.mean(errors["n_ha_corrected"])))
        notes.append(f"Asked for: bias of N with correction at most 5 %: {verdict(bias <= 0.05)}.")
    columns = ("figure", "reference", "bias %", "SE of bias %", "RMSE %", "within 1 SE %")
    return Table(f"{title}, {len(chosen)} seeds", columns, tuple(rows), tuple(notes))


def figures_and_truth(uri: str) -> tuple[dict[str, tuple[float, float]], dict[str, float], float]:
    """Map a run; the figures of the plot, their truth by "n" and "g", and the observed share of the plot."""
    from app.batch.run_folder import read_run
    from app.cli import main
    from app.extensions.stand.parameters import Stand
    from app.extensions.stand.plots import circle
    from app.extensions.stand.run_figures import stand_of
    from pipeline.io.readers import open_source

    true_map = open_source(uri).truth()
    assert true_map is not None
    assert true_map.trees is not None
    truth = true_map.trees
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.redirect_stdout(sys.stderr):
            assert main(["map", uri, "--out", folder]) in (0, 3)
        path = read_run(Path(folder)).path
        plot = circle("plot", float(path.x.mean()), float(path.y.mean()), RADIUS)
        figures = stand_of(Path(folder), Stand(count_error=0.0), [plot]).figures["plot"]
    place = np.stack([truth.x, truth.y], axis=1)
    tree = np.array([kind == "tree" for kind in truth.kind]) & plot.contains(place)
    tree &= np.asarray(truth.dbh) >= Stand().dbh_min
    per_ha = 1e4 / plot.shape.area
    basal = 0.25 * np.pi * np.square(np.asarray(truth.dbh)[tree])
    true = {"n": per_ha * float(tree.sum()), "g": per_ha * float(basal.sum())}
    return {k: (v.value, v.se) for k, v in figures.values.items()}, true, figures.seen / figures.area
