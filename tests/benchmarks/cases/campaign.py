"""Faults of all kinds in turns: files, requests, kills, disks, clocks, links and browsers."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tests.benchmarks.campaign import Result, browsers, kills, limits, network, requests
from tests.benchmarks.process import ROOT
from tests.benchmarks.table import Table, verdict

NAME = "campaign"
LINE = "Damaged files, random requests, kill -9, full disks, clocks, links and browsers, in turns"

HOURS = float(os.environ.get("STEMMAP_BENCH_HOURS", "2"))
#: Finished steps are stored here, so that an interrupted campaign continues; the folder is removed at its
#: end.
FOLDER = ROOT / ".campaign"
KINDS: dict[str, Callable[[int, Path], Result]] = {
    "damaged files": limits.files,
    "requests": requests.run,
    "kill -9": kills.run,
    "full disk": limits.disk,
    "clock steps": limits.clocks,
    "link": network.run,
    "browsers": browsers.run,
}
MOST_MIB = 1024.0  # of a reader


def run() -> list[Table]:
    """Run steps of all kinds in turns until the time has elapsed."""
    FOLDER.mkdir(exist_ok=True)
    finished = FOLDER / "steps.jsonl"
    steps = [json.loads(line) for line in finished.read_text().splitlines()] if finished.exists() else []
    while sum(step["seconds"] for step in steps) < 3600.0 * HOURS:
        turn, number = divmod(len(steps), len(KINDS))
        kind = list(KINDS)[number]
        for place in FOLDER.iterdir():  # of the previous step, or of an interrupted one
            if place.is_dir():
                shutil.rmtree(place)
        begun = time.monotonic()
        try:
            result = KINDS[kind](turn, FOLDER)
        except Exception as error:  # a step that cannot be finished is a fault, the others go on
            traceback.print_exc()
            result = Result(faults=[f"{type(error).__name__}: {str(error)[:200]}"])
        steps.append({"kind": kind, "seconds": time.monotonic() - begun, "result": asdict(result)})
        print(f"turn {turn}, {kind}: {result}", file=sys.stderr, flush=True)
        with finished.open("a") as file:
            file.write(json.dumps(steps[-1]) + "\n")
    table = _table(steps)
    shutil.rmtree(FOLDER)
    return [table]


def _table(steps: list[dict[str, Any]]) -> Table:
    rows: list[tuple[Any, ...]] = []
    faults: list[str] = []
    for kind in KINDS:
        mine = [Result(**step["result"]) for step in steps if step["kind"] == kind]
        faults += [f"{kind}: {fault}" for result in mine for fault in result.faults]
        rows.append(
            (
                kind,
                len(mine),
                sum(result.done for result in mine),
                sum(result.edits for result in mine),
                sum(len(result.faults) for result in mine),
                max((result.longest_s for result in mine), default=0.0),
                max((result.peak_mib for result in mine), default=0.0),
            )
        )
    hours = sum(step["seconds"] for step in steps) / 3600.0
    peak = max((row[-1] for row in rows if row[0] == "damaged files"), default=0.0)
    return Table(
        f"{hours:.2f} h of faults on this machine",
        ("kind", "steps", "files, requests, kills ...", "edits", "faults", "longest s", "peak MiB"),
        tuple(rows),
        (
            "A fault: a lost acknowledged edit, a recording that cannot be read or has a hole, another map "
            "than without the disturbance, an answer 5xx other than 503 and 507 or after more than 10 s (60 "
            "s for the cloud of a run, for which the source is read again), a traceback, a process that "
            "remains, a server that does not go on. Longest: an answer of the server, or the reading of a "
            "file. Peak: the server, or the reader.",
            f"Required: no fault, {verdict(not faults)}; less than {MOST_MIB:g} MiB of a reader, "
            f"{verdict(peak < MOST_MIB)}.",
            *sorted(set(faults))[:20],
        ),
    )
