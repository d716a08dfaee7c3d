"""Records as JSON and one block of arrays; decoding follows the types that the records declare.

The file does not choose what is built: the reader names the type of the record, and its fields decide.
"""

from __future__ import annotations

import io
import json
import math
import types
import typing
import zipfile
import zlib
from collections import Counter
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin

import msgspec
import numpy as np

from pipeline.errors import StemmapError
from pipeline.types.records import NOT_SAVED

R = TypeVar("R")
_ALIGN = 8
_LENGTH = 4  # bytes of the length of the text of a record
_hints = cache(typing.get_type_hints)


@cache
def _saved(kind: type) -> tuple[str, ...]:
    """Return the names of the fields of a record type that are saved."""
    return tuple(f.name for f in fields(kind) if not f.metadata.get(NOT_SAVED))


@cache
def _origin_and_args(kind: Any) -> tuple[Any, tuple[Any, ...]]:  # noqa: ANN401
    return get_origin(kind), get_args(kind)


class _Blob:
    """Bytes of arrays one after the other, each at an offset of a multiple of 8 bytes; see `encode` for
    `planes`."""

    def __init__(self, planes: bool) -> None:
        """Begin an empty block; with `planes` the first bytes of all numbers of an array come first, then the
        second ones, and so on."""
        self.parts: list[bytes] = []
        self.length = 0
        self._planes = planes

    def add(self, array: np.ndarray[Any, Any]) -> dict[str, Any]:
        """Append the bytes of an array in little-endian order, padded to a multiple of 8 bytes. Return its
        description, a dict of JSON values: "dtype", the NumPy type with "<"; "shape", a list; and "at", the
        offset of the first byte in the block."""
        data = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        at = self.length
        raw = (
            data.reshape(-1).view(np.uint8).reshape(-1, data.itemsize).T.tobytes()
            if self._planes
            else data.tobytes()
        )
        self.parts.append(raw + b"\0" * (-len(raw) % _ALIGN))
        self.length += len(self.parts[-1])
        return {"dtype": data.dtype.str, "shape": list(array.shape), "at": at}


def encode(record: Any, *, planes: bool = False) -> tuple[Any, bytes]:  # noqa: ANN401 - any record
    """Return a record as JSON values (not text) and the bytes of its arrays. A dataclass becomes a dict of
    its fields, without those with NOT_SAVED; a tuple becomes a list; an array becomes its description
    (`_Blob.add`); a float that is not finite becomes a string.

    Args:
        record: A dataclass, or other value of arrays, numbers, strings, None, tuples, lists, dicts and
            dataclasses; keys of dicts become strings.
        planes: Whether the first bytes of all numbers of an array come first, then the second ones, and so
            on, which compresses better.

    Raises:
        TypeError: A value has another type.
    """
    blob = _Blob(planes)
    tree = _encoded(record, blob)
    return tree, b"".join(blob.parts)


def record_bytes(record: Any) -> bytes:  # noqa: ANN401 - any record
    """Return a record as bytes that compress well: the length of the JSON text (4 bytes, little-endian), the
    text, and the arrays in planes. Values are encoded as by `encode`.

    Raises:
        TypeError: A value has a type that `encode` does not know.
    """
    tree, arrays = encode(record, planes=True)
    text = msgspec.json.encode(tree)
    return len(text).to_bytes(_LENGTH, "little") + text + arrays


def record_of(kind: type[R], data: bytes) -> R:
    """Return the record of type `kind` from the result of `record_bytes`.

    Raises:
        ValueError: The bytes are damaged. Damaged bytes can also raise KeyError, TypeError or RuntimeError.
    """
    return decode(kind, *record_parts(data), planes=True)


def record_parts(data: bytes) -> tuple[Any, bytes]:
    """Return the JSON values and the bytes of the arrays from the result of `record_bytes`, for `decode` with
    planes.

    Raises:
        ValueError: The bytes are damaged.
    """
    end = _LENGTH + int.from_bytes(data[:_LENGTH], "little")
    if len(data) < end:
        raise ValueError("the block is cut off")
    return msgspec.json.decode(data[_LENGTH:end]), data[end:]


def _encoded(value: Any, blob: _Blob) -> Any:  # noqa: ANN401
    """Return a value as JSON values, with its arrays added to `blob`: a dataclass as a dict of its saved
    fields, a tuple as a list, an array as its description, a float that is not finite as a string.

    Raises:
        TypeError: A value has another type.
    """
    if isinstance(value, np.ndarray):
        return blob.add(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {name: _encoded(getattr(value, name), blob) for name in _saved(type(value))}
    if isinstance(value, tuple | list):
        return [_encoded(part, blob) for part in value]
    if isinstance(value, dict):
        return {str(name): _encoded(part, blob) for name, part in value.items()}
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} cannot be saved")


