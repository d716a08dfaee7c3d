"""Damaged files, a disk that is full, and clocks that are set."""

from __future__ import annotations

import random
from contextlib import closing
from pathlib import Path

import numpy as np

from pipeline.io.readers import open_source
from pipeline.io.recording.mcap_writer import write_recording
from tests.app.robot.conftest import SCANS
from tests.app.robot.test_bad_days import SetClock, trees
from tests.app.robot.test_recording import Played, map_files
from tests.benchmarks.campaign import Result
from tests.benchmarks.campaign.service import SHORT_RUN, Edits, Service, check_edits
from tests.benchmarks.cases import fuzz
from tests.benchmarks.cases.recording import full_disk
from tests.benchmarks.real_files import KINDS

COPIES, COPIES_S = 200, 60.0
_FULL_BYTES = 400_000  # of a database with tens of edits
_EDITS = 400


def files(turn: int, folder: Path) -> Result:
    """Read copies of one kind of file that no earlier turn has read."""
    kind = list(KINDS)[turn % len(KINDS)]
    first = COPIES * (turn // len(KINDS))
    outcome = fuzz.attack(kind, first + COPIES, first, COPIES_S)
    result = Result(outcome.read + outcome.refused + len(outcome.faults) + outcome.crashes + outcome.hangs)
    result.faults += [f"{kind}: {fault.strip().splitlines()[-1]}" for fault in outcome.faults]
    result.faults += [f"{kind}: {outcome.crashes} crashes"] * bool(outcome.crashes)
    result.faults += [f"{kind}: {outcome.hangs} hangs"] * bool(outcome.hangs)
    result.longest_s, result.peak_mib = outcome.longest_s, outcome.peak_mib
    return result


def disk(turn: int, folder: Path) -> Result:
    """Record on a full disk while mapping, and annotate until the database cannot grow."""
    result, place = Result(2), folder / f"disk{turn}"
    place.mkdir()
    told = full_disk(place)
    if told["shown"] != SCANS or "not recording" not in told["recording"]:
        result.faults.append(f"a full disk ends more than the recording: {told}")
    edits: Edits = []
    with Service(result, SHORT_RUN, place, file_bytes=_FULL_BYTES + 10_000 * (turn % 7)) as service:
        service.until(lambda: service.run_number() is not None, "opened the run")
        for k in range(_EDITS):
            service.annotate(edits, 0.01 * k)
    check_edits(result, place, edits)
    return result


def clocks(turn: int, folder: Path) -> Result:
    """Set the clock of a robot in the middle of a run; the map must not change."""
    result, place = Result(1), folder / f"clocks{turn}"
    place.mkdir()
    stand = folder / "short.mcap"
    if not stand.exists():
        with closing(open_source("sim:stand?duration=2&seed=5")) as source:
            known = source.description
            write_recording(stand, source.records(), sensor=known.sensor, T_base_lidar=known.T_base_lidar)
    step_s = random.Random(turn).choice((1, -1, 5, -5, 60, -60, 3600, -3600, 86_400, -86_400, None))
    usual = trees(map_files(Played(SetClock(stand, 0)), place / "usual"))
    found = trees(map_files(Played(SetClock(stand, step_s)), place / "set"))
    if found.shape != usual.shape or not np.allclose(found, usual, atol=0.02):
        result.faults.append(f"a step of {step_s} s changes the map: {len(usual)} and {len(found)} trees")
    return result
