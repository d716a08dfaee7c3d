"""Maps one robot as `stemmap map zenoh:...` does: `live_mapper.py PORT NAME [RECORDING]`.

The program prints a line when it is ready. At a line on stdin it ends and prints the received and the mapped
scans with their times, and the CPU time of the recording.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

from app.robot.recorder import Recorder
from app.robot.source import LiveSource, open_live
from app.sources.request import with_odometry
from app.worker.cursor import Cursor, live_steps
from app.worker.numba_warmup import warm_up
from pipeline.config import preset
from pipeline.io.readers.container import Message
from pipeline.mapper import Mapper


class Costs:
    """Sums the CPU time of some methods of an object in the threads that call them."""

    def __init__(self) -> None:
        self.cpu_ns = 0

    def watch(self, thing: Any, *names: str) -> None:
        """Measure these methods from now on."""
        for name in names:
            setattr(thing, name, self._measured(getattr(thing, name)))

    def _measured(self, method: Any) -> Any:
        def measured(*arguments: Any, **named: Any) -> Any:
            began = time.thread_time_ns()
            try:
                return method(*arguments, **named)
            finally:
                self.cpu_ns += time.thread_time_ns() - began

        return measured


def _stop_at_a_line(source: LiveSource) -> None:
    sys.stdin.readline()
    source.stop()


def main(port: str, robot: str, place: str = "") -> None:
    """Map until a line arrives on stdin and no scan waits."""
    warm_up()
    costs = Costs()
    recording = Recorder(Path(place)) if place else None
    if recording is not None:
        costs.watch(recording, "add", "add_outputs", "_write_queue", "_write_skipped")
    with closing(open_live(f"zenoh:tcp/127.0.0.1:{port}?robot={robot}")) as source:
        source.start(recording)
        arrived: list[float] = []
        put = source._inbox.put

        def noted(message: Message, *, is_scan: bool) -> None:
            put(message, is_scan=is_scan)
            if is_scan:
                arrived.append(time.monotonic())

        source._inbox.put = noted  # type: ignore[method-assign]
        print(json.dumps({"ready": True}), flush=True)
        threading.Thread(target=_stop_at_a_line, args=(source,), daemon=True).start()
        if not source.wait():
            raise SystemExit("nothing was heard")
        description = source.description
        mapper = Mapper(
            preset("forest"), sensor=description.sensor, T_base_lidar=description.T_base_lidar, seed=0
        )
        moving, chosen = with_odometry(source, "auto")
        left_out = Counter[str]()
        cursor, mapped = Cursor(lambda: live_steps(source, chosen, moving, left_out), description.uri), []
        while not source._ending.is_set() or source.scans_waiting:
            step = cursor.take()
            if step is None:
                time.sleep(0.005)  # as the worker waits
                continue
            frame = mapper.process(step)
            source.mapped(frame, mapper.path)
            mapped.append(time.monotonic())
        told = {
            "came": source._link.scans,
            "mapped": len(mapped),
            "losses": source.losses,
            "latency_s": [done - at for at, done in zip(arrived, mapped, strict=False)],
            "cpu_s": time.process_time(),
            "recording_cpu_s": 1e-9 * costs.cpu_ns,
        }
    print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
