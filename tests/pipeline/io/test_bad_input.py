"""Damaged files of every kind: one clear SourceError or counted losses, never anything else."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.mutating import mutation, read_all
from tests.benchmarks.real_files import KINDS, real_file

MUTATIONS = 60


def mutations(original: bytes, seed: int) -> Iterator[bytes]:
    """Changed copies of a file."""
    return (mutation(original, seed, number) for number in range(MUTATIONS))


@pytest.mark.slow_after(4)
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_end_with_a_clear_error_or_with_losses(kind: str, shared_data: Path, tmp_path: Path):
    name, read = KINDS[kind]
    original = real_file(kind, shared_data, tmp_path)
    damaged = tmp_path / name
    damaged.write_bytes(original)
    assert read(damaged) == ""
    refused = 0
    for content in mutations(original, seed=len(kind)):
        damaged.write_bytes(content)
        refused += read(damaged) != ""
    # A zip has a checksum over all, four numbers of a .bin file and rows beside scans have none at all.
    assert kind in ("KITTI bin", "poses TUM") or refused > 0


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag", ".pcd"])
def test_foreign_contents_under_a_known_name_are_refused(suffix: str, tmp_path: Path):
    path = tmp_path / f"foreign{suffix}"
    path.write_bytes(b"<html><body>404 not found</body></html>" * 50)
    assert "not those of a" in read_all(path)
    path.write_bytes(b"")
    assert "empty" in read_all(path)


def test_text_and_zeros_are_no_kitti_scans(tmp_path: Path):
    path = tmp_path / "000000.bin"
    path.write_bytes(b"<html><body>404 not found</body></html>" * 50)
    assert "no positions" in read_all(path)
    path.write_bytes(bytes(1600))
    assert "no points" in read_all(path)
    path.write_bytes(np.full(400, np.nan, "<f4").tobytes())
    assert "no positions" in read_all(path)
