"""Compilation of the kernels of the mapper before the first scan.

Two processes compile them: `python -m app.worker.numba_warmup compile_scans` compiles the front end and the
columns, while `... map_stems` compiles SLAM and the filters of the trees. In both, what the first scan of a
run needs comes first. `python -m app.worker.numba_warmup` runs both and waits for them, then compiles the
simulator.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import time
from collections.abc import Callable, Generator, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from app.common.child_process import BlockingChildProcess, python_module, run_child, usable_cores
from app.common.settings import data_folder
from app.store.forests import kept_forests
from pipeline.config import Parameters
from pipeline.geometry.poses import Pose2, Pose3

if TYPE_CHECKING:
    from pipeline.mapper import Mapper
    from pipeline.types.records import Float32, Step

#: Longest wait for another process that compiles. Kernels that are compiled until then are cached.
PATIENCE_S = 1800.0
#: The first one begins with what takes longest, and what a scan needs first.
PROGRAMS = ("compile_scans", "map_stems")
_POLL_S = 0.2
_OTHER_S = 120.0  # on a quiet machine, the other program ends within a minute
_KERNELS = 233  # that both programs compile; only the displayed progress depends on it


def compile_ahead() -> None:
    """Compile the kernels of the mapper in two processes, unless they are cached already, and wait for them.
    Without a second core nothing is done.

    Kernels that remain uncompiled, also after errors of the processes, are compiled at their first call.
    While another process of the user compiles, it waits for up to half an hour.

    Raises:
        StemmapError: A process cannot be started.
    """
    for _ in compiling():
        time.sleep(_POLL_S)


def compiling() -> Generator[bool, None, None]:
    """Compile as `compile_ahead`, and yield until all kernels are there whether those of the front end are.
    The processes end when the iterator is closed. The functions of `on_compiling` are called before each
    yield.

    The second process starts at the second step, so that the caller can compile the kernels of its source in
    the first one on its own core.
    """
    if usable_cores() < len(PROGRAMS) or is_compiled():
        return
    with contextlib.ExitStack() as stack:
        yield from _lock(stack)
        if not is_compiled():  # another process may have compiled them meanwhile
            yield from _compile(stack)


def is_compiled() -> bool:
    """Return whether the kernels of both programs are cached for the current sources, by `last_kernels`."""
    from pipeline.jit import is_kept

    return all(map(is_kept, last_kernels()))


def last_kernels() -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return for each of PROGRAMS the last kernel that it compiles and the other one does not."""
    from pipeline.detection.cluster_shape import spread_about
    from pipeline.loop_closure.stem_matching import partners

    return spread_about, partners


def is_front_end_compiled() -> bool:
    """Return whether the kernels of the front end are cached for the current sources, by the kernel that it
    calls last."""
    from pipeline.classification import view_by_direction
    from pipeline.jit import is_kept

    return is_kept(view_by_direction)


def compiled_kernels() -> tuple[int, int]:
    """Return how many kernels of both programs are cached for the current sources, and how many there are.
    Both are estimates: other kernels that are cached are counted up to `_KERNELS`."""
    from pipeline.jit import count_kept

    return min(_KERNELS, count_kept()), _KERNELS


def _start(program: str) -> BlockingChildProcess:
    """Start the process that runs one of `_PROGRAMS`; raises StemmapError if the system cannot start it."""
    return BlockingChildProcess(python_module("app.worker.numba_warmup", program))


def _compile(stack: contextlib.ExitStack) -> Iterator[bool]:
    """Run both programs in processes of their own, and yield as `compiling` until they end, at most
    PATIENCE_S. Their errors are ignored.

    Args:
        stack: Ends the processes.
    """
    from pipeline.jit import others_compile

    children, until_s = list[BlockingChildProcess](), time.monotonic() + PATIENCE_S
    while len(children) < len(PROGRAMS) or any(child.returncode is None for child in children):
        if len(children) < len(PROGRAMS):
            children.append(_start(PROGRAMS[len(children)]))
            stack.callback(children[-1].end)
        if time.monotonic() > until_s:
            return
        others_compile()
        yield is_front_end_compiled()


def _lock(stack: contextlib.ExitStack) -> Iterator[bool]:
    """Take the lock with which only one process of a user compiles at a time; the next one then finds the
    cache. Yield as `compiling` while another process holds it.

    A process that waited for PATIENCE_S continues without the lock. Without a folder for the lock, or without
    file locks on this system, no process waits.

    Args:
        stack: Releases the lock.
    """
    from pipeline.jit import others_compile

    folder, until_s = data_folder(os.environ), time.monotonic() + PATIENCE_S
    with contextlib.suppress(ImportError, OSError):
        import fcntl

        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            lock = stack.enter_context((folder / "compiling.lock").open("a"))
            while time.monotonic() < until_s:
                with contextlib.suppress(BlockingIOError):
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    return
                if is_compiled():  # its holder may be suspended
                    return
                others_compile()
                yield is_front_end_compiled()


