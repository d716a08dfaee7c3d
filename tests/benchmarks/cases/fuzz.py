"""Thousands of damaged files of each kind: no crash, no hang, no excessive memory."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from tests.benchmarks.cut_recordings import POINTS, SCANS
from tests.benchmarks.process import ROOT, environment
from tests.benchmarks.real_files import KINDS
from tests.benchmarks.results import DATA
from tests.benchmarks.table import Cell, Table, verdict

NAME = "fuzz"
LINE = "Damaged copies of real files of each kind, read to their end"

COPIES = 5_000
LONGEST_S, MOST_MIB = 2.0, 512.0
#: Maximum CPU time of a kind, independent of the load; the table states the number of copies.
BUDGET_S = float(os.environ.get("STEMMAP_FUZZ_SECONDS", "600"))
#: A child without output for _SILENT_S of wall time hangs if it used _HANGS_S of CPU time meanwhile, or if it
#: has no output for _SLEEPS_S.
_SILENT_S, _HANGS_S, _SLEEPS_S = 10.0, 20.0, 600.0


@dataclass(slots=True)
class MappingResult:
    """Results of the copies of one kind."""

    read: int = 0
    refused: int = 0
    faults: list[str] = field(default_factory=list)
    crashes: int = 0
    hangs: int = 0
    longest_s: float = 0.0
    peak_mib: float = 0.0
    used_s: float = 0.0

    def row(self, kind: str) -> tuple[Cell, ...]:
        """For the table."""
        good = not (self.faults or self.crashes or self.hangs) and self.peak_mib < MOST_MIB
        copies = self.read + self.refused + len(self.faults) + self.crashes
        figures = (copies, self.refused, len(self.faults), self.crashes, self.hangs)
        return (kind, *figures, 1000.0 * self.longest_s, self.peak_mib, verdict(good))


def run() -> list[Table]:
    """Read them all."""
    rows, notes = [], []
    for kind in KINDS:
        outcome = attack(kind, COPIES)
        rows.append(outcome.row(kind))
        notes += [f"{kind}: {fault.strip().splitlines()[-1]}" for fault in outcome.faults[:3]]
        print(f"{kind}: {outcome.row(kind)}", file=sys.stderr, flush=True)
    return [
        Table(
            f"Up to {COPIES:,} damaged copies of each kind",
            ("kind", "copies", "refused", "faults", "crashes", "hangs", "longest ms", "peak MiB", ""),
            tuple(rows),
            (
                "Refused: one clear error; the others were read as far as they are whole, with what was left "
                f"out counted. A hang is more than {LONGEST_S:g} s of one core. Asked for: no fault, no "
                f"crash, no hang, less than {MOST_MIB:g} MiB (the whole process).",
                f"At most {BUDGET_S:g} s of a core for each kind (STEMMAP_FUZZ_SECONDS).",
                "All copies of a kind are read in one process: what a library does not give back adds up.",
                f"Of both bags and of MCAP not packed: the first {POINTS:,} points of the scans, written "
                f"by rosbags and mcap; of db3 and pcap the first {SCANS} scans. Not packed, or with their "
                "sums mended: no checksum finds the damage before it is read.",
                *notes,
            ),
        )
    ]


def attack(kind: str, copies: int, first: int = 0, budget_s: float = BUDGET_S) -> MappingResult:
    """Read damaged copies from a first number on in a child process, for a limited CPU time. When the child
    dies or hangs, another one continues with the next copy."""
    outcome = MappingResult()
    while first < copies and outcome.used_s < budget_s:
        with tempfile.TemporaryDirectory() as folder:
            words = [sys.executable, "-m", "tests.benchmarks.fuzzing", kind, str(DATA), folder]
            child = subprocess.Popen(
                [*words, str(first), str(copies)],
                cwd=ROOT,
                env=environment(),
                stdout=subprocess.PIPE,
                text=True,
            )
            first = _follow(child, outcome, first, budget_s)
            if first < copies:  # it died, or was ended, while it read this one
                first += 1
    return outcome


def _processor_s(pid: int) -> float:
    """CPU time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _follow(child: subprocess.Popen[str], outcome: MappingResult, first: int, budget_s: float) -> int:
    """Count the reports of a child until it ends; return the copy that it would read next."""
    assert child.stdout is not None
    before, used_s, before_s = first, 0.0, outcome.used_s
    while True:
        if outcome.used_s > budget_s:
            child.kill()
            child.wait()
            return first
        heard_at = time.monotonic()
        while not select.select([child.stdout], [], [], _SILENT_S)[0]:
            asleep = time.monotonic() > heard_at + _SLEEPS_S
            if asleep or _processor_s(child.pid) > used_s + _HANGS_S:
                outcome.hangs += 1
                outcome.used_s = before_s + _processor_s(child.pid)
                child.kill()
                child.wait()
                return first
        line = child.stdout.readline()
        if not line:
            if child.wait() != 0:
                if first == before:
                    raise RuntimeError("the child cannot begin")
                outcome.crashes += 1
            return first
        number, refused, seconds, peak, fault = json.loads(line)
        first, used_s = number + 1, _processor_s(child.pid)
        outcome.used_s = before_s + used_s
        outcome.longest_s = max(outcome.longest_s, seconds)
        outcome.peak_mib = max(outcome.peak_mib, peak)
        outcome.hangs += seconds > LONGEST_S
        if fault:
            outcome.faults.append(fault)
        elif refused:
            outcome.refused += 1
        else:
            outcome.read += 1
