"""Unpacking compressed blocks without believing what they say about their size."""

from __future__ import annotations

import bz2
import io

import lz4.frame
import zstandard

#: Largest block that is unpacked. Recorders write blocks of 1 to 4 MB; a file of 16 kB can claim 512 MB.
BLOCK_LIMIT = 256 << 20
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class UnpackError(Exception):
    """A block that is damaged, too large, or packed in a way that is not known."""


def unpack(block: bytes, compression: str, size: int) -> bytes:
    """Unpack a block that must have exactly `size` bytes afterwards.

    Args:
        block: The packed bytes.
        compression: "", "none", "lz4", "zstd" or "bz2".
        size: The size that the file promises.

    Raises:
        UnpackError: The promise is broken, larger than BLOCK_LIMIT, or the method is unknown.
    """
    if size > BLOCK_LIMIT:
        raise UnpackError("a block is too large")
    raw = unpack_up_to(block, compression, size)
    if len(raw) != size:
        raise UnpackError("a block has another size than it says")
    return raw


def unpack_up_to(block: bytes, compression: str, limit: int) -> bytes:
    """Unpack a block, but no more than one byte over `limit`.

    Raises:
        UnpackError: The block is damaged or the method is unknown.
    """
    try:
        match compression:
            case "" | "none":
                return block
            case "lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(block, max_length=limit + 1))
            case "bz2":
                return bz2.BZ2Decompressor().decompress(block, max_length=limit + 1)
            case "zstd":
                window = zstandard.ZstdDecompressor(max_window_size=1 << 27)
                return window.stream_reader(io.BytesIO(block)).read(limit + 1)
            case _:
                raise UnpackError(f"unknown compression {compression[:20]!r}")
    except (RuntimeError, OSError, EOFError, ValueError, MemoryError, zstandard.ZstdError) as error:
        raise UnpackError(str(error)) from error


def plain_message(payload: bytes) -> bytes:
    """A message as it was sent: recorders can compress each by itself. Empty when it is damaged."""
    if payload[:4] != ZSTD_MAGIC:
        return payload
    try:
        return unpack_up_to(payload, "zstd", BLOCK_LIMIT)[:BLOCK_LIMIT]
    except UnpackError:
        return b""
