"""Scan cache: stored scans are read back, and damaged scans are never returned."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import zstandard

from pipeline.front_end import SegmentedScan
from pipeline.geometry.poses import Pose2
from pipeline.io.checkpoints import encode
from pipeline.remapping.rerun import HIGHEST, Rerun, ScanCache, ScanCaches, unpack
from pipeline.types.records import PoseMeasurement, Scan, Step, Turn
from tests.pipeline.remapping.mapped import BASE, fill, frames, mapper, run

SCANS = 12
WIDER = BASE.replace({"clustering.eps": 0.3})


@pytest.fixture
def cache() -> Iterator[ScanCache]:
    """An empty cache without a name."""
    with closing(ScanCaches()) as caches:
        yield caches.of(BASE)


def stored(cache: ScanCache, index: int) -> tuple[Step, SegmentedScan]:
    """A scan that must be in the cache."""
    found = cache.read(index)
    assert found is not None
    return found


def test_a_scan_comes_back_whole(cache):
    parts = run()[0]
    step = replace(
        parts[5],
        warnings=("the odometry jumped", "é"),
        doubt="no odometry",
        slack=(0.25, 0.5),
        turn=Turn(0.1, 0.01),
        measured=PoseMeasurement(
            7, Pose2(1.0, 2.0, 0.1), np.eye(3) * 0.3, 25.0, np.arange(12.0).reshape(3, 4) / 99.0, 1
        ),
    )
    for k in range(12):  # with and without input of the columns, with and without ground
        scan = mapper(BASE).segment(replace(step, index=k))
        if k == 3:
            scan = replace(scan, heights=None, column_input=None)
        cache.put(replace(step, index=k, T_odom_base=None if k == 4 else step.T_odom_base), scan)
        again, found = stored(cache, k)
        nothing, given = scan.raw[:0], scan.column_input
        wanted = replace(scan, clearance=None, raw=nothing, filtered=nothing, labels=scan.labels[:0])
        if given is not None:
            low = (given.height > 0.0) & (given.height < HIGHEST)
            flat = np.where([True, True, False], given.points, np.float32(0.0))
            low_input = replace(given, points=flat[low], height=given.height[low])
            wanted = replace(wanted, column_input=low_input)
        assert encode(found) == encode(wanted)
        wanted_step = replace(
            step, index=k, scan=Scan(step.scan.stamp_ns, nothing), T_odom_base=again.T_odom_base,
        )  # fmt: skip
        assert encode(again) == encode(wanted_step)
        assert (again.T_odom_base is None) == (k == 4)
    assert cache.read(3, step.scan.stamp_ns) is not None
    assert cache.read(3, step.scan.stamp_ns + 1) is None
    assert cache.read(99) is None


def test_an_empty_scan_is_stored_too(cache):
    first = run()[0][0]
    step = replace(first, scan=Scan(first.scan.stamp_ns, first.scan.points[:0]))
    scan = mapper(BASE).segment(step)
    cache.put(step, scan)
    again = stored(cache, 0)[1]
    assert len(scan.clusters.size) == 0
    assert encode(again.clusters) == encode(scan.clusters)


def test_each_set_of_segmentation_parameters_has_its_cache_and_the_last_few_are_open():
    with closing(ScanCaches()) as caches:
        first = caches.of(BASE)
        assert caches.of(BASE.replace({"tracking.proximity_radius": 0.3})) is first
        assert caches.of(WIDER) is not first
        fill(first, BASE, run()[0][5:7])
        assert [first.has_all(1), len(first)] == [False, 2]
        for k in range(3):
            caches.of(BASE.replace({"clustering.eps": 0.4 + 0.1 * k}))
        assert first.read(5) is None


def test_damaged_scans_are_processed_again_and_a_notice_says_so(cache):
    fill(cache, BASE, run()[0][:SCANS])
    at, length = cache._places[5]
    cache._file.handle.seek(at + length // 2)
    cache._file.handle.write(b"damage")
    read: list[int] = []

    def reread(index: int) -> Iterator[Step]:
        read.append(index)
        return iter(run()[0][index:])

    rerun = Rerun(mapper(BASE), cache, reread)
    trees = [encode(frame.trees) for frame in frames(rerun, SCANS)]
    rerun.close()
    assert "damaged" in cache.notice
    assert read == [5]
    first = mapper(BASE)
    assert trees == [encode(first.process(step).trees) for step in run()[0][:SCANS]]


def test_a_cache_that_is_too_large_refuses_scans_and_keeps_the_others():
    with closing(ScanCaches(most=400_000)) as caches:
        cache = fill(caches.of(BASE), BASE, run()[0])
        found = [cache.read(k) for k in range(len(run()[0]))]
        assert 0 < len(cache) == len(found) - found.count(None) < len(found)
        assert all(each is None or each[0].index == k for k, each in enumerate(found))
        assert cache.nbytes <= 400_000
        # Scans after the first that is refused may be smaller and fit; the message does not deny it.
        assert cache.refused == found.index(None)
        assert "the limit of" in cache.refusal


def test_a_full_disk_refuses_scans_and_keeps_the_others():
    with closing(ScanCaches()) as caches:
        cache = fill(caches.of(BASE), BASE, run()[0][:SCANS])
        assert cache._file is not None
        real = os.dup(cache._file.handle.fileno())
        with open("/dev/full", "rb+", buffering=0) as full:  # noqa: PTH123
            os.dup2(full.fileno(), cache._file.handle.fileno())
        fill(cache, BASE, run()[0][SCANS : SCANS + 1])
        os.dup2(real, cache._file.handle.fileno())
        os.close(real)
        assert "No space left" in cache.refusal
        assert len(cache) == SCANS
        stored(cache, SCANS - 1)


def test_a_scan_that_is_too_large_is_not_stored(cache, monkeypatch):
    fill(cache, BASE, run()[0][:2])
    monkeypatch.setattr("pipeline.io.block_file.LARGEST", 1 << 10)
    fill(cache, BASE, run()[0][2:4])
    assert len(cache) == 2
    assert "takes more than" in cache.refusal


def test_without_a_folder_to_write_to_nothing_is_stored_and_that_is_said(monkeypatch):
    def refused(**_: object) -> None:
        raise PermissionError

    monkeypatch.setattr("pipeline.geometry.file_arrays.TemporaryFile", refused)
    with closing(ScanCaches()) as caches:
        assert len(fill(caches.of(BASE), BASE, run()[0][:2])) == 0
        assert "no folder can be written to" in caches.of(BASE).refusal


@pytest.mark.parametrize("block", [b"", b"\xff", b"\xff" * 9, b"\x02\x00\x00\x00{]"])
def test_a_block_that_is_damaged_is_a_value_error(block):
    with pytest.raises(ValueError, match=r"cut|JSON|character"):
        unpack(block)


@pytest.mark.parametrize("block", [b"", b"no Zstandard at all", zstandard.compress(b"\xff")])
def test_a_block_that_is_no_scan_is_not_returned(block: bytes, cache, monkeypatch):
    class Compressor:
        def __init__(self, _level: int, *, write_checksum: bool) -> None:
            pass

        def compress(self, _content: bytes) -> bytes:
            return block

    monkeypatch.setattr("pipeline.io.block_file.zstandard.ZstdCompressor", Compressor)
    fill(cache, BASE, run()[0][:1])
    assert cache.read(0) is None
    assert "damaged" in cache.notice
