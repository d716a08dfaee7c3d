"""`stemmap doctor`: tests whether this machine can run the program, and says what to do where it cannot."""

from __future__ import annotations

import argparse
import platform
import re
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, metadata, requires
from pathlib import Path
from typing import TYPE_CHECKING

from app.common.child_process import usable_cores
from app.common.settings import DEFAULT_PORT

if TYPE_CHECKING:
    from app.common.settings import Settings

HELP = "test whether this machine can run the program"
GB = 1e9
MEMORY = 2.0 * GB  # bytes; the worker and the web process of a drive of an hour, and a browser
#: Bytes; an hour of scans of a LiDAR with 16 beams, recorded and mapped.
DISK = 5.0 * GB
CORES = 2  # the worker and the web process
#: Seconds since 1970 of 2026-01-01: a clock before it was never set.
EARLIEST_S = 1_767_225_600
_SYNCHRONISED = Path("/run/systemd/timesync/synchronized")
_EXTRA = re.compile(r"([\w.-]+).*extra == ['\"](\w+)['\"]")  # a package of an extra, as metadata name it


@dataclass(frozen=True, slots=True)
class MachineCheck:
    """Result of one test.

    Attributes:
        name: What was tested.
        found: What was found.
        remedy: What to do; "" if all is well.
        is_needed: Whether the program needs it; else the remedy is only an offer.
    """

    name: str
    found: str
    remedy: str = ""
    is_needed: bool = True

    def __str__(self) -> str:
        state = "ok" if not self.remedy else f"TO DO: {self.remedy}" if self.is_needed else self.remedy
        return f"{self.name}: {self.found}: {state}"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add no argument."""
    parser.epilog = (
        "A line per test ends with ok or with what to do. Exit code 1: something must be done (TO DO);\n"
        "extras are an offer. The settings in the environment count, see stemmap serve --help."
    )


def run(_arguments: argparse.Namespace) -> int:
    """Print a line per test.

    Returns:
        Exit code: 1 if something that the program needs is missing, else 0.

    Raises:
        StemmapError: A setting in the environment is wrong.
    """
    from app.common.settings import from_environment

    checks = all_checks(from_environment())
    print("\n".join(map(str, checks)))
    return int(any(check.remedy and check.is_needed for check in checks))


def all_checks(settings: Settings) -> list[MachineCheck]:
    """Return the results of all tests.

    Args:
        settings: Settings of the deployment: folder, address and port.
    """
    return [
        memory_check(available_memory()),
        cores_check(usable_cores()),
        instructions_check(compile_target()),
        *folder_checks(settings.folder),
        clock_check(time.time()),
        port_check(settings.host, settings.port),
        *extra_checks(),
    ]


def memory_check(free: int | None) -> MachineCheck:
    """Return whether enough memory is free.

    Args:
        free: Free memory [bytes]; None if it is unknown.
    """
    if free is None:
        return MachineCheck("memory", "the free memory is unknown on this system")
    need = f"free {MEMORY / GB:.0f} GB: end other programs, or use a machine with more memory"
    return MachineCheck("memory", f"{free / GB:.1f} GB are free", "" if free >= MEMORY else need)


def available_memory() -> int | None:
    """Return the memory that programs can still use [bytes], by Linux's estimate and the limit of the control
    group; None if it is unknown."""
    try:
        text = Path("/proc/meminfo").read_text(encoding="ascii")
        free = next(
            int(line.split()[1]) * 1024 for line in text.splitlines() if line.startswith("MemAvailable")
        )
    except (OSError, ValueError, StopIteration):
        return None
    try:
        group = Path("/sys/fs/cgroup")
        limit = int((group / "memory.max").read_text(encoding="ascii"))
        used = int((group / "memory.current").read_text(encoding="ascii"))
        rows = (line.split() for line in (group / "memory.stat").read_text(encoding="ascii").splitlines())
        used -= next((int(size) for name, size in rows if name == "inactive_file"), 0)  # cache of files
    except (OSError, ValueError):  # no control group, or no limit ("max")
        return free
    return min(free, max(limit - used, 0))


def cores_check(cores: int) -> MachineCheck:
    """Return whether there are enough cores.

    Args:
        cores: Number of usable cores.
    """
    need = f"use a machine with {CORES} cores; with one, the page is slow while a run is mapped"
    return MachineCheck(
        "processor", f"{cores} usable core{'s' if cores != 1 else ''}", "" if cores >= CORES else need
    )


def compile_target() -> str | None:
    """Return the target for which kernels are compiled on this processor: x86-64-v3 or generic ARMv8; None
    if it has other instructions."""
    import numba

    from pipeline.jit import fix_target

    fix_target()
    return numba.config.CPU_NAME or None


def instructions_check(target: str | None) -> MachineCheck:
    """Return whether compiled kernels of a wheel fit the processor.

    Args:
        target: See `compile_target`.
    """
    machine = platform.machine()
    if target is not None:
        return MachineCheck("instructions", f"{machine}, compiled for {target}")
    need = "the first start takes minutes, because kernels are compiled here"
    return MachineCheck("instructions", f"{machine} without the level x86-64-v3", need, is_needed=False)


def folder_checks(folder: Path | None) -> list[MachineCheck]:
    """Return whether the data folder can be written and has room.

    Args:
        folder: The data folder, which need not exist; None for none.
    """
    if folder is None:
        return [MachineCheck("data folder", "none: runs are lost at the end", "name one with STEMMAP_FOLDER")]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"stemmap")
    except OSError as error:
        need = "make it writable, or name another with STEMMAP_FOLDER"
        return [MachineCheck("data folder", f"{folder}: {error.strerror}", need)]
    free = shutil.disk_usage(folder).free
    need = (
        f"{DISK / GB:.0f} GB are needed for an hour of scans: delete old runs, or name another STEMMAP_FOLDER"
    )
    return [
        MachineCheck("data folder", f"{folder} can be written"),
        MachineCheck("disk", f"{free / GB:.1f} GB are free there", "" if free >= DISK else need),
    ]


def clock_check(now_s: float) -> MachineCheck:
    """Return whether the clock can be right.

    Args:
        now_s: Present time [s since 1970].
    """
    found = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(now_s))
    if now_s < EARLIEST_S:
        return MachineCheck(
            "clock", found, "set the clock: names of recordings and expiry of links depend on it"
        )
    return MachineCheck("clock", found + (", synchronised" if _SYNCHRONISED.exists() else ""))


def port_check(host: str, port: int | None) -> MachineCheck:
    """Return whether the server can listen.

    Args:
        host: Address on which it listens.
        port: Its port; None for the default port or one of the next, 0 for any.
    """
    number = DEFAULT_PORT if port is None else port
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family) as listener:
            if sys.platform != "win32":
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, number))
    except OSError as error:
        need = "end the program that listens there, or choose another: stemmap serve --port N"
        if port is None:
            need = "nothing: one of the next ports is used; --port N chooses one"
        return MachineCheck("port", f"{host}:{number}: {error.strerror}", need, is_needed=port is not None)
    return MachineCheck("port", f"{host}:{number} is free")


def extra_checks(missing: Callable[[str], bool] | None = None) -> list[MachineCheck]:
    """Return whether the packages of each optional extra are installed.

    Args:
        missing: Returns whether a package is not installed; None asks the metadata of this installation.
    """
    packages: dict[str, list[str]] = {}
    offer = "not installed; uv sync --extra {} adds it"
    for text in requires("stemmap") or ():
        if found := _EXTRA.match(text):
            packages.setdefault(found.group(2), []).append(found.group(1))
    return [
        MachineCheck(
            f"extra {name}",
            ", ".join(needed),
            offer.format(name) if any(map(missing or _is_missing, needed)) else "",
            is_needed=False,
        )
        for name, needed in sorted(packages.items())
    ]


def _is_missing(package: str) -> bool:
    """Return whether a package is not installed."""
    try:
        metadata(package)
    except PackageNotFoundError:
        return True
    return False