def decode(kind: type[R], tree: Any, blob: bytes, *, planes: bool = False) -> R:  # noqa: ANN401
    """Return the record that `encode` encoded. Fields with NOT_SAVED get their defaults. Arrays are
    copies.

    Args:
        kind: Type of the record.
        tree, blob: Result of `encode`.
        planes: As in `encode`.

    Raises:
        ValueError: A field is missing or unknown, or has another type, or an array is not inside of the
            block.
    """
    result: R = _decoded(kind, tree, _Block(blob, planes), kind.__name__)
    return result


class _Block(NamedTuple):
    """Bytes of arrays, and whether they are arranged in planes."""

    raw: bytes
    planes: bool


def _decoded(kind: Any, tree: Any, blob: _Block, name: str) -> Any:  # noqa: ANN401
    """Return the value of a JSON value by its declared type.

    Args:
        kind: Declared type, possibly generic.
        tree: JSON value.
        blob: Bytes of the arrays.
        name: Name of the value in errors.

    Raises:
        ValueError: The value has another type.
    """
    origin, of = _origin_and_args(kind)
    if origin is np.ndarray:
        return _array(_origin_and_args(of[1])[1][0], tree, blob, name)
    if origin in (Union, types.UnionType):
        if tree is None and type(None) in of:
            return None
        return _decoded(next(k for k in of if k is not type(None)), tree, blob, name)
    if origin is tuple:
        return _tuple(of, tree, blob, name)
    if origin is list:
        return list(_tuple((of[0], Ellipsis), tree, blob, name))
    if origin is Counter:
        return Counter(_decoded(dict[str, int], tree, blob, name))
    if origin is dict:
        if not isinstance(tree, dict):
            raise ValueError(f"{name} is not a table")
        return {str(k): _decoded(of[1], part, blob, f"{name}.{k}") for k, part in tree.items()}
    if origin is Literal:
        if tree not in of:
            raise ValueError(f"{name} is not one of {of}")
        return tree
    if isinstance(kind, type) and issubclass(kind, tuple):  # a NamedTuple, saved as a row
        hints = _hints(kind)
        return kind(*_tuple(tuple(hints.values()), tree, blob, name))
    if is_dataclass(kind):
        return _record(kind, tree, blob, name)
    return _number(kind, tree, name)


def _record(kind: Any, tree: Any, blob: _Block, name: str) -> Any:  # noqa: ANN401
    """Return a dataclass of type `kind` from a dict of its saved fields.

    Raises:
        ValueError: `tree` is not a dict, or has other fields.
    """
    wanted = _saved(kind)
    if not isinstance(tree, dict) or set(tree) != set(wanted):
        raise ValueError(f"{name} does not have the fields of this version")
    kinds = _hints(kind)
    return kind(**{part: _decoded(kinds[part], tree[part], blob, f"{name}.{part}") for part in wanted})


def _tuple(of: tuple[Any, ...], tree: Any, blob: _Block, name: str) -> tuple[Any, ...]:  # noqa: ANN401
    """Return a tuple of the declared types `of` from a list; (T, Ellipsis) allows any length.

    Raises:
        ValueError: `tree` is not a list, or has another length.
    """
    if not isinstance(tree, list):
        raise ValueError(f"{name} is not a list")
    if len(of) == 2 and of[1] is Ellipsis:
        return tuple(_decoded(of[0], part, blob, name) for part in tree)
    if len(tree) != len(of):
        raise ValueError(f"{name} has {len(tree)} elements, not {len(of)}")
    return tuple(_decoded(k, part, blob, name) for k, part in zip(of, tree, strict=True))


def _number(kind: Any, tree: Any, name: str) -> Any:  # noqa: ANN401
    """Return a value of type `kind`: int, float, bool or str. An integer is also accepted as float, and so
    are the strings "nan", "inf" and "-inf".

    Raises:
        ValueError: The value has another type, or is an integer with a magnitude of 2^63 or more.
    """
    if kind is float and isinstance(tree, str) and tree in ("nan", "inf", "-inf"):
        return float(tree)
    if isinstance(tree, int) and not isinstance(tree, bool) and abs(tree) < 1 << 63 and kind in (int, float):
        return kind(tree)
    if kind is float and isinstance(tree, float):
        return tree
    if kind in (bool, str) and isinstance(tree, kind):
        return tree
    raise ValueError(f"{name} = {str(tree)[:40]!r} is not of type {getattr(kind, '__name__', kind)}")