def warm_up() -> None:
    """Compile or load all kernels of the mapper. The first time on a machine this takes minutes. Errors as
    `compile_ahead`."""
    compile_ahead()
    map_scans()


def compile_scans() -> None:
    """Compile the kernels of the front end, of the columns and of the terrain, which need no SLAM, in the
    order in which a scan needs them, and those of other presets; then those that only whole scans need, see
    `map_scans`. Before these, it waits up to _OTHER_S for the other program, which would otherwise compile
    the same kernels."""
    from pipeline.classification import ColumnClassifier, ScanView
    from pipeline.config import preset
    from pipeline.front_end import detect
    from pipeline.ground.terrain_map import HeightMapper
    from pipeline.jit import is_kept
    from pipeline.tracking.track_classification import classify_new

    mapper, terrain = _mapper(Parameters()), HeightMapper()
    columns = ColumnClassifier(mapper.parameters.classification, all_around=True, forests=kept_forests())
    for step in _scans():
        scan = mapper.segment(step)
        pose, given = step.T_odom_base or Pose2(), scan.column_input
        if given is not None:
            view = ScanView(pose, scan.sensor_offset, scan.free, given.steepest, given.depth, given.terrain)
            columns.add(given.points, given.height, step.index, view)
        elif columns.is_unsettled:
            columns.settle()
        if scan.terrain is not None:
            terrain.add(scan.terrain, pose, scan.sensor_offset)
    for name in ("laser2d", "paper"):  # which find clusters in another way
        mapper = _mapper(preset(name))
        detect(mapper.segment(next(_scans())), mapper.parameters.detection)
    until_s = time.monotonic() + _OTHER_S
    while not is_kept(classify_new) and time.monotonic() < until_s:
        time.sleep(_POLL_S)
    map_scans()


def map_scans() -> None:
    """Compile or load all kernels of the mapper by mapping scans in this process, with a step back and a
    preview."""
    from pipeline.remapping.preview import ClusterTable, KnownMap, preview_trees

    mapper, clusters, columns = _mapper(Parameters()), ClusterTable(), None
    for step in _scans():
        frame = mapper.process(step)
        clusters.record(frame)
        columns = frame.columns
    mapper.snapshot().gathering.folded()  # as a step back does
    preview_trees(KnownMap(mapper.parameters, clusters, mapper.path, columns), mapper.parameters)


def _mapper(parameters: Parameters) -> Mapper:
    """Return a mapper of the scans of `_scans`, whose voxel map is so small that it becomes full."""
    from pipeline.mapper import Mapper
    from pipeline.types.records import Sensor

    azimuth_step = 2.0 * np.pi / _SHOTS
    return Mapper(
        parameters.replace({"classification.voxels_log2": 12}),
        sensor=Sensor("VLP-16", _RINGS, float(np.radians(2.0)), azimuth_step, range_sigma=_NOISE),
        T_base_lidar=Pose3.from_euler(np.array([0.0, 0.0, _SENSOR_Z]), 0.0, 0.0, 0.0),
        seed=0,
        forests=kept_forests(),
    )


def _scans() -> Iterator[Step]:
    """Yield ten steps of a robot that drives 0.1 m in the 0.1 s between two scans."""
    from pipeline.types.records import Scan, Step

    for index in range(10):
        along, at_ns = 0.1 * index, 100_000_000 * index
        scan, period_ns = Scan(at_ns, _returns(along)), min(at_ns, 100_000_000)
        pose, twist = Pose2(along, 0.0, 0.0), (1.0, 0.0, 0.0)
        yield Step(index, scan, pose, twist=twist, elapsed_ns=at_ns, period_ns=period_ns)


_RINGS, _SHOTS = 16, 1800  # of a VLP-16
_SENSOR_Z = 1.0  # m; height of the sensor above the ground
_SPACING, _RADIUS, _NOISE = 2.5, 0.15, 0.01  # m; distance of the stems, their radius, noise of a range
_HEDGE = 5.0  # m; distance of the hedge, whose wide cluster is searched for stems


