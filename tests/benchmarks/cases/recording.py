"""Losses of a recording whose process is killed."""

from __future__ import annotations

import json
import tempfile
from contextlib import closing
from pathlib import Path
from statistics import median
from typing import Any

from tests.benchmarks.table import Table, verdict

NAME = "recording"
LINE = "A live recording whose process is killed (kill -9) 100 times, and one that has no more room"

KILLS = 100
PACES = {"": "none", "slow": "five times slower than the robot"}  # half of the kills each
SCANS, FULL_BYTES = 15, 1_500_000
LARGEST_LOSS_S = 1.0


def run() -> list[Table]:
    """Kill the process 1 to 5 s after the first message."""
    rows: list[tuple[str, int, int, int, float, float, int]] = []
    with tempfile.TemporaryDirectory() as folder:
        for pace, mapping in PACES.items():
            kills = [kill_once(Path(folder), k, pace) for k in range(KILLS // len(PACES))]
            heard, kept, lost_s, holes = zip(*kills, strict=True)
            ms = [1e3 * each for each in lost_s]
            rows.append((mapping, len(kills), sum(heard), sum(kept), median(ms), max(ms), sum(holes)))
            print(rows[-1], flush=True)
        said = full_disk(Path(folder))
    worst, missing = max(row[5] for row in rows), sum(row[6] for row in rows)
    return [
        Table(
            f"{KILLS} recordings at about 6 MB/s, killed and mended",
            ("mapping", "kills", "messages recorded", "mended", "median lost ms", "most lost ms", "holes"),
            tuple(rows),
            (
                "Lost: the time between the newest message that was taken and the newest in the mended file. "
                "Holes: recordings in which a message before the newest one is missing.",
                f"Required: at most the last second, {verdict(worst <= 1e3 * LARGEST_LOSS_S)}; no hole, "
                f"{verdict(missing == 0)}.",
            ),
        ),
        Table(
            f"A file that may not grow beyond {1e-6 * FULL_BYTES:g} MB, in the middle of a live run",
            ("scans mapped", "of", "said after ms"),
            ((said["shown"], SCANS, 1e3 * said["said_after_s"]),),
            (
                "Said: from the refused write to the status that the page shows. Asked for: within 1 s, and "
                f"every scan mapped: {verdict(said['said_after_s'] <= 1.0 and said['shown'] == SCANS)}.",
            ),
        ),
    ]


def full_disk(folder: Path) -> dict[str, Any]:
    """Messages of a live run whose recording cannot grow."""
    from pipeline.geometry.poses import Pose3
    from pipeline.io.recording.mcap_writer import write_recording
    from pipeline.types.records import Sensor
    from tests.app.robot.conftest import Child, clouds

    drive = folder / "clouds.mcap"
    mounted = Pose3.from_euler([0.2, 0.0, 0.9], 0.0, 0.0, 0.0)
    write_recording(drive, clouds(SCANS), sensor=Sensor("VLP-16", 16), T_base_lidar=mounted)
    child = Child("-m", "tests.app.robot.full_disk", str(drive), str(folder / "live.mcap"), str(FULL_BYTES))
    told: dict[str, Any] = json.loads(child.hear())
    child.kill()
    return told


def kill_once(folder: Path, k: int, pace: str = "") -> tuple[int, int, float, bool]:
    """Return the number of received messages and of messages in the repaired file, the missing time at its
    end [s], and whether an earlier message is missing."""
    from pipeline.io.readers import open_source
    from pipeline.io.readers.mcap_file import McapFile
    from pipeline.io.recording.mcap_writer import repair, write_recording
    from tests.app.robot.conftest import Child

    drive, out, mended = folder / "drive.mcap", folder / f"killed{k}.mcap", folder / f"mended{k}.mcap"
    if not drive.exists():
        with closing(open_source("sim:stand?duration=3")) as source:
            known = source.description
            write_recording(drive, source.records(), sensor=known.sensor, T_base_lidar=known.T_base_lidar)
    child = Child("-m", "tests.app.robot.recorder", str(drive), str(out), *([pace] if pace else []))
    told = [child.hear().split() for _ in range(60 + 67 * k % 250)]
    child.kill()
    times = {int(number): float(at) for number, at in told}
    repair(out, mended)
    with closing(McapFile(mended)) as recording:
        numbers = [channel.number for channel in recording.channels]
        kept = sorted(m.log_ns for m in recording.messages(numbers, None, {}) if m.log_ns in times)
    for path in (out, mended):
        path.unlink()
    return len(times), len(kept), times[len(times)] - times[kept[-1]], kept != list(range(1, len(kept) + 1))
