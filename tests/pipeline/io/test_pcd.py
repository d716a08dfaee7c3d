"""PCD: text, binary and compressed data give the same points, and sizes in headers are not trusted."""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.errors import SourceError
from pipeline.io.readers.point_files import ScanFileError, lzf_decompress, open_table, read_columns
from pipeline.types.records import Scan
from tests.pipeline.io.conftest import Opened

COORDINATES = st.lists(
    st.tuples(*[st.floats(-1e4, 1e4, width=32) | st.just(float("nan"))] * 3, st.integers(0, 65535)),
    min_size=1,
    max_size=60,
)


def lzf_compress(content: bytes) -> bytes:
    """A plain LZF packer: runs of what was there three bytes or more before, and literal bytes."""
    packed, literal, at = bytearray(), bytearray(), 0
    seen: dict[bytes, int] = {}

    def flush() -> None:
        for start in range(0, len(literal), 32):
            part = literal[start : start + 32]
            packed.append(len(part) - 1)
            packed.extend(part)
        literal.clear()

    while at < len(content):
        key = content[at : at + 3]
        before = seen.get(key, -1)
        seen[key] = at
        if len(key) == 3 and before >= 0 and at - before <= 8192:
            run = 3
            while run < 264 and at + run < len(content) and content[before + run] == content[at + run]:
                run += 1
            flush()
            back = at - before - 1
            if run - 2 < 7:
                packed += bytes([(run - 2) << 5 | back >> 8, back & 255])
            else:
                packed += bytes([7 << 5 | back >> 8, run - 9, back & 255])
            at += run
        else:
            literal.append(content[at])
            at += 1
    flush()
    return bytes(packed)


def pcd(rows: list[tuple[float, float, float, int]], data: str, **changes: str) -> bytes:
    """A PCD file with x, y, z, a field of two values, and ring."""
    fields = {
        "VERSION": "0.7",
        "FIELDS": "x y z normal ring",
        "SIZE": "4 4 4 4 2",
        "TYPE": "F F F F U",
        "COUNT": "1 1 1 2 1",
        "WIDTH": str(len(rows)),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(len(rows)),
        "DATA": data,
    }
    head = "# .PCD v0.7\n" + "".join(f"{k} {v}\n" for k, v in {**fields, **changes}.items())
    table = np.zeros(
        len(rows), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("normal", "<f4", 2), ("ring", "<u2")]
    )
    for row, (x, y, z, ring) in enumerate(rows):
        table[row] = (x, y, z, (0.5, 0.25), ring)
    if data == "ascii":
        lines = [f"{x:.9g} {y:.9g} {z:.9g} 0.5 0.25 {ring}\n" for x, y, z, ring in rows]
        return (head + "".join(lines)).encode()
    if data == "binary":
        return head.encode() + table.tobytes()
    raw = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in table.dtype.names or ())
    packed = lzf_compress(raw)
    return head.encode() + struct.pack("<II", len(packed), len(raw)) + packed


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(COORDINATES)
def test_ascii_binary_and_compressed_hold_the_same(
    tmp_path: Path, rows: list[tuple[float, float, float, int]]
):
    path = tmp_path / "cloud.pcd"
    found = []
    for data in ("ascii", "binary", "binary_compressed"):
        path.write_bytes(pcd(rows, data))
        losses: dict[str, int] = {}
        found.append(read_columns(open_table(path), losses))
        assert losses == {}
    for name, column in zip(("x", "y", "z", "ring"), np.array(rows, float).T, strict=True):
        for columns in found:
            np.testing.assert_array_equal(columns[name].astype(np.float32), column.astype(np.float32))


@given(
    st.binary(max_size=600)
    | st.builds(lambda b, n: b * n, st.binary(min_size=1, max_size=9), st.integers(1, 400))
)
def test_lzf_gives_back_what_was_packed(content: bytes):
    assert lzf_decompress(lzf_compress(content), len(content)).tobytes() == content


@given(st.binary(max_size=200), st.integers(0, 2**32 - 1))
def test_lzf_refuses_damage_without_harm(block: bytes, size: int):
    with suppress(ScanFileError):
        assert len(lzf_decompress(block, size)) == size


ROWS = [(1.0, 2.0, 3.0, 4), (5.0, 6.0, 7.0, 8), (float("nan"), 0.0, 1.0, 2)]


@pytest.mark.parametrize(
    "changes",
    [
        {"POINTS": "4"},
        {"WIDTH": "99999999999999", "POINTS": "99999999999999"},
        {"WIDTH": "-3"},
        {"SIZE": "4 4 4 4"},
        {"SIZE": "4 4 4 4 3"},
        {"TYPE": "F F F F X"},
        {"COUNT": "1 1 1 999999999 1"},
        {"COUNT": "1 2 1 1 1"},
        {"FIELDS": "a b c d e"},
        {"FIELDS": ""},
        {"DATA": "binary_zipped"},
        {"DATA": ""},
    ],
)
@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_headers_that_contradict_themselves_are_refused(data: str, changes: dict[str, str], tmp_path: Path):
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd(ROWS, data, **changes))
    with pytest.raises(ScanFileError):
        read_columns(open_table(path), {})


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_a_cut_file_gives_the_whole_points(data: str, tmp_path: Path, opened: Opened):
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd(ROWS, data)[:-30])
    source = opened(path)
    (scan,) = source.records()
    assert isinstance(scan, Scan)
    np.testing.assert_array_equal(scan.points, [[1.0, 2.0, 3.0]])
    assert source.losses == {"points that the files promise but do not hold": 2}


def test_a_table_names_its_other_columns(tmp_path: Path):
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd(ROWS, "binary"))
    assert set(open_table(path).names) == {*"xyz", "ring"}


def test_a_cut_compressed_file_is_refused(tmp_path: Path, opened: Opened):
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd(ROWS, "binary_compressed")[:-3])
    with pytest.raises(SourceError, match="packed data"):
        opened(path)


def test_real_organised_clouds_have_their_empty_beams_counted(shared_data: Path, opened: Opened):
    source = opened(shared_data / "sloam_forest")
    scans = [record for record in source.records() if isinstance(record, Scan)]
    assert [len(scan.points) + scan.dropped for scan in scans] == [74521, 131072, 54393, 131072]
    assert scans[1].dropped > 100_000
    assert not source.description.has_odometry
    assert "poses.txt is not used" in source.description.warnings[0]
    assert source.losses == {}
