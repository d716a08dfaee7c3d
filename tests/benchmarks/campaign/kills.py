"""kill -9 of the server, and of the process that maps and records, during annotation and the recording of a
robot."""

from __future__ import annotations

import random
import time
from contextlib import ExitStack, closing
from pathlib import Path

from pipeline.io.readers import open_source
from pipeline.io.recording.mcap_writer import write_recording
from tests.app.robot.conftest import Child, free_port
from tests.benchmarks.campaign import Result
from tests.benchmarks.campaign.service import Edits, Service, check_edits, check_recording

KILLS = 3
DRIVE = "sim:stand?duration=20"
ROBOT = "robot1"
LOSS_S = 1.0  # of a recording that is killed, at most


def drive_in(folder: Path) -> Path:
    """Return the recording that robots of a campaign send."""
    drive = folder / "drive.mcap"
    if not drive.exists():
        with closing(open_source(DRIVE)) as source:
            known = source.description
            write_recording(drive, source.records(), sensor=known.sensor, T_base_lidar=known.T_base_lidar)
    return drive


def started(stack: ExitStack, *words: str) -> Child:
    """Start a process that ends with the stack, and wait for its first line."""
    child = Child(*words)
    stack.callback(child.kill)
    child.hear()
    return child


def run(turn: int, folder: Path) -> Result:
    """Annotate and record, and kill at random moments."""
    result, rng = Result(), random.Random(turn)
    place = folder / f"kills{turn}"
    edits: Edits = []
    for number in range(KILLS):
        recording = place / f"live{number}.mcap"
        _kill_once(result, place, recording, drive_in(folder), rng, edits)
        for path in sorted(place.glob(f"live{number}*.mcap")):
            if path.stat().st_size and ".mended" not in path.name:
                check_recording(result, path)
        check_edits(result, place, edits)
    return result


def _kill_once(
    result: Result,
    place: Path,
    recording: Path,
    drive: Path,
    rng: random.Random,
    edits: list[tuple[int, float]],
) -> None:
    """Start a robot and a server, annotate for a while, kill, and check whether the server continues."""
    with ExitStack() as stack:
        port = free_port()
        started(stack, "-m", "tests.app.robot.router", str(port))
        robot = started(stack, "-m", "tests.benchmarks.live_robot", str(port), str(drive), ROBOT)
        uri = f"zenoh:tcp/127.0.0.1:{port}?robot={ROBOT}"
        service = stack.enter_context(Service(result, uri, place, "--record", str(recording)))
        service.until_found()
        robot.go()
        service.until_scan(5)
        end = time.monotonic() + rng.uniform(0.5, 4.0)
        while time.monotonic() < end:
            service.annotate(edits, rng.uniform(-50.0, 50.0))
        who = rng.choice(("web", "worker"))
        service.kill(who)
        result.done += 1
        if who == "worker":
            service.until(lambda: service.worker() is not None, "started the worker again")
            service.until(lambda: service.status().get("state") in ("playing", "waiting"), "went on")
            service.annotate(edits, 0.0)
            time.sleep(LOSS_S)  # otherwise the recording of the new worker may be empty
