"""CPU time of whole drives by stage, and of a step of SLAM compared with its limits."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from tests.benchmarks.cases.slam import OBSERVED, Driven, plain_python
from tests.benchmarks.table import Cell, Table
from tests.benchmarks.timing import in_turns, middle

if TYPE_CHECKING:
    from pipeline.slam.particle_maps import Maps
    from pipeline.types.records import Float

NAME = "profile"
LINE = "Computing time of whole drives by stage, and of a step of SLAM beside its limit by the memory"

SCANS = 3000  # of a drive
WARM_SCANS = 60
#: Bytes of a landmark in the maps: position, covariance, hits, score, birth.
LANDMARK, POSITION = 56, 16
COPIED = 1 << 27  # bytes of the array with which the bandwidth is measured
FRONT_END = (
    "acquisition", "pass-through", "ground", "voxel grid", "clustering", "shape", "free view", "obstacles",
    "detection",
)  # fmt: skip
STAGES = ("front end", "slam", "tracking", "gathering", "height map", "rest")


@dataclass(slots=True)
class Profile:
    """CPU time of a drive: of each stage [s], and milliseconds, detections and landmarks within reach of each
    scan that SLAM used."""

    scans: int = 0
    total_s: float = 0.0
    stage_s: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    step_ms: list[float] = field(default_factory=list)
    detections: list[int] = field(default_factory=list)
    landmarks: list[int] = field(default_factory=list)
    particles: int = 0
    measuring_s: float = 0.0  # of the numbers above, in the stage "slam"

    @contextmanager
    def watch(self, stage: str) -> Iterator[None]:
        """Add the time of a stage."""
        begin = time.thread_time()
        try:
            yield
        finally:
            self.stage_s["front end" if stage in FRONT_END else stage] += time.thread_time() - begin

    def watched(self, use_scan: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that calls `use_scan` and records its time and size."""
        from pipeline.slam.particle_maps import known_near

        def watched(pose: Float, weight: Float, maps: Maps, *rest: Any) -> Any:
            reach = rest[8].view_range
            begin = time.thread_time()
            near = known_near(maps, 0, pose[0, 0], pose[0, 1], reach)[0]
            looked = time.thread_time()
            result = use_scan(pose, weight, maps, *rest)
            self.step_ms.append(1e3 * (time.thread_time() - looked))
            self.detections.append(len(rest[3]))
            self.landmarks.append(len(near))
            self.particles = len(pose)
            self.measuring_s += time.thread_time() - begin - 1e-3 * self.step_ms[-1]
            return result

        return watched


def run() -> list[Table]:
    """The simulated drive, and the recordings of the data folder."""
    profiles = {}
    with tempfile.TemporaryDirectory(prefix="stemmap-profile-") as folder:
        for name, uri in _drives(Path(folder)):
            print(name, file=sys.stderr, flush=True)
            for scans in (WARM_SCANS, SCANS):
                profiles[name] = _profile(uri, scans)
    return [_by_stage(profiles), _steps(profiles)]


