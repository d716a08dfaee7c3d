"""Maps the runs of docs/results.md again and writes the figures into its tables.

`python -m tests.benchmarks results [paper stands victoria recordings]`: each run is one `stemmap map` in a
process of its own, and every cell is read from the run.json that it wrote.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from pipeline.io.atomic_files import write_beside

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results.md"
DATA = Path(os.environ.get("STEMMAP_DATA", ROOT.parent / "shared" / "data"))

Run = dict[str, Any]
Rows = list[list[str]]

PAPER = ("preset", "seed", "TA", "FR", "TR", "FA", "spurious", "position RMSE [cm]", "DBH RMSE [cm]",
         "mean pair error [%]", "path RMS [cm]")  # fmt: skip
STANDS = ("run", "seed", "TA", "TR", "spurious", "completeness [%]", "correctness [%]", "position RMSE [cm]",
          "DBH RMSE [cm]", "mean pair error [%]", "path RMS [cm]")  # fmt: skip
VICTORIA = ("seed", "path RMS [m]", "median [m]", "largest [m]", "trees")
RECORDINGS = ("source", "scans", "trees", "warnings and losses")
AS_PRINTED = ["the paper, as printed", "-", "100 %", "0 %", "50 %", "-", "-", "-", "-", "7.13", "-"]
SOURCES = (
    "velodyne/vlp16.pcap",
    "velodyne/vlp16_ros1.bag",
    "velodyne/vlp16_rosbag2",
    "velodyne/vlp16_ros2_mcap",
    "velodyne/vlp16_ros2_mcap/vlp16_ros2_mcap.mcap",
    "velodyne/vlp16_reference.pcd",
    "kitti",
    "semantickitti",
    "park_trunks/00",
    "park_trunks/02",
    "park_trunks/04",
    "park_trunks/06",
    "sloam_forest",
)


def paper() -> tuple[str, str]:
    """Return the table of the plot of the paper with three presets and three seeds."""
    rows = [AS_PRINTED]
    for preset in ("paper", "paper-text", "forest"):
        for seed in range(3):
            run = mapped("sim:paper", "--preset", preset, "--seed", str(seed))
            counts = [_rate(run["evaluation"][name]) for name in ("TA", "FR", "TR", "FA")]
            spurious = str(run["evaluation"]["spurious"])
            rows.append([f"`{preset}`", str(seed), *counts, spurious, *_errors(run)])
    return table(PAPER, rows), ""


def stands() -> tuple[str, str]:
    """Return the table of the other scenarios, odometry with noise, three seeds."""
    runs = [(f"sim:{name}", seed) for name in ("stand", "slope", "dense") for seed in range(3)]
    rows = []
    for uri, seed in [*runs, ("sim:long?odometry=poor", 0)]:
        run = mapped(uri, "--seed", str(seed))
        e = run["evaluation"]
        share = [f"{100.0 * e[name]:.1f}" for name in ("completeness", "correctness")]
        rows.append(
            [f"`{uri}`", str(seed), _rate(e["TA"]), _rate(e["TR"]), str(e["spurious"]), *share, *_errors(run)]
        )
    return table(STANDS, rows), ""


def victoria() -> tuple[str, str]:
    """Victoria Park with ten seeds."""
    rows, rms = [], []
    for seed in range(1, 11):
        run = mapped(str(DATA / "victoria_park" / "victoria_park_ascii.zip"), "--seed", str(seed))
        error = run["path_error"]
        rms.append(error["rms"])
        rows.append(
            [
                str(seed),
                *(f"{error[k]:.2f}" for k in ("rms", "median")),
                f"{error['largest']:.1f}",
                str(run["trees"]),
            ]
        )
    median, within = statistics.median(rms), sum(value <= 4.0 for value in rms)
    line = f"Median of the ten seeds {median:.2f} m, worst {max(rms):.2f} m, {within} within 4 m."
    return table(VICTORIA, rows), line


def recordings() -> tuple[str, str]:
    """Each kind of real input."""
    rows = []
    for name in SOURCES:
        run = mapped(str(DATA / name))
        said = [*run["warnings"], *(f"{count} {reason}" for reason, count in run["losses"].items())]
        rows.append([f"`{name}`", str(run["scans"]), str(run["trees"]), "; ".join(said) or "-"])
    return table(RECORDINGS, rows), ""


SECTIONS: dict[str, tuple[str, Callable[[], tuple[str, str]]]] = {
    "paper": ("## The paper's plot, simulated: `sim:paper`", paper),
    "stands": ("## Other simulated stands", stands),
    "victoria": ("## Victoria Park", victoria),
    "recordings": ("## Real recordings", recordings),
}


def mapped(uri: str, *words: str) -> Run:
    """The run.json of `stemmap map`."""
    with tempfile.TemporaryDirectory() as folder:
        command = "import sys; from app.cli import main; sys.exit(main())"
        told = subprocess.run(
            [sys.executable, "-c", command, "map", uri, "--out", folder, *words],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=3600,
            check=False,
        )
        if told.returncode not in (0, 3):
            raise RuntimeError(f"stemmap map {uri}: {told.stderr.strip()}")
        run: Run = json.loads((Path(folder) / "run.json").read_text(encoding="utf-8"))
    print(f"{uri} {' '.join(words)}: {run['trees']} trees", file=sys.stderr, flush=True)
    return run


def table(columns: Iterable[str], rows: Rows) -> str:
    """A Markdown table."""
    head = list(columns)
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows])


def replaced(text: str, heading: str, new: str, line: str) -> str:
    """Return the file with another table below a heading, and another line after it if one is given."""
    before, found, rest = text.partition(heading + "\n")
    if not found:
        raise ValueError(f"there is no heading {heading!r}")
    lines = rest.split("\n")
    first = next(k for k, content in enumerate(lines) if content.startswith("|"))
    last = next(k for k in range(first, len(lines)) if not lines[k].startswith("|"))
    after = lines[last:]
    if line:
        after[1] = line
    return before + found + "\n".join([*lines[:first], new, *after])


def _rate(rate: dict[str, Any]) -> str:
    return f"{rate['count']}/{rate['of']}"


def _errors(run: Run) -> list[str]:
    e = run["evaluation"]
    return [
        _cm(e["position_rmse"], 1),
        _cm(e["dbh_rmse"], 1),
        "-" if e["mean_pair_error_percent"] is None else f"{e['mean_pair_error_percent']:.2f}",
        _cm(run["path_error"]["rms"], 1),
    ]


def _cm(metres: float | None, digits: int) -> str:
    return "-" if metres is None else f"{100.0 * metres:.{digits}f}"


def main(names: list[str]) -> None:
    """Write the sections with these names, or all."""
    for name in names or SECTIONS:
        heading, make = SECTIONS[name]
        new, line = make()
        text = replaced(RESULTS.read_text(encoding="utf-8"), heading, new, line)
        with write_beside(RESULTS) as partial:
            partial.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
