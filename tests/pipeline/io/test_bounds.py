"""Files whose headers promise too much data are refused in bounded time and memory."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.errors import SourceError
from pipeline.io.readers import open_source
from pipeline.io.readers.base import digest_of


def mcap_bomb() -> bytes:
    """A chunk that says it unpacks to 2^40 bytes."""
    chunk = (
        struct.pack("<QQQI", 0, 1, 1 << 40, 0)
        + struct.pack("<I", 4)
        + b"zstd"
        + struct.pack("<Q", 4)
        + b"1234"
    )
    return b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(chunk)) + chunk


def mcap_of_strange_records() -> bytes:
    """Many records of no known kind."""
    return b"\x89MCAP0\r\n" + struct.pack("<BQ", 0x70, 0) * 3_000_000


def bag_of_zeros() -> bytes:
    """Many records without a header."""
    return b"#ROSBAG V2.0\n" + bytes(30 << 20)


def pcd_of_nothing() -> bytes:
    """A header that promises as much as is allowed, and no data."""
    fields = "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\n"
    return f"# .PCD v0.7\n{fields}WIDTH 16000000\nHEIGHT 1\nPOINTS 16000000\nDATA ascii\n".encode()


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("bomb.mcap", mcap_bomb),
        ("strange.mcap", mcap_of_strange_records),
        ("zeros.bag", bag_of_zeros),
        ("nothing.pcd", pcd_of_nothing),
    ],
)
def test_promises_without_data_are_refused(name: str, make: Callable[[], bytes], tmp_path: Path):
    path = tmp_path / name
    path.write_bytes(make())
    with pytest.raises(SourceError):
        open_source(str(path))


def test_the_digest_tells_files_apart(tmp_path: Path):
    first, second = tmp_path / "a.bin", tmp_path / "b.bin"
    first.write_bytes(b"1234")
    second.write_bytes(b"5678")
    both = digest_of([first, second])
    assert digest_of([first]) == "03ac674216f3e15c761ee1a5e255f067953623c8b388b4459e13f978d7c846f4"
    assert both != digest_of([second, first])
    first.rename(tmp_path / "c.bin")
    assert both != digest_of([tmp_path / "c.bin", second])


def test_a_digest_of_the_ends_says_so(tmp_path: Path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"1234")
    assert digest_of([path], whole_limit=3).startswith("partial:")
    assert not digest_of([path], whole_limit=4).startswith("partial:")
