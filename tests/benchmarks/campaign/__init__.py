"""Kinds of steps of the benchmark `campaign`: functions of a turn and a folder that return a `Result`."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class Result:
    """Result of one step.

    Attributes:
        done: Number of files, requests, kills or connections.
        faults: Faults, one line each.
        longest_s: Longest time of one of them [s].
        peak_mib: Peak memory of a process of stemmap [MiB].
        edits: Edits that the server acknowledged; all are checked.
    """

    done: int = 0
    faults: list[str] = field(default_factory=list)
    longest_s: float = 0.0
    peak_mib: float = 0.0
    edits: int = 0
