"""Protocol of both sides of the comparison with the peer: requests for scans, answers with times."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from tests.benchmarks.child import answers
from tests.benchmarks.machine import peak_mib
from tests.benchmarks.recorded import RecordedScan, Recording

STAGES = ("acquisition and filters", "clustering", "shape and detection", "SLAM", "tracking")
WARM_SCANS = 5  # mapped but not counted, so that imports and compiled loops are loaded


class StageTimes:
    """Seconds of each stage of one scan."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] += time.perf_counter() - start


class Pipeline(Protocol):
    """One side of the comparison, which maps scan after scan."""

    def process(self, scan: RecordedScan, watch: StageTimes) -> None:
        """Map one scan."""

    def result(self) -> dict[str, Any]:
        """`trees` and `path`, rows of x, y [m], and `landmarks`, their number."""


Make = Callable[[Recording, dict[str, Any]], Pipeline]


def serve(make: Make) -> None:
    """Answer questions from stdin until it ends: {"scans": n} or {"result": true}.

    The words of the command line are the folder of the recording and the file of parameters.
    """
    recording = Recording.read(Path(sys.argv[1]))
    parameters = json.loads(Path(sys.argv[2]).read_text(encoding="utf-8"))
    with answers() as pipe:
        throwaway = make(recording, parameters)
        for k in range(min(WARM_SCANS, len(recording))):
            throwaway.process(recording.scan(k), StageTimes())
        pipeline, at = make(recording, parameters), 0
        for line in sys.stdin:
            question = json.loads(line)
            if "scans" in question:
                wanted = range(at, min(at + question["scans"], len(recording)))
                answer: dict[str, Any] = {"times": [_timed(pipeline, recording.scan(k)) for k in wanted]}
                at += len(wanted)
            else:
                answer = {**pipeline.result(), "peak_mib": peak_mib()}
            pipe.write(json.dumps(answer) + "\n")
            pipe.flush()


def _timed(pipeline: Pipeline, scan: RecordedScan) -> dict[str, float]:
    """Milliseconds of each stage and in total."""
    watch = StageTimes()
    start = time.perf_counter()
    pipeline.process(scan, watch)
    total = time.perf_counter() - start
    return {**{stage: 1e3 * s for stage, s in watch.seconds.items()}, "total": 1e3 * total}
