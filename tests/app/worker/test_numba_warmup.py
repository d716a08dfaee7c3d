"""Two processes compile what one mapper calls: no more, no less, and nobody waits when it is kept."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from app.common.child_process import BlockingChildProcess
from app.worker import numba_warmup
from pipeline.jit import on_compiling

ROOT = Path(__file__).resolve().parents[3]

# Which types the kernels of the package were called with, before and after a run is mapped.
PROGRAM = """
import sys
from numba.core.dispatcher import Dispatcher
from app.worker.numba_warmup import (
    compile_scans, compiled_kernels, is_compiled, last_kernels, map_stems, warm_up
)
from app.worker.process import new_session
from app.worker.protocol import Open
from pipeline.config import PRESETS, Parameters, preset
from pipeline.geometry.poses import Pose3
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.slam.particle_maps import take_ancestors
from pipeline.tracking.track_classification import classify_new
from tests.benchmarks.troubled import PLACES, SENSOR, TROUBLES, drive, parameters as parameters_of_stems


def seen():
    return {
        (kernel.__module__, kernel.__name__, str(signature))
        for name, module in list(sys.modules.items()) if name.startswith("pipeline.")
        for kernel in vars(module).values() if isinstance(kernel, Dispatcher)
        for signature in kernel.signatures
    }

last_of_scans, last_of_stems = last_kernels()
map_stems()
assert last_of_stems.signatures
assert not last_of_scans.signatures  # else a process would take this program for both
compile_scans()
assert last_of_scans.signatures
assert is_compiled()
compiled, of_all = compiled_kernels()
assert compiled > 0.95 * of_all, compiled
# What a run calls later: at a resampling, at a revisit, and with the first tree of a column.
late = [take_ancestors, classify_new]
assert all(kernel.signatures for kernel in late), [kernel.signatures for kernel in late]
before = seen()
assert len(before) > 20, before
warm_up()
session = new_session()
session.open(Open("sim:stand?duration=1", "auto", 0))
session.set_parameters(Parameters(), 0)
session.advance(10)
while session.pace == "hurry":
    session.work()
for revision, change in enumerate([{"classification.tree_share": 0.7}, {"detection.e_max": 20.0}]):
    session.set_parameters(Parameters().replace(change), revision + 1, whole=True)
    assert session.is_remapping
    while session.is_remapping:
        session.remap()
session.close()
small = {"classification.voxels_log2": 12}  # the map of voxels is full soon
for parameters in [Parameters().replace(small), *map(preset, PRESETS)]:
    session.open(Open("sim:stand?duration=1", "auto", 0))
    session.set_parameters(parameters, 0)
    session.advance(10)
    while session.pace == "hurry":
        session.work()
session.close()
for place, trouble in [("stand", "gap, pushed"), ("a circle", "gap, odometry restarts"), ("stand", "stuck")]:
    mapper = Mapper(parameters_of_stems(), sensor=SENSOR, T_base_lidar=Pose3.identity(), seed=0)
    states = [mapper.process(step).estimate.health.state
              for step in steps(drive(PLACES[place], 0, TROUBLES[trouble]).records)]
    assert states.count("good") < len(states), trouble
late = {kernel for kernel in seen() - before if not kernel[0].startswith("pipeline.simulation.")}
print(*sorted(late), sep="\\n", end="")
"""


@pytest.mark.slow
def test_the_halves_compile_what_drives_with_troubles_and_a_slider_call():
    run = [sys.executable, "-c", PROGRAM]
    told = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, timeout=600, check=True)
    assert not told.stdout


def test_both_halves_are_waited_for_and_told(monkeypatch, tmp_path):
    started = []

    def start(half: str) -> BlockingChildProcess:
        program = f"import time; time.sleep(0.5); open({str(tmp_path / half)!r}, 'w').close()"
        started.append(BlockingChildProcess([sys.executable, "-c", program]))
        return started[-1]

    monkeypatch.setattr(numba_warmup, "is_compiled", lambda: False)
    monkeypatch.setattr(numba_warmup, "_start", start)
    monkeypatch.setattr(numba_warmup, "usable_cores", lambda: 2)
    told = []
    with on_compiling(lambda: told.append(1)):
        numba_warmup.compile_ahead()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["compile_scans", "map_stems"]
    assert [process.returncode for process in started] == [0, 0]
    assert told


def test_the_longest_program_begins_and_the_other_follows_at_the_second_step(monkeypatch):
    started = []

    def start(program: str) -> BlockingChildProcess:
        started.append(program)
        return BlockingChildProcess([sys.executable, "-c", "import sys; sys.stdin.read()"])

    monkeypatch.setattr(numba_warmup, "is_compiled", lambda: False)
    monkeypatch.setattr(numba_warmup, "is_front_end_compiled", lambda: len(started) == 2)
    monkeypatch.setattr(numba_warmup, "_start", start)
    monkeypatch.setattr(numba_warmup, "usable_cores", lambda: 2)
    steps = numba_warmup.compiling()
    assert next(steps) is False
    assert started == ["compile_scans"]
    assert next(steps) is True
    assert started == ["compile_scans", "map_stems"]
    steps.close()  # ends both


def test_who_comes_second_waits_and_finds_all_kept(monkeypatch, tmp_path):
    fcntl = pytest.importorskip("fcntl", reason="no locks of files on this system")
    monkeypatch.setenv("STEMMAP_FOLDER", str(tmp_path))
    first = (tmp_path / "compiling.lock").open("w")
    fcntl.flock(first, fcntl.LOCK_EX)
    monkeypatch.setattr(numba_warmup, "is_compiled", lambda: first.closed)
    monkeypatch.setattr(numba_warmup, "_start", lambda half: pytest.fail(half))
    monkeypatch.setattr(numba_warmup, "usable_cores", lambda: 2)
    with on_compiling(first.close):  # the first is done while the second waits
        numba_warmup.compile_ahead()
    assert first.closed


def test_a_person_who_waits_no_longer_leaves_none_behind(monkeypatch):
    started = []

    def start(half: str) -> BlockingChildProcess:
        del half
        started.append(BlockingChildProcess([sys.executable, "-c", "import time; time.sleep(60)"]))
        return started[-1]

    def interrupt() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(numba_warmup, "is_compiled", lambda: False)
    monkeypatch.setattr(numba_warmup, "_start", start)
    monkeypatch.setattr(numba_warmup, "usable_cores", lambda: 2)
    with on_compiling(interrupt), pytest.raises(KeyboardInterrupt):
        numba_warmup.compile_ahead()
    assert None not in [process.returncode for process in started]
