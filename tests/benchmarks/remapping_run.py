"""A process that maps a run again after each requested change of parameters. It is a separate program, which
also runs with the packages of another clone."""

from __future__ import annotations

import json
import os
import sys
import time

from app.worker.process import new_session
from app.worker.protocol import Open
from app.worker.session import Session
from pipeline.config import Parameters, preset

WARM_SCANS = 40  # mapped before, so that all kernels are compiled


def main() -> None:
    """Map the first scans of a source, given on the command line, and answer requests of one line from
    stdin: {"change": [name, value]}, with the seconds until the new map and its number of trees."""
    pipe = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    uri, scans = sys.argv[1], int(sys.argv[2])
    warm, session = _mapped(uri, WARM_SCANS), _mapped(uri, scans)
    for line in sys.stdin:
        name, value = json.loads(line)["change"]
        tried = preset("forest").replace({name: value})
        _remap(warm, tried)
        answer = _remap(session, tried)
        _remap(warm, preset("forest"))
        _remap(session, preset("forest"))  # the kept map continues
        pipe.write(json.dumps(answer) + "\n")
        pipe.flush()


def _mapped(uri: str, scans: int) -> Session:
    """Return a session after so many scans, preset forest."""
    session = new_session()
    session.open(Open(uri, "auto", 0))
    session.set_parameters(preset("forest"), 0)
    session.advance(scans)
    while session.pace == "hurry":
        session.work()
    return session


def _remap(session: Session, parameters: Parameters) -> dict[str, float]:
    """Map the whole run again; return the seconds by the wall clock and of the processor, and the number of
    confirmed trees."""
    wall, cpu = time.perf_counter(), time.process_time()
    session.set_parameters(parameters, 1, whole=True)
    done = None
    while done is None:
        done = session.remap()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return {"s": wall, "cpu_s": cpu, "trees": int(done[0].trees.confirmed.sum())}


if __name__ == "__main__":
    main()