def _drives(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield name and URI of each drive; recordings without odometry get simulated odometry with drift."""
    import numpy as np

    from app.extensions.formats.tree_manager import TRAJECTORY, trajectory_text
    from tests.benchmarks.cases.oxford import BIAS, DISTANCE, TURN
    from tests.benchmarks.tree_manager_folder import perturbed, read_recorded, write_states

    yield "sim:long, 100 s", "sim:long?duration=100"
    data = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
    for name, file in (("Oxford Evo", "oxford_evo/Evo.npz"), ("Wild-Places V03", "wild_places/Wild_V03.npz")):
        if (data / file).is_file():
            recorded, states = read_recorded(data / file), folder / name
            states.mkdir()
            write_states(recorded, states, 1)
            rng = np.random.default_rng(1)
            odometry = perturbed(
                recorded.poses, distance=DISTANCE, turn=np.radians(TURN), bias=np.radians(BIAS), rng=rng
            )
            text = trajectory_text(recorded.stamp_ns, odometry)
            (states / TRAJECTORY).write_text(text, encoding="utf-8")
            yield name, str(states)
    park = data / "victoria_park" / "victoria_park_ascii.zip"
    if park.is_file():
        yield "Victoria Park", str(park)


def _profile(uri: str, scans: int) -> Profile:
    """Map a drive and return its CPU times without the reading."""
    from pipeline.config import preset
    from pipeline.io.readers import open_source
    from pipeline.mapper import Mapper
    from pipeline.odometry.synchroniser import steps
    from pipeline.slam.particle_update import use_scan

    found = Profile()
    with (
        closing(open_source(uri)) as source,
        patch("pipeline.slam.fastslam.use_scan", found.watched(use_scan)),
    ):
        known = source.description
        mapper = Mapper(
            preset(known.preset),
            sensor=known.sensor,
            T_base_lidar=known.T_base_lidar,
            seed=1,
            timer=found.watch,
        )
        for step in islice(steps(source.records()), scans):
            begin = time.thread_time()
            mapper.process(step)
            found.total_s += time.thread_time() - begin
            found.scans += 1
    found.stage_s["slam"] -= found.measuring_s
    found.total_s -= found.measuring_s
    found.stage_s["rest"] = found.total_s - sum(found.stage_s.values())
    return found


def _by_stage(profiles: dict[str, Profile]) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (stage, *(1e3 * p.stage_s[stage] / p.scans for p in profiles.values())) for stage in STAGES
    ]
    rows.append(("total", *(1e3 * p.total_s / p.scans for p in profiles.values())))
    rows.append(("scans", *(p.scans for p in profiles.values())))
    rows.append(("total [s]", *(p.total_s for p in profiles.values())))
    return Table(
        "Mean CPU time of a scan [ms]",
        ("stage", *profiles),
        tuple(rows),
        (
            "Preset of each source, 100 particles, seed 1. SLAM uses the detections of some scans, see the "
            "next table. Rest: solution of the graph, corrections of the map, the record of the scan.",
        ),
    )


def _steps(profiles: dict[str, Profile]) -> Table:
    copied_gb = bandwidth()
    columns = (
        "scans",
        "used scans",
        "detections",
        "landmarks within reach",
        "ms a step",
        "ns a detection and particle",
        "limit of the memory [ms]",
        "ratio",
    )
    rows: list[tuple[Cell, ...]] = []
    for name, p in profiles.items():
        found, near, ms = middle(p.detections), middle(p.landmarks), middle(p.step_ms)
        size = p.particles * (near * POSITION + 2 * found * LANDMARK)
        limit = 1e-6 * size / copied_gb
        pair = 1e6 * ms / (p.particles * found) if found else None
        rows.append((name, len(p.step_ms), round(found), round(near), ms, pair, limit, f"{ms / limit:.1f}x"))
    peer = Driven(plain_python(100), 30)
    ms = middle(in_turns({"peer": peer}, 5, clock=time.thread_time)["peer"])
    rows.append(("plain Python", 5, OBSERVED, 30, ms, 1e6 * ms / (100 * OBSERVED), None, ""))
    return Table(
        "A step of SLAM with 100 particles (kernel `use_scan`), medians",
        columns,
        tuple(rows),
        (
            f"Limit of the memory: each particle reads the positions of the landmarks in reach ({POSITION} "
            f"bytes each), and reads and writes one landmark ({LANDMARK} bytes) for each detection, at the "
            f"bandwidth of a copy in one thread ({copied_gb:.1f} GB/s of read and written bytes).",
        ),
    )


def bandwidth() -> float:
    """Return the bytes that one thread reads and writes per second in a copy of a large array [GB/s]."""
    import numpy as np

    source, target = np.ones(COPIED, np.uint8), np.zeros(COPIED, np.uint8)
    ms = middle(in_turns({"copy": lambda: np.copyto(target, source)}, 5)["copy"])
    return 2e-6 * COPIED / ms
