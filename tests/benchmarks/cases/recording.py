"""What a recording loses when its process is killed."""

from __future__ import annotations

import json
import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any

from tests.benchmarks.table import Table, verdict

NAME = "recording"
LINE = "A live recording whose process is killed (kill -9) twenty times, and one that has no more room"

KILLS = 20
SCANS, FULL_BYTES = 15, 1_500_000
LARGEST_LOSS_S = 1.0


def run() -> list[Table]:
    """Kill it at ever later times."""
    with tempfile.TemporaryDirectory() as folder:
        losses = [kill_once(Path(folder), k) for k in range(KILLS)]
        said = full_disk(Path(folder))
    worst = max(lost_s for _, _, lost_s in losses)
    rows = tuple((k + 1, heard, kept, 1e3 * lost_s) for k, (heard, kept, lost_s) in enumerate(losses))
    return [
        Table(
            f"{KILLS} recordings at about 6 MB/s, killed and mended",
            ("kill", "messages recorded", "messages mended", "lost ms"),
            rows,
            (
                "Lost: the time between the newest message that was taken and the newest in the mended file.",
                f"Worst: {1e3 * worst:.0f} ms; asked for: at most the last second: "
                f"{verdict(worst <= LARGEST_LOSS_S)}.",
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
    """What a live run tells whose recording has no more room."""
    from pipeline.geometry.poses import Pose3
    from pipeline.io.recording import write_recording
    from pipeline.types.records import Sensor
    from tests.app.robot.conftest import Child, clouds

    drive = folder / "clouds.mcap"
    mounted = Pose3.from_euler([0.2, 0.0, 0.9], 0.0, 0.0, 0.0)
    write_recording(drive, clouds(SCANS), sensor=Sensor("VLP-16", 16), T_base_lidar=mounted)
    child = Child("-m", "tests.app.robot.full_disk", str(drive), str(folder / "live.mcap"), str(FULL_BYTES))
    told: dict[str, Any] = json.loads(child.hear())
    child.kill()
    return told


def kill_once(folder: Path, k: int) -> tuple[int, int, float]:
    """Messages taken, messages that the mended file has, and how much time is missing at its end [s]."""
    from pipeline.io.readers import open_source
    from pipeline.io.recording import write_recording
    from pipeline.io.recording.mcap_writer import mend
    from tests.app.robot.conftest import Child

    drive, out, mended = folder / "drive.mcap", folder / f"killed{k}.mcap", folder / f"mended{k}.mcap"
    if not drive.exists():
        with closing(open_source("sim:stand?duration=3")) as source:
            known = source.description
            write_recording(drive, source.records(), sensor=known.sensor, T_base_lidar=known.T_base_lidar)
    child = Child("-m", "tests.app.robot.recorder", str(drive), str(out))
    told = [child.hear().split() for _ in range(60 + 13 * k)]
    child.kill()
    times = [float(at) for _, at in told]
    kept = min(mend(out, mended).messages, len(times))
    for path in (out, mended):
        path.unlink()
    return len(times), kept, times[-1] - times[kept - 1]
