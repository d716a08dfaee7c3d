"""Description of the machine, and memory of processes."""

from __future__ import annotations

import math
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
    """Return the peak memory of this process [MiB].

    On Linux, ru_maxrss is inherited through fork and exec, so a child would report the peak of its parent.
    Therefore the high-water mark that the kernel stores for this process is read.
    """
    marked = _status("VmHWM")
    if marked is not None:
        return marked
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / MIB


def resident_mib(pid: int | str = "self") -> float:
    """Return the resident memory of a process [MiB]; the peak of this process if the system does not provide
    it."""
    now = _status("VmRSS", pid)
    return peak_mib() if now is None else now


def anonymous_mib(pid: int | str = "self") -> float:
    """Return the resident memory of a process that is in no file [MiB]; NaN if the system does not provide
    it."""
    now = _status("RssAnon", pid)
    return math.nan if now is None else now


def _status(field: str, pid: int | str = "self") -> float | None:
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    kib = [int(line.split()[1]) for line in lines if line.startswith(f"{field}:")]
    return kib[0] / 1024.0 if kib else None
