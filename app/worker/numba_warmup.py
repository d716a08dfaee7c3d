"""Compilation of the kernels of the mapper before the first scan.

Two processes compile them: `python -m app.worker.numba_warmup map_scene` maps a scene and begins with the
front end, while `... warm_tree_map` compiles SLAM and the filters of the trees, which the first one then
finds in the cache. `python -m app.worker.numba_warmup` runs both and waits for them.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from app.common.child_process import BlockingChildProcess, python_module, run_child
from app.common.settings import data_folder
from app.store.forests import mapper_of
from pipeline.config import Parameters

if TYPE_CHECKING:
    from pipeline.types.records import Step

#: Longest wait for another process that compiles. Kernels that are compiled until then are cached.
PATIENCE_S = 1800.0
_PROGRAMS = ("map_scene", "warm_tree_map")
_POLL_S = 0.2
_KERNELS = 252  # that both programs compile; only the displayed progress depends on it


def compile_ahead() -> None:
    """Compile the kernels of the mapper in two processes, unless they are cached already, and wait for them.
    Without a second core nothing is done.

    Kernels that remain uncompiled, also after errors of the processes, are compiled at their first call.
    While another process of the user compiles, it waits for up to half an hour.

    Raises:
        StemmapError: A process cannot be started.
    """
    if _cores() < len(_PROGRAMS) or is_compiled():
        return
    with _one_at_a_time():
        if not is_compiled():  # another process may have compiled them meanwhile
            _compile()


def is_compiled() -> bool:
    """Return whether the kernels of both programs are cached for the current sources, by the kernel that each
    program compiles last."""
    from pipeline.jit import is_kept
    from pipeline.remapping.preview import grouped
    from pipeline.tracking.track_classification import classify_new

    return is_kept(grouped) and is_kept(classify_new)


def compiled_share() -> float:
    """Return the share of the kernels of both programs that are cached for the current sources, 0 to 1. It is
    an estimate: the number of cached kernels divided by `_KERNELS`."""
    from pipeline.jit import count_kept

    return min(1.0, count_kept() / _KERNELS)


def _cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _start(program: str) -> BlockingChildProcess:
    """Start the process that runs one of `_PROGRAMS`; raises StemmapError if the system cannot start it."""
    return BlockingChildProcess(python_module("app.worker.numba_warmup", program))


def _compile() -> None:
    """Run both programs in processes of their own and wait for them, at most PATIENCE_S; then they are ended.
    Their errors are ignored. The functions of `on_compiling` are called meanwhile."""
    from pipeline.jit import others_compile

    with contextlib.ExitStack() as stack:
        children = []
        for program in _PROGRAMS:
            children.append(_start(program))
            stack.callback(children[-1].end)
        until_s = time.monotonic() + PATIENCE_S
        while any(child.returncode is None for child in children) and time.monotonic() < until_s:
            others_compile()
            time.sleep(_POLL_S)


@contextlib.contextmanager
def _one_at_a_time() -> Iterator[None]:
    """Hold the lock with which only one process of a user compiles at a time; the next one then finds the
    cache.

    A process that waited for PATIENCE_S continues without the lock. Without a folder for the lock, or without
    file locks on this system, no process waits.
    """
    from pipeline.jit import others_compile

    until_s = time.monotonic() + PATIENCE_S
    with contextlib.ExitStack() as stack:
        folder = data_folder(os.environ)
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
                lock = stack.enter_context((folder / "compiling.lock").open("a"))
                while time.monotonic() < until_s:
                    with contextlib.suppress(BlockingIOError):
                        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                        break
                    others_compile()
                    time.sleep(_POLL_S)
        yield


_SCENE = "sim:stand?duration=1"


def warm_up() -> None:
    """Compile or load all kernels of the mapper. The first time on a machine this takes minutes. Errors as
    `compile_ahead`."""
    compile_ahead()
    map_scene()


def map_scene() -> None:
    """Compile or load all kernels by mapping one second of a simulated stand in this process, with a step
    back and a preview."""
    from pipeline.io.readers import open_source
    from pipeline.odometry.synchroniser import steps
    from pipeline.remapping.preview import ClusterTable, KnownMap, preview_trees

    source, parameters, clusters, columns = open_source(_SCENE), Parameters(), ClusterTable(), None
    mapper = mapper_of(source.description, parameters, seed=0)
    for step in steps(source.records()):
        frame = mapper.process(step)
        clusters.record(frame)
        columns = frame.columns
    mapper.snapshot().gathering.folded()  # as a step back does
    preview_trees(KnownMap(parameters, clusters, mapper.path, columns), parameters)


def warm_tree_map() -> None:
    """Compile the kernels of SLAM, of the Kalman filters of the trees and of the preview, by mapping
    simulated stems."""
    from pipeline.classification import no_columns
    from pipeline.config import preset
    from pipeline.geometry.poses import Pose3
    from pipeline.mapper import Mapper
    from pipeline.remapping.preview import ClusterTable, KnownMap, preview_trees
    from pipeline.tracking import Tracker
    from pipeline.tracking.track_classification import tree_columns
    from pipeline.types.records import Sensor

    # All scans resample, which usual ones do late in a run.
    stems, clusters = preset("stems").replace({"slam.resample_below": 1.0}), ClusterTable()
    mapper = Mapper(stems, sensor=Sensor(), T_base_lidar=Pose3.identity(), seed=0)
    for step in _stems():
        clusters.record(mapper.process(step))
    known = KnownMap(stems, clusters, mapper.path, None)
    preview_trees(known, stems.replace({"tracking.hits_to_confirm": 4}))
    tracker = Tracker(stems.tracking)
    tree_columns(tracker.classify(0, no_columns(), stems.classification))
    tracker.classify_new(no_columns())


def _stems() -> Iterator[Step]:
    """Yield twelve steps, 0.1 s apart, of a robot that drives 0.5 m per scan along x, between trees in a grid
    with spacings of 3 m in x and 2.5 to 3 m in y; then one without trees, so far away that the trees are
    those of another place, and two between the trees again."""
    from pipeline.geometry.poses import Pose2
    from pipeline.types.records import Scan, Stems, Step

    x, y = np.meshgrid(np.arange(-6.0, 12.0, 3.0), np.array([-4.0, -1.5, 1.5, 4.0]))
    for index, along in enumerate([*np.arange(0.0, 6.0, 0.5), 50.0, 0.0, 0.5]):
        places = np.column_stack([x.ravel() - along, y.ravel(), np.zeros(x.size)]).astype(np.float32)
        places = places[: 0 if along > 6.0 else x.size]
        upright = np.tile([0.0, 0.0, 1.0], (len(places), 1))
        scan = Scan(100_000_000 * index, places, stems=Stems(upright, np.full(len(places), 0.3)))
        yield Step(index, scan, Pose2(along, 0.0, 0.0))


if __name__ == "__main__":
    _programs = {"warm_up": warm_up, "map_scene": map_scene, "warm_tree_map": warm_tree_map}
    if sys.argv[1:]:
        run_child(lambda _: _programs[sys.argv[1]]())
    warm_up()
    warm_tree_map()
