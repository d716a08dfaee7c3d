"""Records to words, numbers and one block of arrays, and back by the types that the records declare.

Nothing in the file chooses what is built: the reader asks for a record and takes what its fields want.
"""

from __future__ import annotations

import math
import types
import typing
from collections import Counter
from dataclasses import fields, is_dataclass
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

import numpy as np

R = TypeVar("R")
NOT_SAVED = "not saved"  # in the metadata of a field: it is left out, and begins by its default
_ALIGN = 8


class _Blob:
    """Arrays behind one another, each at a multiple of eight bytes."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.length = 0

    def add(self, array: np.ndarray[Any, Any]) -> dict[str, Any]:
        data = np.ascontiguousarray(array)
        at = self.length
        raw = data.tobytes()
        self.parts.append(raw + b"\0" * (-len(raw) % _ALIGN))
        self.length += len(self.parts[-1])
        return {"dtype": data.dtype.newbyteorder("<").str, "shape": list(array.shape), "at": at}


def encode(record: Any) -> tuple[Any, bytes]:  # noqa: ANN401 - any record
    """A record of arrays, numbers, words, tuples and other records as JSON and the bytes of its arrays."""
    blob = _Blob()
    tree = _encoded(record, blob)
    return tree, b"".join(blob.parts)


def _encoded(value: Any, blob: _Blob) -> Any:  # noqa: ANN401
    if isinstance(value, np.ndarray):
        return blob.add(value)
    if is_dataclass(value) and not isinstance(value, type):
        saved = [f.name for f in fields(value) if not f.metadata.get(NOT_SAVED)]
        return {name: _encoded(getattr(value, name), blob) for name in saved}
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


def decode(kind: type[R], tree: Any, blob: bytes) -> R:  # noqa: ANN401
    """The record of a kind that was encoded.

    Raises:
        ValueError: A field is missing or too much, or has another type, or an array does not lie in the
            block.
    """
    result: R = _decoded(kind, tree, blob, kind.__name__)
    return result


def _decoded(kind: Any, tree: Any, blob: bytes, name: str) -> Any:  # noqa: ANN401
    origin, of = get_origin(kind), get_args(kind)
    if origin is np.ndarray:
        return _array(get_args(of[1])[0], tree, blob, name)
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
            raise ValueError(f"{name} is no table")
        return {str(k): _decoded(of[1], part, blob, f"{name}.{k}") for k, part in tree.items()}
    if origin is Literal:
        if tree not in of:
            raise ValueError(f"{name} is none of {of}")
        return tree
    if isinstance(kind, type) and issubclass(kind, tuple):  # a NamedTuple, saved as a row
        hints = typing.get_type_hints(kind)
        return kind(*_tuple(tuple(hints.values()), tree, blob, name))
    if is_dataclass(kind):
        return _record(kind, tree, blob, name)
    return _number(kind, tree, name)


def _record(kind: Any, tree: Any, blob: bytes, name: str) -> Any:  # noqa: ANN401
    wanted = [f.name for f in fields(kind) if not f.metadata.get(NOT_SAVED)]
    if not isinstance(tree, dict) or set(tree) != set(wanted):
        raise ValueError(f"{name} has not the parts that this version knows")
    kinds = typing.get_type_hints(kind)
    return kind(**{part: _decoded(kinds[part], tree[part], blob, f"{name}.{part}") for part in wanted})


def _tuple(of: tuple[Any, ...], tree: Any, blob: bytes, name: str) -> tuple[Any, ...]:  # noqa: ANN401
    if not isinstance(tree, list):
        raise ValueError(f"{name} is no row")
    if len(of) == 2 and of[1] is Ellipsis:
        return tuple(_decoded(of[0], part, blob, name) for part in tree)
    if len(tree) != len(of):
        raise ValueError(f"{name} has {len(tree)} parts, not {len(of)}")
    return tuple(_decoded(k, part, blob, name) for k, part in zip(of, tree, strict=True))


def _number(kind: Any, tree: Any, name: str) -> Any:  # noqa: ANN401
    if kind is float and isinstance(tree, str) and tree in ("nan", "inf", "-inf"):
        return float(tree)
    if isinstance(tree, int) and not isinstance(tree, bool) and abs(tree) < 1 << 63 and kind in (int, float):
        return kind(tree)
    if kind is float and isinstance(tree, float):
        return tree
    if kind in (bool, str) and isinstance(tree, kind):
        return tree
    raise ValueError(f"{name} = {str(tree)[:40]!r} is no {getattr(kind, '__name__', kind)}")


def _array(scalar: Any, tree: Any, blob: bytes, name: str) -> np.ndarray[Any, Any]:  # noqa: ANN401
    dtype = np.dtype(scalar)
    if not isinstance(tree, dict) or tree.get("dtype") != dtype.newbyteorder("<").str:
        raise ValueError(f"{name} is no array of {dtype}")
    shape: Any = tree.get("shape")
    at: Any = tree.get("at")
    if not isinstance(shape, list) or not shape or not all(type(n) is int and n >= 0 for n in (*shape, at)):
        raise ValueError(f"{name} has no shape")
    count = math.prod(shape)
    if len(shape) > 8 or at + count * dtype.itemsize > len(blob):
        raise ValueError(f"{name} does not lie in the block of arrays")
    flat = np.frombuffer(blob, dtype.newbyteorder("<"), count, at)
    return flat.reshape(shape).astype(dtype)
