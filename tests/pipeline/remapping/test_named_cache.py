"""What is kept of a recording is found again, and what is damaged or of another version is not believed."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pipeline.front_end import segment
from pipeline.io.checkpoints import encode
from pipeline.remapping import DamagedError, KeptScans, Name, Rerun, look_key, name_of, named_cache
from tests.pipeline.remapping.mapped import BASE, mapper, run

SCANS = 12
KEY = look_key(BASE)


def filled(name: Name, scans: int = SCANS) -> KeptScans:
    """With the first scans of the run."""
    kept, d = KeptScans(name=name), run()[1]
    for step in run()[0][:scans]:
        kept.put(step, segment(step, d.sensor, d.T_base_lidar, BASE), KEY)
    return kept


@pytest.fixture
def name(tmp_path: Path) -> Name:
    """Of a recording of which twelve scans are kept."""
    known = name_of(tmp_path / "kept", "digest", "wheels")
    filled(known).close()
    return known


def told(kept: KeptScans) -> list[object]:
    """All scans."""
    return [encode(kept.scan(k)) for k in range(len(kept))]


def test_it_is_found_again(name, tmp_path):
    with closing(KeptScans(name=name)) as again, closing(filled(name_of(tmp_path, "a", ""))) as fresh:
        assert (len(again), again.told, again.refusal) == (SCANS, "", "")
        assert all(again.has(k, KEY) for k in range(SCANS))
        assert told(again) == told(fresh)
    with closing(filled(name, SCANS + 3)) as longer:
        assert len(longer) == SCANS + 3
        assert len(longer.clusters) == SCANS + 3
    with closing(filled(name, 5)) as replayed:  # what is put again as it was does not cut what follows
        assert len(replayed) == SCANS + 3
        assert len(replayed.clusters) == 5


def test_other_parameters_cut_what_follows_for_good(name):
    d, wider = run()[1], BASE.replace({"clustering.eps": 0.3})
    with closing(KeptScans(name=name)) as kept:
        step = run()[0][4]
        kept.put(step, segment(step, d.sensor, d.T_base_lidar, wider), look_key(wider))
    with closing(KeptScans(name=name)) as again:
        assert [again.has(k, KEY) for k in range(6)] == [True] * 4 + [False] * 2
        assert len(again) == 5


@pytest.mark.parametrize("seed", range(8))
def test_what_is_cut_or_damaged_is_not_believed_and_that_is_said(seed, name):
    rng, whole = np.random.default_rng(seed), name.path.read_bytes()
    with closing(KeptScans(name=name)) as kept:
        wanted = told(kept)
    at = int(rng.integers(named_cache.BEGIN, len(whole)))
    if seed % 2:
        name.path.write_bytes(whole[:at])
    else:
        name.path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x41]) + whole[at + 1 :])
    with closing(KeptScans(name=name)) as again:
        good = [k for k in range(len(again)) if _reads(again, k)]
        assert [encode(again.scan(k)) for k in good] == [wanted[k] for k in good]
        assert len(good) < SCANS
        assert len(again) == SCANS or f"from scan {len(again)} on" in again.told
        rerun = Rerun(mapper(BASE), again, lambda: iter(run()[0]))
        with closing(rerun):
            trees = [encode(frame.trees) for frame in rerun.frames(SCANS)]
    whole_run = mapper(BASE)
    assert trees == [encode(whole_run.process(step).trees) for step in run()[0][:SCANS]]


def _reads(kept: KeptScans, index: int) -> bool:
    try:
        kept.scan(index)
    except DamagedError:
        return False
    return True


@pytest.mark.parametrize("begin", [b"", b"stemmap", b"\0" * 48, b"x" * 5000])
def test_a_file_of_something_else_or_another_version_is_begun_anew(begin, name, monkeypatch):
    name.path.write_bytes(begin)
    with closing(KeptScans(name=name)) as kept:
        assert len(kept) == 0
        assert kept.told == (named_cache.OTHER if begin else "")
    filled(name).close()
    monkeypatch.setattr(named_cache, "_code", lambda: b"newer")
    newer = name_of(name.path.parent, "digest", "wheels")
    assert newer.path == name.path
    with closing(KeptScans(name=newer)) as kept:
        assert (len(kept), kept.told) == (0, named_cache.OTHER)


def test_two_who_have_it_open_do_not_disturb_one_another(name):
    with closing(KeptScans(name=name)) as first, closing(filled(name, 3)) as second:
        assert (len(first), len(second)) == (SCANS, 3)
    with closing(KeptScans(name=name)) as again:
        assert len(again) == SCANS


def test_a_full_disk_ends_the_keeping_and_what_was_kept_stays(name):
    steps, d = run()[0], run()[1]
    with closing(KeptScans(name=name)) as kept:
        real = os.dup(kept._file.fileno())
        with open("/dev/full", "rb+", buffering=0) as full:  # noqa: PTH123
            os.dup2(full.fileno(), kept._file.fileno())
        step = steps[SCANS]
        kept.put(step, segment(step, d.sensor, d.T_base_lidar, BASE), KEY)
        os.dup2(real, kept._file.fileno())
        os.close(real)
        assert "No space left" in kept.refusal
        assert len(kept) == SCANS
        kept.scan(SCANS - 1)


def test_a_folder_that_nobody_may_write_to_keeps_without_a_name(tmp_path):
    (tmp_path / "kept").write_text("a file")
    with closing(filled(name_of(tmp_path / "kept", "digest", ""))) as kept:
        assert (len(kept), kept.refusal) == (SCANS, "")


def test_the_recordings_of_long_ago_go_when_the_folder_is_full(name, monkeypatch):
    older = [name_of(name.folder, f"other {k}", "") for k in range(3)]
    for age, other in enumerate(older):
        filled(other, 4).close()
        os.utime(other.path, (1000 + age, 1000 + age))
    held = KeptScans(name=older[0])
    os.utime(older[0].path, (1000, 1000))
    monkeypatch.setattr(
        named_cache, "MOST_IN_FOLDER", name.path.stat().st_size + older[2].path.stat().st_size + 1
    )
    with closing(held), closing(KeptScans(name=name)) as kept:
        assert len(kept) == SCANS
        assert [other.path.exists() for other in older] == [True, False, False]
