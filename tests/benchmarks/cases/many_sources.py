"""Memory of the web process when many sources are opened one after another, with exports and reports."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import cycle, islice
from pathlib import Path

from pipeline.errors import StemmapError
from tests.benchmarks.machine import resident_mib
from tests.benchmarks.process import Side
from tests.benchmarks.table import Cell, Table, verdict

NAME = "many_sources"
LINE = (
    "A hundred sources of all kinds opened in one server, with exports and reports: memory of the web process"
)

OPENINGS = int(os.environ.setdefault("STEMMAP_BENCH_OPENINGS", "100"))
END_MIB, PEAK_MIB = 400.0, 700.0
LONGEST_S = 240.0  # until the results of a source are there
PLAYED_S = 12.0  # time for which a long source is played as fast as possible
SIMULATED = ("stand", "paper", "slope", "dense", "crossing", "wild")
#: Recordings and clouds among the data for tests.
RECORDED = (
    "victoria_park",
    "velodyne/vlp16_ros2_mcap/vlp16_ros2_mcap.mcap",
    "forest/pine_plot.laz",
    "velodyne/vlp16_ros1.bag",
    "forest/MLS_Clip.laz",
    "oxford_evo/Evo.npz",
)
#: Requested after each opening.
ASKED = (
    "/api/trees",
    "/api/trees.csv",
    "/api/path.csv",
    "/api/course?names=sigma,detections",
    "/api/doubts",
    "/api/pairs",
    "/api/stages",
    "/api/layers/trees.geojson",
    "/api/layers/path.geojson",
    "/api/layers/plots.geojson",
)
#: Requested after every fifth opening.
EXPORTED = ("/api/export/gpkg", "/api/export/geojson", "/api/export/shp", "/api/runs/open/report/html")


def run() -> list[Table]:
    """Open the sources and read the memory after each."""
    rows: list[tuple[Cell, ...]] = []
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        served = "tests.benchmarks.served"
        server = Side(f"{served}.server", "sim:stand?duration=3", folder)
        stack.callback(server.end)
        link = server.ask({"do": "link"})
        browser = Side(f"{served}.browsers", str(link["port"]), link["token"])
        stack.callback(browser.end)
        browser.ask({"do": "browsers", "count": 1})
        web = server.ask({"do": "pids"})["web"]
        begin, refused = resident_mib(web), 0
        for number, uri in enumerate(islice(sources(), OPENINGS), 1):
            is_open = mapped(browser, uri)
            server.ask({"do": "heard"})  # or their lists would grow
            browser.ask({"do": "heard"})
            asked = [*ASKED, *(EXPORTED if number % 5 == 0 else ())] if is_open else []
            codes = [browser.ask({"do": "get", "path": path})["code"] for path in asked]
            refused += sum(code >= 500 for code in codes)
            row = (number, Path(uri).name, resident_mib(web), peak_mib(web), sum(c < 400 for c in codes))
            print(*row, flush=True)
            rows.append(row)
        time.sleep(5.0)
        end, peak = resident_mib(web), peak_mib(web)
    return [
        Table(
            f"{OPENINGS} openings",
            ("openings", "source", "web process [MiB]", "its peak [MiB]", "answers"),
            tuple(rows),
            (
                f"At the start {begin:.0f} MiB, at the end {end:.0f} (required: at most {END_MIB:.0f}: "
                f"{verdict(end <= END_MIB)}), peak {peak:.0f} (at most {PEAK_MIB:.0f}: "
                f"{verdict(peak <= PEAK_MIB)}).",
                f"Answers with a code of 500 or more: {refused}.",
                "One browser hears both websockets; each source is played as fast as possible to its end or "
                f"for {PLAYED_S:g} s, and {len(ASKED)} addresses are asked for, {len(EXPORTED)} more after "
                "each fifth.",
            ),
        )
    ]


def sources() -> Iterator[str]:
    """Yield sources without end, simulated and recorded ones in turns; no simulated source is repeated."""
    data = Path(os.environ.get("STEMMAP_DATA", "../shared/data")).resolve()
    recorded = cycle(
        [str(data / name) for name in RECORDED if (data / name).exists()] or ["sim:paper?duration=4"]
    )
    for number, name in enumerate(cycle(SIMULATED)):
        yield f"sim:{name}?seed={number}&duration=4"
        yield next(recorded)


def mapped(browser: Side, uri: str) -> bool:
    """Open a source and play it; return whether it was opened.

    Raises:
        StemmapError: It is not there within LONGEST_S.
    """
    if browser.ask({"do": "open", "uri": uri})["code"] != 202:
        return False
    begin, since = time.monotonic(), None
    while time.monotonic() < begin + LONGEST_S:
        time.sleep(0.3)
        status = browser.ask({"do": "status"})
        if status["source"] != uri:
            continue
        if status["source"] != uri:  # that of the source before
            continue
        if status["state"] == "failed":
            return False
        if status["state"] == "finished":
            return True
        if status["scan_index"] >= 0:
            if since is None:
                since = time.monotonic()
                browser.ask({"do": "command", "command": {"type": "set_speed", "factor": 0.0}})
                browser.ask({"do": "command", "command": {"type": "play"}})
            elif time.monotonic() > since + PLAYED_S:
                return True
    raise StemmapError("nothing was mapped", where=uri)


def peak_mib(pid: int) -> float:
    """Return the peak memory of a process so far [MiB]."""
    lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024.0