def _returns(along: float) -> Float32:
    """Return a scan between stems and beside a hedge on level ground, shape (N, 3) [m] in the frame of the
    sensor, made without kernels.

    Args:
        along: Position of the sensor along x [m].
    """
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, _SHOTS, endpoint=False),
        np.radians(np.linspace(-15.0, 15.0, _RINGS)),
    )
    level = np.cos(elevation)
    d = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]).reshape(3, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.where(d[2] < 0.0, -_SENSOR_Z / d[2], np.inf)
        hedge = _HEDGE / d[1]
        nearest = np.fmin(nearest, np.where((hedge > 0.0) & (abs(d[0]) < d[1]), hedge, np.inf))
        for x in np.arange(-4.0, 5.0) * _SPACING + 0.5 * _SPACING - along:
            for y in np.array([-1.5, -0.5, 0.5, 1.5]) * _SPACING:
                a, b = d[0] ** 2 + d[1] ** 2, d[0] * x + d[1] * y
                root = np.sqrt(b * b - a * (x * x + y * y - _RADIUS * _RADIUS))
                nearest = np.fmin(nearest, np.where(b > root, (b - root) / a, np.inf))
    nearest += np.random.default_rng(0).normal(0.0, _NOISE, nearest.shape)
    seen = nearest < 30.0
    return np.ascontiguousarray((d[:, seen] * nearest[seen]).T, np.float32)


def map_stems() -> None:
    """Compile the kernels of SLAM, of the Kalman filters of the trees and of the preview, by mapping
    simulated stems; then those that only troubles need, for which the other program does not wait."""
    from pipeline.classification import no_columns
    from pipeline.config import preset
    from pipeline.mapper import Mapper
    from pipeline.remapping.preview import ClusterTable, KnownMap, preview_trees
    from pipeline.tracking import Tracker
    from pipeline.tracking.track_classification import tree_columns
    from pipeline.types.records import Sensor

    # All scans resample, which usual ones do late in a run.
    stems, clusters = preset("stems").replace({"slam.resample_below": 1.0}), ClusterTable()
    mapper, steps = Mapper(stems, sensor=Sensor(), T_base_lidar=Pose3.identity(), seed=0), _stems()
    for step in itertools.islice(steps, 1 + len(_REVISIT)):
        clusters.record(mapper.process(step))
    known = KnownMap(stems, clusters, mapper.path, None)
    preview_trees(known, stems.replace({"tracking.hits_to_confirm": 4}))
    tracker = Tracker(stems.tracking)
    tree_columns(tracker.classify(0, no_columns(), stems.classification))
    tracker.classify_new(no_columns())
    for step in steps:
        mapper.process(step)


_AHEAD, _AWAY = Pose2(0.5), Pose2(50.0)
# Motions of the robot between two scans. It passes trees, is far from them for a scan, and comes back.
_REVISIT = [*[_AHEAD] * 12, _AWAY, _AWAY.inverse(), _AHEAD]
# Motions that the odometry reports as `_AHEAD`: the robot is moved by less than the distance between trees,
# by more, and to another part of the map, where it is lost and then found.
_TROUBLES = [Pose2(0.9), *[_AHEAD] * 8, Pose2(2.0, 0.3, 0.1), *[_AHEAD] * 8]
_TROUBLES += [Pose2(-6.0, 2.0, 2.0), *[_AHEAD] * 8]


def _stems() -> Iterator[Step]:
    """Yield the steps of `_REVISIT`, then those of `_TROUBLES`, 0.1 s apart."""
    from pipeline.types.records import Scan, Stems, Step

    trees = np.random.default_rng(0).uniform([-10.0, -12.0], [30.0, 12.0], (80, 2))
    truth = odometry = Pose2()
    motions = [(each, each) for each in _REVISIT] + [(each, _AHEAD) for each in _TROUBLES]
    for index, (moved, reported) in enumerate([(Pose2(), Pose2()), *motions]):
        truth, odometry = truth @ moved, odometry @ reported
        places = truth.inverse().apply(trees)
        places = places[np.hypot(*places.T) < 9.0]
        points = np.column_stack([places, np.zeros(len(places))]).astype(np.float32)
        upright = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        scan = Scan(100_000_000 * index, points, stems=Stems(upright, np.full(len(points), 0.3)))
        yield Step(index, scan, odometry)


def simulate() -> None:
    """Compile or load the kernels of the simulator, by a second of a simulated stand."""
    from pipeline.io.readers import open_source

    for _ in open_source("sim:stand?duration=1").records():
        pass


if __name__ == "__main__":
    _programs = {"warm_up": warm_up, "compile_scans": compile_scans, "map_stems": map_stems}
    if sys.argv[1:]:
        run_child(lambda _: _programs[sys.argv[1]]())
    warm_up()
    map_stems()
    simulate()
