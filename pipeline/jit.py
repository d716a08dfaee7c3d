"""Compilation of kernels by Numba, and the cache of their machine code.

A kernel is compiled at its first call and cached next to its source, so that only the first start on a
machine compiles. All machines of a kind compile for one target (`fix_target`), so that kernels can be copied
to another machine and compute the same there. `fastmath` is off for the same reason; only `compiled_sums` may
change the order of the terms of a sum.

A kernel includes functions and constants of other modules. Numba checks only the time of the file of a
kernel; here the cache is valid for a digest of all modules of this project that the file imports.
"""

from __future__ import annotations

import glob
import hashlib
import platform
import re
import shutil
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ParamSpec, TypeVar

import llvmlite.binding
import numba
from numba.core import event
from numba.core.targetconfig import TargetConfig

P = ParamSpec("P")
R = TypeVar("R")

#: Name of the target of compilation in LLVM, and the features of a processor that has it (System V ABI for
#: x86-64, level 3: Intel Core and Xeon since 2013, AMD since 2015), by the name of the machine.
_X86_64_V3 = ("x86-64-v3", ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"))
_ARMV8: tuple[str, tuple[str, ...]] = ("generic", ())
_TARGETS = {"x86_64": _X86_64_V3, "AMD64": _X86_64_V3, "aarch64": _ARMV8, "arm64": _ARMV8}

_FROM = re.compile(r"^from ([\w.]+) import (\([^)]*\)|.*)$", re.MULTILINE)
_IMPORT = re.compile(r"^import (.*)$", re.MULTILINE)
_NAME = re.compile(r"\w+")
_DOTTED = re.compile(r"[\w.]+")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function as a kernel: it is compiled to machine code at its first call with new argument
    types, or loaded from the cache, and releases the interpreter lock while it runs.

    Indexes are not checked against bounds; a division of floats by zero gives inf or NaN, as in NumPy. The
    plain function is the attribute `py_func`.
    """
    # Without _nrt a kernel would inherit the setting of its caller.
    return _kernel(function, _nrt=True)


def compiled_borrowing(function: Callable[P, R]) -> Callable[P, R]:
    """Return a kernel like `compiled`, without reference counting; the function must neither create nor keep
    an array. The atomic operations of reference counting cost more than the arithmetic of a loop over few
    landmarks."""
    return _kernel(function, _nrt=False)


def compiled_sums(function: Callable[P, R]) -> Callable[P, R]:
    """Return a kernel like `compiled` for sums over arrays, with vector registers, which is several times
    faster. The order of the terms is fixed at compilation: runs with one target give the same bytes, and two
    targets may differ in the last bit, like the matrix products of NumPy."""
    return _kernel(function, _nrt=True, fastmath={"reassoc", "nsz"})


def fix_target() -> None:
    """Let Numba compile for the target of `_TARGETS` instead of the processor of this machine, whose vector
    registers may be wider. A processor without its features keeps Numba's target, and NUMBA_CPU_NAME in the
    environment chooses another one."""
    name, features = _TARGETS.get(platform.machine(), ("", ()))
    if not name or numba.config.CPU_NAME is not None:
        return
    present = llvmlite.binding.get_host_cpu_features()
    if all(present.get(feature) for feature in features):
        numba.config.CPU_NAME, numba.config.CPU_FEATURES = name, ""


def _compare_flags_quickly() -> None:
    """Let Numba compare its compiler flags by the options that are set. It makes a dict of all 40 options for
    each hash and each comparison, of which it needs so many that they take a tenth of a compilation."""
    all_options: Callable[[TargetConfig, object], bool] = TargetConfig.__eq__

    def is_same(flags: TargetConfig, other: object) -> bool:
        same_options = isinstance(other, TargetConfig) and flags._values == other._values
        return same_options or all_options(flags, other)

    TargetConfig.__hash__ = lambda flags: hash(type(flags))  # of the names of the options, so far
    TargetConfig.__eq__ = is_same


fix_target()
_compare_flags_quickly()
_kernels: dict[Any, bool] = {}  # whether its machine code was found in the cache so far


def _kernel(function: Callable[P, R], **options: object) -> Callable[P, R]:
    """Return a function as a kernel with options of Numba, of which all kernels share some."""
    kernel: Callable[P, R] = numba.njit(
        cache=True,
        nogil=True,
        error_model="numpy",
        no_cfunc_wrapper=True,  # only C code would call it
        **options,
    )(function)
    _keep_by_all_sources(kernel, function.__module__)
    _take_no_constants(kernel)
    _kernels[kernel] = False
    return kernel


def _take_no_constants(kernel: Any) -> None:  # noqa: ANN401
    """Let a kernel be compiled for int64 where another kernel passes a constant integer. Numba would compile
    it once for the constant and once more for variables; LLVM knows the constant where it inlines the
    kernel."""
    template = kernel.get_call_template

    def without_constants(args: tuple[Any, ...], kws: dict[str, Any]) -> Any:  # noqa: ANN401
        plain = {name: numba.types.unliteral(kind) for name, kind in kws.items()}
        return template(tuple(map(numba.types.unliteral, args)), plain)

    kernel.get_call_template = without_constants


def count_kept() -> int:
    """Return the number of kernels of the loaded modules for which `is_kept` is true now or was at an earlier
    call."""
    for kernel, found in _kernels.items():
        _kernels[kernel] = found or is_kept(kernel)
    return sum(_kernels.values())


_callbacks: list[Callable[[], None]] = []


class _CompilationListener(event.Listener):  # type: ignore[misc]
    """Calls a function when Numba begins to compile a kernel; loading from the cache is no compilation."""

    def __init__(self, callback: Callable[[], None]) -> None:
        self._callback = callback

    def on_start(self, event: event.Event) -> None:
        """Call the function."""
        del event
        self._callback()

    def on_end(self, event: event.Event) -> None:
        """Do nothing."""


@contextmanager
def on_compiling(callback: Callable[[], None]) -> Iterator[None]:
    """Call a function without arguments before each kernel that any thread of this process compiles within
    the context, in the thread that compiles, and at each call of `others_compile`. Loading from the cache is
    no compilation. Contexts may be nested; each calls its own function."""
    _callbacks.append(callback)
    try:
        with event.install_listener("numba:compile", _CompilationListener(callback)):
            yield
    finally:
        _callbacks.remove(callback)


def others_compile() -> None:
    """Call the functions of all open contexts of `on_compiling`, in the calling thread, and return. It is
    called repeatedly by a thread that waits for kernels which other processes compile. Without an open
    context, nothing happens."""
    for callback in tuple(_callbacks):
        callback()


def _keep_by_all_sources(kernel: Any, module: str) -> None:  # noqa: ANN401
    """Change the cache of a kernel so that its machine code is valid for one digest of all sources that the
    kernel may include.

    Args:
        kernel: Dispatcher of Numba with `cache=True`; its cache object is changed in place.
        module: Dotted name of the module that defines the kernel.
    """
    file = kernel._cache._cache_file  # Numba has no public interface for this
    # not the time of the file: copies of the sources share a cache
    file._source_stamp = sources_digest(module)
    # Numba numbers its files from zero after a change of the sources, and writes the index first. A process
    # that ends in between, or reads meanwhile, would run old machine code. No two sources share a file name.
    digest = hashlib.sha256(repr(file._source_stamp).encode()).hexdigest()[:12]
    # Entries of other sources are not read, because they may refer to classes that no longer exist.
    file._version = f"{file._version} {digest}"
    base = file._index_name.removesuffix(".nbi")
    _copy_delivered(Path(sys.modules[module].__file__ or "").parent / "__pycache__", file, f"{base}.{digest}")
    # Two types share no file name either: an index that was read before a change leads to no other code.
    file._data_name = lambda _number: f"{base}.{digest}.{uuid.uuid4().hex[:16]}.nbc"
    file.save = _saved_by_one(file, base)


def _copy_delivered(delivered: Path, file: Any, base: str) -> None:  # noqa: ANN401
    """Copy the machine code of a kernel that was delivered beside its source into the cache, if the cache is
    elsewhere, because the folder of the source is read-only or NUMBA_CACHE_DIR is set, and has none.

    Args:
        delivered: Folder of the delivered files.
        file: Numba's object for the files of one kernel (`IndexDataCacheFile`).
        base: Beginning of the names of the files with machine code of the present sources.
    """
    index = Path(file._index_path)
    if index.parent == delivered:
        return
    codes = tuple(delivered.glob(f"{glob.escape(base)}.*.nbc"))
    if not codes or file._load_index():
        return
    with suppress(OSError):  # else the kernel is compiled
        index.parent.mkdir(parents=True, exist_ok=True)
        with locked(index), TemporaryDirectory(dir=index.parent) as parts:
            if file._load_index():
                return
            for each in (*codes, delivered / index.name):  # the index last
                part = shutil.copyfile(each, Path(parts) / each.name)
                part.replace(index.parent / each.name)


def _saved_by_one(file: Any, base: str) -> Callable[[Any, Any], None]:  # noqa: ANN401
    """Return a replacement of the method `save` of Numba's cache file. It lets one process at a time write
    the cache of a kernel, because two processes that compile for different types at once would otherwise use
    the same file, and deletes machine code to which no index refers.

    Args:
        file: Numba's object for the files of one kernel (`IndexDataCacheFile`).
        base: Name of these files without extension.
    """
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
def locked(file: Path) -> Iterator[None]:
    """Hold the exclusive lock of the folder of a file within the context, and wait for it if another process
    holds it. The lock is the file `.lock` in that folder, which is created. Without effect where the system
    has no locks or the folder cannot be written."""
    with ExitStack() as stack:
        with suppress(ImportError, OSError):
            import fcntl

            lock = stack.enter_context((file.parent / ".lock").open("a"))
            fcntl.flock(lock, fcntl.LOCK_EX)  # released when the file is closed
        yield


def is_kept(kernel: Callable[..., Any]) -> bool:
    """Return whether the cache on disk has machine code of a kernel (result of `compiled` or its variants),
    for any argument types, of the present sources. It reads the index of the cache."""
    return bool(kernel._cache._cache_file._load_index())  # type: ignore[attr-defined]


def sources_digest(module: str) -> str:
    """Return the SHA-256 (hex) of the source of a module and of all loaded modules of its top-level package
    and of this one that it imports, directly or indirectly. Sources are read once per process: later changes
    of the files have no effect.

    Args:
        module: Dotted name of a loaded module.
    """
    packages = tuple(f"{name.partition('.')[0]}." for name in (module, __name__))
    seen = {module}
    waiting = [module]
    while waiting:
        found = {name for name in _imported(waiting.pop()) if name.startswith(packages)} - seen
        seen |= found
        waiting += found
    digest = hashlib.sha256()
    for name in sorted(seen):
        digest.update(name.encode() + b"\0" + _source(name))
    return digest.hexdigest()


@cache
def _imported(module: str) -> frozenset[str]:
    """Return the dotted names of the loaded modules that the import statements of a module name; a statement
    is recognised by the beginning of its line, so that indented imports do not count."""
    names: set[str] = set()
    text = _source(module).decode()
    for origin, what in _FROM.findall(text):
        names |= {origin, *(f"{origin}.{name}" for name in _NAME.findall(what))}
    for what in _IMPORT.findall(text):
        names |= set(_DOTTED.findall(what))
    return frozenset(name for name in names if name in sys.modules)


@cache
def _source(module: str) -> bytes:
    """Return the source of a loaded module, read once per process; empty if the module is not loaded or has
    no file."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file).read_bytes() if file else b""
