"""What figures were measured on, and how much memory this process takes."""

from __future__ import annotations

import os
import platform
import resource
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("numpy", "numba", "open3d-cpu", "open3d", "scikit-learn", "filterpy")
MIB = 1024.0 * 1024.0


def description() -> str:
    """CPU, cores, load, Python and versions in one line."""
    packages = ", ".join(f"{name} {v}" for name in PACKAGES if (v := _version(name)))
    busy = f", load {os.getloadavg()[0]:.1f} at the start" if hasattr(os, "getloadavg") else ""
    return (
        f"{_cpu()}, {os.cpu_count()} cores{busy}; {platform.system()}, "
        f"Python {platform.python_version()}, {packages}"
    )


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def peak_mib() -> float:
    """The most memory that this process ever held [MiB].

    Linux hands ru_maxrss on through fork and exec, so a child would tell its parent's peak: there the
    kernel's own high-water mark of this process's memory is read.
    """
    marked = _status("VmHWM")
    if marked is not None:
        return marked
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / MIB


def resident_mib(pid: int | str = "self") -> float:
    """The memory that a process holds now [MiB]; the peak of this process where the system does not tell."""
    now = _status("VmRSS", pid)
    return peak_mib() if now is None else now


def _status(field: str, pid: int | str = "self") -> float | None:
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    kib = [int(line.split()[1]) for line in lines if line.startswith(f"{field}:")]
    return kib[0] / 1024.0 if kib else None
