"""Public plots mapped by stemmap and by two other programs, each in an environment of its own."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float
from tests.benchmarks.cases.plot import SCORES, stem_scores
from tests.benchmarks.cases.start import command
from tests.benchmarks.process import environment
from tests.benchmarks.table import Cell, Table, verdict

NAME = "rivals"
LINE = "Public plots: stemmap, 3DFin and TreeX, each with its defaults (needs STEMMAP_DATA and uv)"
PLOTS = {"pine_plot": "pine_plot", "LPine1": "LPine1_demo", "MLS_Clip": "MLS_Clip"}
LONGEST_S = 1800.0  # of one program on one plot
ASKED_S, ASKED_MB = 5.0, 400.0  # of `stemmap map pine_plot.laz`


@dataclass(frozen=True, slots=True)
class Program:
    """A program that finds stems.

    Attributes:
        name: For the table.
        packages: Packages that are installed for it; the first one has its version.
        words: Returns the command for a Python with these packages, a cloud and a folder for its results.
        stems: Returns positions, shape (N, 2) [m], and diameters, shape (N,) [m], of the results in a folder.
    """

    name: str
    packages: tuple[str, ...]
    words: Callable[[Path, Path, Path], list[str]]
    stems: Callable[[Path], tuple[Float, Float]]


@dataclass(frozen=True, slots=True)
class Measured:
    """A run of a program: error, empty if there is none; wall time and CPU time [s]; peak memory [MB]."""

    failure: str
    wall: float
    cpu: float
    peak: float


def run() -> list[Table]:
    """A row for each plot and program. STEMMAP_BENCH_PEERS names a folder in which environments are kept."""
    folder = Path(os.environ.get("STEMMAP_DATA", "../shared/data")) / "forest"
    if not (folder / "pine_plot.laz").is_file():
        raise StemmapError("there is no real data", where=str(folder), remedy="Set STEMMAP_DATA")
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(os.environ.get("STEMMAP_BENCH_PEERS", temporary))
        pythons = {program.name: _installed(program, root) for program in PROGRAMS}
        rows = list[tuple[Cell, ...]]()
        for plot, file in PLOTS.items():
            for program in PROGRAMS:
                rows.append((plot, *_row(program, pythons[program.name], folder / f"{file}.laz", plot)))
                print(*rows[-1], file=sys.stderr, flush=True)
    cpu, peak = rows[0][-3:-1]
    asked = verdict(float(cpu or 0.0) <= ASKED_S), verdict(float(peak or 0.0) <= ASKED_MB)
    notes = (
        "Whole processes with one thread, after one run on pine_plot that fills caches. 3DFin normalises the "
        "heights itself; TreeX gets no intensities, because its limit is that of one scanner.",
        "The reference of pine_plot and LPine1 is what at least two of four offline programs agree on; "
        "dendromatics, the library of 3DFin, and TreeX are among them. MLS_Clip has none. Diameters are "
        "scored where those programs agree within 4 cm.",
        f"Asked of stemmap on pine_plot: at most {ASKED_S:g} s of CPU time: {asked[0]}; at most {ASKED_MB:g} "
        f"MB: {asked[1]}.",
    )
    return [Table("Stems of public plots", COLUMNS, tuple(rows), notes)]


COLUMNS = ("plot", "program", "stems", *SCORES[:-1], "wall [s]", "CPU [s]", "peak [MB]", "failed with")


def _row(program: Program, python: Path | str, cloud: Path, plot: str) -> tuple[Cell, ...]:
    """Return the cells after that of the plot. An environment that is a text is the reason of its failure."""
    nothing: tuple[None, ...] = (None,) * (len(COLUMNS) - 3)
    if isinstance(python, str):
        return (program.name, *nothing, python)
    name = f"{program.name} {_version(program, python)}"
    with tempfile.TemporaryDirectory() as out:
        words = program.words(python, cloud, Path(out))
        if plot == next(iter(PLOTS)):
            _measured(words)
        done = _measured(words)
        if done.failure:
            return (name, *nothing[:-3], done.wall, done.cpu, done.peak, done.failure)
        place, dbh = program.stems(Path(out))
    scores = stem_scores(place, dbh, cloud.with_name(f"{plot}_stems.csv"))[:-1]
    return (name, len(place), *scores, done.wall, done.cpu, done.peak, "")


def _installed(program: Program, root: Path) -> Path | str:
    """Return the Python of an environment with the packages of a program, which is created if it is missing;
    or the reason of a failure."""
    if not program.packages:
        return Path(sys.executable)
    python = root / program.name / "bin" / "python"
    if python.is_file():
        return python
    for words in (
        ["uv", "venv", "--quiet", "--python", "3.11", str(root / program.name)],
        ["uv", "pip", "install", "--quiet", "--python", str(python), *program.packages],
    ):
        try:
            subprocess.run(words, check=True, capture_output=True, text=True, timeout=LONGEST_S)
        except (OSError, subprocess.SubprocessError) as error:
            said = str(getattr(error, "stderr", "") or error).strip()
            return f"not installed: {said.splitlines()[-1]}"
    return python


def _version(program: Program, python: Path) -> str:
    name = program.packages[0] if program.packages else "stemmap"
    code = f"import importlib.metadata as m; print(m.version({name!r}))"
    return subprocess.check_output([str(python), "-c", code], text=True).strip()


def _measured(words: list[str]) -> Measured:
    with tempfile.TemporaryFile("w+") as log:
        told = subprocess.run(
            [sys.executable, "-I", "-S", "-c", _MEASURE, str(LONGEST_S), *words],
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            check=False,
        )
        log.seek(0)
        last = (log.read().strip().splitlines() or ["no message"])[-1]
    wall, cpu, peak = map(float, told.stdout.split())
    return Measured(last if told.returncode else "", wall, cpu, peak / 1e3)


#: On Linux, a child inherits the peak through fork and exec, so a small process starts the measured one.
_MEASURE = """
import os, subprocess, sys, threading, time
began = time.perf_counter()
child = subprocess.Popen(sys.argv[2:], stdout=subprocess.DEVNULL)
limit = threading.Timer(float(sys.argv[1]), child.kill)
limit.daemon = True
limit.start()
_, status, used = os.wait4(child.pid, 0)
wall = time.perf_counter() - began
child.returncode = os.waitstatus_to_exitcode(status)
print(wall, used.ru_utime + used.ru_stime, used.ru_maxrss)
sys.exit(child.returncode not in (0, 3))
"""


def _stemmap_stems(out: Path) -> tuple[Float, Float]:
    with (out / "trees.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    place = np.array([[float(row["x_m"]), float(row["y_m"])] for row in rows]).reshape(-1, 2)
    return place, np.array([float(row["dbh_cm"] or "nan") / 100.0 for row in rows])


def _of_3dfin(python: Path, cloud: Path, out: Path) -> list[str]:
    settings = next(python.parents[1].glob("lib/python*/site-packages/three_d_fin/3DFinconfig.ini"))
    options = ["cli", "--export_txt", "--normalize"]
    return [str(python.with_name("3DFin")), *options, str(cloud), str(out), str(settings)]


def _stems_of_3dfin(out: Path) -> tuple[Float, Float]:
    rows = np.loadtxt(next(out.glob("*_dbh_and_heights.txt")), ndmin=2)  # height, DBH, x, y
    return rows[:, 2:4], np.where(rows[:, 1] > 0.0, rows[:, 1], np.nan)  # 0: not measured


#: torch_scatter has to be compiled. TreeX does not use it; its package imports it for other algorithms.
_TREEX = """
import sys, types
import laspy, numpy
scatter = types.ModuleType("torch_scatter")
scatter.scatter = scatter.scatter_max = scatter.scatter_min = None
sys.modules["torch_scatter"] = sys.modules["torch_scatter.scatter"] = scatter
from pointtree.instance_segmentation import TreeXAlgorithm
cloud = laspy.read(sys.argv[1])
_, place, dbh = TreeXAlgorithm(num_workers=1)(numpy.ascontiguousarray(cloud.xyz, numpy.float64))
numpy.savez(sys.argv[2] + "/stems.npz", place=place, dbh=dbh)
"""


def _stems_of_treex(out: Path) -> tuple[Float, Float]:
    with np.load(out / "stems.npz") as found:
        return found["place"].reshape(-1, 2), found["dbh"]


PROGRAMS = (
    Program(
        "stemmap",
        (),
        lambda _, cloud, out: command("map", str(cloud), "--out", str(out), "--force"),
        _stemmap_stems,
    ),
    Program("3DFin", ("3dfin",), _of_3dfin, _stems_of_3dfin),
    Program(
        "TreeX",
        ("pointtree", "torch", "laspy[lazrs]"),
        lambda python, cloud, out: [str(python), "-c", _TREEX, str(cloud), str(out)],
        _stems_of_treex,
    ),
)