def _array(scalar: Any, tree: Any, blob: _Block, name: str) -> np.ndarray[Any, Any]:  # noqa: ANN401
    """Return a copy of an array with elements of type `scalar` by its description, see `_Blob.add`.

    Raises:
        ValueError: The array has another type, no valid shape (1 to 8 dimensions), or is not inside of the
            block.
    """
    dtype, stored = _dtypes(scalar)
    if not isinstance(tree, dict) or tree.get("dtype") != stored.str:
        raise ValueError(f"{name} is not an array of {dtype}")
    shape: Any = tree.get("shape")
    at: Any = tree.get("at")
    if not isinstance(shape, list) or not shape or not all(type(n) is int and n >= 0 for n in (*shape, at)):
        raise ValueError(f"{name} has no valid shape")
    count = math.prod(shape)
    if len(shape) > 8 or at + count * dtype.itemsize > len(blob.raw):
        raise ValueError(f"{name} is not inside of the block of arrays")
    if blob.planes:
        raw = np.frombuffer(blob.raw, np.uint8, count * dtype.itemsize, at).reshape(dtype.itemsize, count)
        return raw.T.copy().view(stored).reshape(shape).astype(dtype, copy=False)
    return np.frombuffer(blob.raw, stored, count, at).reshape(shape).astype(dtype)


@cache
def _dtypes(scalar: Any) -> tuple[np.dtype[Any], np.dtype[Any]]:  # noqa: ANN401
    """Return the data type of elements in memory, and in a block."""
    dtype = np.dtype(scalar)
    return dtype, dtype.newbyteorder("<")


TREE, ARRAYS = "tree.json", "arrays.bin"
LARGEST_TREE, LARGEST_ARRAYS = 64 << 20, 4 << 30  # bytes
MOST_RATIO, FREE = (
    100,
    64 << 20,
)  # compression ratio and bytes that are accepted; a real state has a ratio of 2
_EPOCH = (1980, 1, 1, 0, 0, 0)


def write_archive(tree: Any, blob: bytes) -> bytes:  # noqa: ANN401 - any JSON
    """Return the bytes of a zip with `tree.json` and `arrays.bin`; the same state gives the same bytes.

    Args:
        tree: JSON values without NaN and infinity (else ValueError).
        blob: Bytes of the arrays to which `tree` refers.
    """
    text = json.dumps(tree, allow_nan=False, separators=(",", ":")).encode()
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in ((TREE, text), (ARRAYS, blob)):
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, data, compresslevel=1)
    return file.getvalue()


def read_archive(data: bytes, where: str) -> tuple[Any, bytes]:
    """Return the JSON values and the bytes of the arrays of an archive; sizes are checked before memory is
    allocated.

    Args:
        data: Bytes of the archive, see `write_archive`.
        where: Name of the file in errors.

    Raises:
        StemmapError: The archive is damaged, is another file, or declares sizes that are too large.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            text = _entry(archive, TREE, LARGEST_TREE)
            blob = _entry(archive, ARRAYS, LARGEST_ARRAYS)
        return json.loads(text), blob
    except (zipfile.BadZipFile, zipfile.LargeZipFile, KeyError, ValueError, EOFError, OSError,
            NotImplementedError, RuntimeError, RecursionError, MemoryError, zlib.error) as error:  # fmt: skip
        raise damaged(where, str(error) or type(error).__name__) from None


def damaged(where: str, why: str) -> StemmapError:
    """Return the error for a saved state that cannot be used.

    Args:
        where: Name of the file.
        why: Reason.
    """
    return StemmapError(f"the saved state is damaged: {why}", where=where, remedy="Map the run again")


def _entry(archive: zipfile.ZipFile, name: str, largest: int) -> bytes:
    """Return the bytes of a file in an archive.

    Raises:
        KeyError: There is no such file.
        ValueError: The file is compressed in another way, declares more than `largest` bytes or an
            implausible ratio, or has another size than declared.
    """
    entry = archive.getinfo(name)
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed in another way")
    declared = entry.file_size
    if declared > min(largest, FREE + MOST_RATIO * entry.compress_size):
        raise ValueError(f"{name} declares {declared} bytes")
    with archive.open(name) as file:
        data = file.read(declared + 1)
    if len(data) != declared:
        raise ValueError(f"{name} does not have its declared size")
    return data
