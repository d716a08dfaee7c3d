"""Binary messages between the web process and the worker: four bytes with the length, then msgpack.

An array is encoded as dtype, shape and bytes. Both sides declare the types that they expect: a message of
another type, an array of another dtype, or an array whose size contradicts its bytes is refused. Unlike
pickle, a message cannot execute or import code.
"""

from __future__ import annotations

import math
from typing import Any, BinaryIO, Generic, TypeVar, get_args

import msgspec
import numpy as np

from app.worker.protocol import FromWorker, ToWorker

M = TypeVar("M")

LENGTH_BYTES = 4
# A scan of 4 million points with all its layers, more than any sensor produces.
LARGEST_MESSAGE = 128 * 1024 * 1024
_DTYPES = frozenset({"<f4", "<f8", "<i4", "<i8", "|b1"})
_MOST_DIMENSIONS = 3


class WireError(Exception):
    """A message is too large, incomplete, or of an unexpected type."""


class _EncodedArray(msgspec.Struct, frozen=True, array_like=True):
    """An array as it is sent: dtype as in `numpy.dtype.str`, shape, and bytes in C order."""

    dtype: str
    shape: tuple[int, ...]
    content: bytes


class MessageCodec(Generic[M]):
    """Encodes and decodes the messages of one direction.

    Args:
        message_type: A union of msgspec Structs with tags; fields may be dataclasses with arrays.
    """

    def __init__(self, message_type: Any) -> None:  # noqa: ANN401 - a union is no `type`
        self._encoder = msgspec.msgpack.Encoder(enc_hook=_to_plain)
        self._decoder: msgspec.msgpack.Decoder[M] = msgspec.msgpack.Decoder(
            message_type, dec_hook=_from_plain
        )

    def encode(self, message: M) -> bytes:
        """Return the encoded message with its length as prefix.

        Raises:
            WireError: It is larger than LARGEST_MESSAGE.
        """
        packed = bytearray(LENGTH_BYTES)
        self._encoder.encode_into(message, packed, LENGTH_BYTES)
        size = len(packed) - LENGTH_BYTES
        check_size(size)
        packed[:LENGTH_BYTES] = size.to_bytes(LENGTH_BYTES, "little")
        return bytes(packed)

    def decode(self, body: bytes) -> M:
        """Return the message decoded from its bytes without the length prefix.

        Raises:
            WireError: The bytes are not a message of the declared types.
        """
        try:
            return self._decoder.decode(body)
        except (msgspec.MsgspecError, ValueError, OverflowError) as error:
            raise WireError(f"a message of {len(body)} bytes cannot be read: {error}") from None

    def read(self, stream: BinaryIO) -> M | None:
        """Return the next message of a blocking stream; None at its end.

        Raises:
            WireError: The stream ends within a message, or the message is not of the declared types.
        """
        head = _read_exactly(stream, LENGTH_BYTES)
        if not head:
            return None
        size = int.from_bytes(head, "little")
        check_size(size)
        body = _read_exactly(stream, size)
        if len(head) < LENGTH_BYTES or len(body) < size:
            raise WireError("the stream ends within a message")
        return self.decode(body)


def check_size(size: int) -> None:
    """Check the length of a message [bytes] before memory is allocated for it.

    Raises:
        WireError: It is larger than LARGEST_MESSAGE.
    """
    if size > LARGEST_MESSAGE:
        raise WireError(f"a message of {size} bytes is larger than {LARGEST_MESSAGE}")


def to_worker() -> MessageCodec[ToWorker]:
    """Return the codec of the messages from the web process to the worker."""
    return MessageCodec(ToWorker)


def from_worker() -> MessageCodec[FromWorker]:
    """Return the codec of the messages from the worker to the web process."""
    return MessageCodec(FromWorker)


def _read_exactly(stream: BinaryIO, size: int) -> bytes:
    """Read `size` bytes; fewer where the stream ends before."""
    parts: list[bytes] = []
    while size > 0 and (part := stream.read(size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _to_plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        if value.dtype.str not in _DTYPES or value.ndim > _MOST_DIMENSIONS:
            raise WireError(f"an array of {value.dtype} and {value.ndim} dimensions cannot be sent")
        content = np.ascontiguousarray(value)
        return (value.dtype.str, value.shape, content.data.cast("B") if content.size else b"")
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"{type(value).__name__} cannot be sent")


def _from_plain(expected: Any, plain: object) -> object:  # noqa: ANN401 - the hook's own signature
    if getattr(expected, "__origin__", None) is not np.ndarray:
        raise NotImplementedError(f"{expected} cannot be received")
    array = msgspec.convert(plain, _EncodedArray)
    want = np.dtype(get_args(get_args(expected)[1])[0])
    if array.dtype not in _DTYPES or np.dtype(array.dtype) != want:
        raise ValueError(f"an array of {array.dtype} where {want.str} was agreed")
    # Python integers: a product of hostile sizes cannot overflow.
    if len(array.shape) > _MOST_DIMENSIONS or min(array.shape, default=0) < 0:
        raise ValueError(f"an array of the shape {array.shape[:4]}")
    if math.prod(array.shape) * want.itemsize != len(array.content):
        raise ValueError(f"{len(array.content)} bytes are no array of {array.dtype} {array.shape}")
    # A copy, which is aligned and does not reference the whole message.
    return np.frombuffer(array.content, dtype=want).reshape(array.shape).copy()
