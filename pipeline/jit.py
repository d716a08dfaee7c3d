"""The one place that knows how our own loops are compiled.

Kernels are compiled at their first call and kept on disk beside the source, so that only the first
start on a machine waits for them. `fastmath` stays off: the same input must give the same bytes. Only
where a kernel does nothing but add up over an array, its terms may be added in another order.

A kernel takes in what it calls, and constants too, from other files. Numba looks at the kernel's own
file alone when it asks whether what is kept is still good; here all files of ours that it imports count.
"""

from __future__ import annotations

import glob
import hashlib
import re
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
from numba.core import event

P = ParamSpec("P")
R = TypeVar("R")

_FROM = re.compile(r"^from ([\w.]+) import (\([^)]*\)|.*)$", re.MULTILINE)
_IMPORT = re.compile(r"^import (.*)$", re.MULTILINE)
_NAME = re.compile(r"\w+")
_DOTTED = re.compile(r"[\w.]+")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a loop over arrays to machine code; it holds no interpreter lock while it runs."""
    # A kernel that does not say whether it counts would do as the one that calls it.
    kernel: Callable[P, R] = numba.njit(cache=True, nogil=True, error_model="numpy", _nrt=True)(function)
    _keep_by_all_sources(kernel, function.__module__)
    return kernel


def compiled_borrowing(function: Callable[P, R]) -> Callable[P, R]:
    """Compile an inner loop that makes no array and keeps none: it only borrows those that it is handed, so
    it need not count who holds them. Counting is an atomic operation wherever an array is named in a tuple
    of arrays, which costs more than the arithmetic of a loop over few landmarks."""
    kernel: Callable[P, R] = numba.njit(cache=True, nogil=True, error_model="numpy", _nrt=False)(function)
    _keep_by_all_sources(kernel, function.__module__)
    return kernel


def compiled_within(function: Callable[P, R]) -> Callable[P, R]:
    """Compile an inner loop, as above, into each kernel that calls it: a call hands over every array of a
    tuple of arrays by eight numbers, which costs more than a short loop itself."""
    kernel: Callable[P, R] = numba.njit(
        cache=True, nogil=True, error_model="numpy", _nrt=False, inline="always"
    )(function)
    _keep_by_all_sources(kernel, function.__module__)
    return kernel


def compiled_sums(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a loop that adds up over arrays so that vector registers are used, which is several times
    faster. The order of the terms is set when it is compiled: runs on one kind of processor agree in
    every byte, two kinds may differ in the last bit, as with the library's products of matrices."""
    kernel: Callable[P, R] = numba.njit(
        cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "nsz"}, _nrt=True
    )(function)
    _keep_by_all_sources(kernel, function.__module__)
    return kernel


_heard: list[Callable[[], None]] = []


class _Compiling(event.Listener):  # type: ignore[misc]
    """Hears of every kernel that is compiled; one that is loaded from what is kept is none."""

    def __init__(self, begun: Callable[[], None]) -> None:
        self._begun = begun

    def on_start(self, event: event.Event) -> None:
        """A kernel begins to be compiled."""
        del event
        self._begun()

    def on_end(self, event: event.Event) -> None:
        """It is compiled."""


@contextmanager
def on_compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Inside, `tell` is called before each kernel that this machine has to compile, in the thread that
    waits for it, and when somebody else compiles for it (see `others_compile`). Kernels that are kept on disk
    need no compiling and are not told."""
    _heard.append(tell)
    try:
        with event.install_listener("numba:compile", _Compiling(tell)):
            yield
    finally:
        _heard.remove(tell)


def others_compile() -> None:
    """Tell those who listen that this thread waits for kernels which other processes compile."""
    for tell in tuple(_heard):
        tell()


def _keep_by_all_sources(kernel: Any, module: str) -> None:  # noqa: ANN401
    """Let what is kept of a kernel be good only while no source that it may have taken in has changed."""
    file = kernel._cache._cache_file  # numba has no public place for this
    file._source_stamp = sources_digest(module)  # not the file's time: a copy of the sources shares the cache
    # Numba numbers files anew after a change of the sources, and writes its index first: who dies in between,
    # or reads meanwhile, would run machine code of the sources before. No two sources share a name here.
    digest = hashlib.sha256(repr(file._source_stamp).encode()).hexdigest()[:12]
    # Of other sources nothing but this is read: what they left may name classes that are no more.
    file._version = f"{file._version} {digest}"
    base = file._index_name.removesuffix(".nbi")
    # Nor do two types: who has read an index, while sources change to and fro, finds its own code or none.
    file._data_name = lambda _number: f"{base}.{digest}.{uuid.uuid4().hex[:16]}.nbc"
    file.save = _saved_by_one(file, base)


def _saved_by_one(file: Any, base: str) -> Callable[[Any, Any], None]:  # noqa: ANN401
    """Let one process at a time write what is kept of a kernel: two that compile it for other types at once
    would give both the same file, and the index would lead one of them to the other's machine code. What
    no index names goes."""
    save: Callable[[Any, Any, Any], None] = type(file).save

    def save_alone(key: Any, data: Any) -> None:  # noqa: ANN401
        index = Path(file._index_path)
        with locked(index):
            if not file._load_index():
                for other in index.parent.glob(f"{glob.escape(base)}.*.nbc"):
                    other.unlink(missing_ok=True)
            save(file, key, data)

    return save_alone


@contextmanager
def locked(beside: Path) -> Iterator[None]:
    """Inside, no other process holds the lock of a file's folder; where there can be no lock, all goes on."""
    with ExitStack() as stack:
        with suppress(ImportError, OSError):
            import fcntl

            lock = stack.enter_context((beside.parent / ".lock").open("a"))
            fcntl.flock(lock, fcntl.LOCK_EX)  # let go with the file
        yield


def is_kept(kernel: Callable[..., Any]) -> bool:
    """Whether machine code of a kernel is kept, for any types, that was made from the sources as they are."""
    return bool(kernel._cache._cache_file._load_index())  # type: ignore[attr-defined]


def sources_digest(module: str) -> str:
    """SHA-256 (hex) of a module's source and of those of its package that it imports, however far."""
    package = module.partition(".")[0] + "."
    seen = {module}
    waiting = [module]
    while waiting:
        found = {name for name in _imported(waiting.pop()) if name.startswith(package)} - seen
        seen |= found
        waiting += found
    digest = hashlib.sha256()
    for name in sorted(seen):
        digest.update(name.encode() + b"\0" + _source(name))
    return digest.hexdigest()


@cache
def _imported(module: str) -> frozenset[str]:
    """The modules that are loaded and named in the imports of this one."""
    names: set[str] = set()
    text = _source(module).decode()
    for origin, what in _FROM.findall(text):
        names |= {origin, *(f"{origin}.{name}" for name in _NAME.findall(what))}
    for what in _IMPORT.findall(text):
        names |= set(_DOTTED.findall(what))
    return frozenset(name for name in names if name in sys.modules)


@cache
def _source(module: str) -> bytes:
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file).read_bytes() if file else b""
