"""Damaged files of every kind: one clear SourceError or counted losses, never anything else."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import SourceError
from pipeline.records import Scan
from pipeline.sources import open_source

MUTATIONS = 150


def mutations(original: bytes, seed: int) -> Iterator[bytes]:
    """Changed copies of a file: bits, zeros, ones, cuts, insertions and exchanged blocks."""
    rng = np.random.default_rng(seed)
    for number in range(MUTATIONS):
        content = bytearray(original)
        # Headers and indexes stand at the ends, where a change does most.
        reach = (len(content), 512, 4096)[number % 3]
        for _ in range(int(rng.integers(1, 6))):
            at = int(rng.integers(0, min(reach, len(content)) or 1))
            at = max(len(content) - 1 - at, 0) if number % 2 else at
            run = int(rng.integers(1, 16))
            kind = int(rng.integers(0, 6))
            if kind == 0:
                content[at : at + 1] = bytes([int(rng.integers(0, 256))])
            elif kind == 1:
                content[at : at + run] = bytes(run)
            elif kind == 2:
                content[at : at + run] = b"\xff" * run
            elif kind == 3:
                content[at:at] = rng.bytes(run)
            elif kind == 4:
                del content[at : at + run]
            else:
                content[at : at + 4] = int(rng.integers(0, 2**32)).to_bytes(4, "little")
        if number % 5 == 4:
            del content[int(rng.integers(0, len(content) + 1)) :]
        yield bytes(content)


def read_all(path: Path) -> str:
    """Read a source to its end: "" or the text of its SourceError."""
    try:
        source = open_source(str(path))
    except SourceError as error:
        return str(error)
    try:
        last = -(2**63)
        for record in source.records():
            assert record.stamp_ns >= last
            last = record.stamp_ns
            if isinstance(record, Scan):
                assert np.isfinite(record.points).all()
        source.truth()
        assert all(count > 0 for count in source.losses.values())
    except SourceError as error:
        return str(error)
    finally:
        source.close()
    return ""


def small_victoria_park(shared_data: Path, folder: Path) -> Path:
    """The first scans of Victoria Park, so that 150 readings stay quick."""
    small = folder / "victoria_park.zip"
    with (
        zipfile.ZipFile(shared_data / "victoria_park" / "victoria_park_ascii.zip") as whole,
        zipfile.ZipFile(small, "w", zipfile.ZIP_DEFLATED) as part,
    ):
        for name in ("LASER.txt", "DRS.txt", "GPS.txt"):
            part.writestr(name, whole.read(name)[:60_000])
    return small


def real_file(kind: str, shared_data: Path, folder: Path) -> Path:
    """A real file of a kind, short enough to be read many times."""
    velodyne = shared_data / "velodyne"
    match kind:
        case "mcap":
            return velodyne / "vlp16_ros2_mcap" / "vlp16_ros2_mcap.mcap"
        case "db3":
            return velodyne / "vlp16_rosbag2" / "1673400471837873222_0.db3"
        case "bag":
            return velodyne / "vlp16_ros1.bag"
        case "pcap":
            return velodyne / "vlp16.pcap"
        case "bin":
            part = folder / "000000.bin"
            part.write_bytes((shared_data / "kitti" / "000000.bin").read_bytes()[: 16 * 20_000])
            return part
        case "pcd binary":
            return velodyne / "vlp16_reference.pcd"
        case "pcd ascii":
            short = folder / "short.pcd"
            whole = (shared_data / "sloam_forest" / "moving_ground_t0.pcd").read_bytes()
            short.write_bytes(whole.replace(b"74521", b"2000")[:80_000].rpartition(b"\n")[0] + b"\n")
            return short
        case _:
            return small_victoria_park(shared_data, folder)


@pytest.mark.parametrize("kind", ["mcap", "db3", "bag", "pcap", "bin", "pcd binary", "pcd ascii", "zip"])
def test_damaged_files_end_with_a_clear_error_or_with_losses(kind: str, shared_data: Path, tmp_path: Path):
    original = real_file(kind, shared_data, tmp_path)
    assert read_all(original) == ""
    content = original.read_bytes()
    damaged = tmp_path / f"damaged{original.suffix}"
    refused = 0
    for mutation in mutations(content, seed=len(kind)):
        damaged.write_bytes(mutation)
        refused += read_all(damaged) != ""
    # A zip has a checksum over all, four numbers of a .bin file have none at all.
    assert kind == "bin" or (refused > 0 and (kind == "zip" or refused < MUTATIONS))


def test_damaged_texts_in_a_sound_zip_end_with_a_clear_error_or_with_losses(
    shared_data: Path, tmp_path: Path
):
    with zipfile.ZipFile(small_victoria_park(shared_data, tmp_path)) as whole:
        texts = {name: whole.read(name)[:20_000] for name in whole.namelist()}
    damaged = tmp_path / "damaged.zip"
    refused = 0
    for number, mutation in enumerate(mutations(texts["LASER.txt"], seed=1)):
        name = ("LASER.txt", "DRS.txt", "GPS.txt")[number % 3]
        with zipfile.ZipFile(damaged, "w") as archive:
            for member, text in texts.items():
                archive.writestr(member, mutation if member == name else text)
        refused += read_all(damaged) != ""
    assert refused < MUTATIONS


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag", ".pcap", ".zip", ".pcd"])
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


def test_contents_decide_before_the_name(shared_data: Path, tmp_path: Path):
    mislabelled = tmp_path / "capture.bag"
    shutil.copyfile(shared_data / "velodyne" / "vlp16.pcap", mislabelled)
    source = open_source(str(mislabelled))
    assert source.description.kind == "Velodyne capture (pcap)"
    source.close()
