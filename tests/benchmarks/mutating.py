"""Damaged copies of files, and readers that must handle them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import app.sources  # noqa: F401 - adds the formats of the extensions
from app.extensions.clouds.point_cloud import open_cloud
from pipeline.errors import SourceError
from pipeline.io.readers import open_source
from pipeline.types.records import Scan

PAGE = 1024  # bytes of a page of an E57 file; the last four are its CRC-32C
_POLYNOMIAL = 0x82F63B78  # CRC-32C (Castagnoli), reflected


def mutation(original: bytes, seed: int, number: int) -> bytes:
    """Return a changed copy of a file with changes of bits, zeros, cuts, insertions and numbers, which are
    the same for equal seeds."""
    rng = np.random.default_rng([seed, number])
    content = bytearray(original)
    # Headers and indexes are at the ends, where a change has most effect.
    reach = (len(content), 512, 4096)[number % 3]
    for _ in range(int(rng.integers(1, 6))):
        at = int(rng.integers(0, min(reach, len(content)) or 1))
        at = max(len(content) - 1 - at, 0) if number % 2 else at
        run = int(rng.integers(1, 16))
        match int(rng.integers(0, 6)):
            case 0:
                content[at : at + 1] = bytes([int(rng.integers(0, 256))])
            case 1:
                content[at : at + run] = bytes(run)
            case 2:
                content[at : at + run] = b"\xff" * run
            case 3:
                content[at:at] = rng.bytes(run)
            case 4:
                del content[at : at + run]
            case _:
                content[at : at + 4] = int(rng.integers(0, 2**32)).to_bytes(4, "little")
    if number % 5 == 4:
        del content[int(rng.integers(0, len(content) + 1)) :]
    return bytes(content)


def with_sums(damaged: bytes) -> bytes:
    """Return an E57 file with the correct checksum at the end of each page, and with the length in its
    header."""
    pages = np.frombuffer(damaged + bytes(-len(damaged) % PAGE), np.uint8).reshape(-1, PAGE).copy()
    if len(pages):
        pages[0, 16:24] = np.frombuffer(pages.size.to_bytes(8, "little"), np.uint8)
        pages[:, -4:] = checksums(pages[:, :-4]).astype(">u4")[:, None].view(np.uint8)
    return pages.tobytes()


def checksums(rows: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """CRC-32C of each row, shape (N, length >= 4): it is linear, so each byte adds a term of its position."""
    begun = rows.copy()
    begun[:, :4] ^= 0xFF  # the same as an initial value of ones
    terms = _crc_terms(rows.shape[1])[np.arange(rows.shape[1]), begun]
    total: NDArray[np.uint32] = np.bitwise_xor.reduce(terms, axis=1)
    return ~total


@cache
def _crc_terms(length: int) -> NDArray[np.uint32]:
    """Term of each of 256 bytes at each position, shape (length, 256)."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(_POLYNOMIAL), table >> 1).astype(np.uint32)
    terms = [table]
    for _ in range(length - 1):
        terms.append(table[terms[-1] & 0xFF] ^ (terms[-1] >> np.uint32(8)))
    return np.stack(terms[::-1])


def read_all(path: Path) -> str:
    """Read a run to its end: "" or the text of its SourceError."""
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


def read_cloud(path: Path) -> str:
    """Read a whole cloud to its end: "" or the text of its SourceError."""
    try:
        cloud = open_cloud(str(path))
        for part in cloud.parts():
            assert np.isfinite(part).all()
    except SourceError as error:
        return str(error)
    assert all(count > 0 for count in cloud.losses.values())
    return ""
