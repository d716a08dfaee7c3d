"""`stemmap serve` as a process of a campaign, with the checks that must pass after every fault."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import secrets
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import httpx

from pipeline.errors import StemmapError
from pipeline.io.readers import open_source
from pipeline.io.recording.mcap_writer import repair
from pipeline.types.records import Scan
from tests.app.robot.conftest import free_port
from tests.benchmarks.campaign import Result
from tests.benchmarks.machine import resident_mib
from tests.benchmarks.process import ROOT, environment

TOKEN = "token-of-a-campaign-only"
BROWSER = "0123456789abcdef"
HANGS_S = 10.0  # longest allowed time of an answer
_CLOUD_S = 60.0  # the cloud of a run, for which a child process reads the source again
_PATIENCE_S = 120.0  # for a start on a busy machine
_ORPHAN_S = 20.0  # a live worker finishes its recording within 10 s
_START = "import sys; from app.cli import main; sys.exit(main())"
_MARK = "STEMMAP_CAMPAIGN"
Edits = list[tuple[int, float]]  # numbers and x of acknowledged annotations
SHORT_RUN = "sim:stand?duration=5"
_OTHER_RUN = "sim:stand?duration=1"


class Service:
    """A server with an own data folder.

    Args:
        result: Gets the faults.
        source: Source that it opens.
        folder: Folder of its data and of its log.
        words: Further arguments.
        file_bytes: Size beyond which its files cannot grow; None for no limit.
    """

    def __init__(
        self, result: Result, source: str, folder: Path, *words: str, file_bytes: int | None = None
    ) -> None:
        folder.mkdir(exist_ok=True)
        self.result, self.folder = result, folder
        self._mark, self._log = secrets.token_hex(8), (folder / "log.txt").open("ab")
        self._from = self._log.tell()
        port = free_port()
        given = {"STEMMAP_TOKEN": TOKEN, "STEMMAP_FOLDER": str(folder / "data"), _MARK: self._mark}

        def limit() -> None:
            if file_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))

        self.process = subprocess.Popen(
            [sys.executable, "-c", _START, "serve", source, "--no-browser", "--port", str(port), *words],
            cwd=ROOT,
            env={**environment(), **given},
            stdout=self._log,
            stderr=subprocess.STDOUT,
            preexec_fn=limit,
        )
        self.port = port
        self.web = httpx.Client(
            base_url=f"http://127.0.0.1:{port}", headers={"Authorization": f"Bearer {TOKEN}"}, timeout=60.0
        )
        self.until(lambda: self._is_up(), "answered", _PATIENCE_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def ask(self, method: str, path: str, content: Any = None) -> httpx.Response | None:
        """Send a request; return the response, None without one. A 5xx other than 503 and 507, and an answer
        after HANGS_S (_CLOUD_S for the cloud of a run), are faults."""
        begun = time.monotonic()
        try:
            body = None if content is None else json.dumps(content)
            response = self.web.request(
                method, path, content=body, headers={"Content-Type": "application/json"} if body else None
            )
        except httpx.HTTPError as error:
            if self.process.poll() is None:
                self.result.faults.append(f"{method} {path}: {type(error).__name__}")
            return None
        took_s = time.monotonic() - begun
        self.result.longest_s = max(self.result.longest_s, took_s)
        if response.status_code >= 500 and response.status_code not in (503, 507):
            self.result.faults.append(f"{method} {path}: {response.status_code} for {str(body)[:100]}")
        if took_s > (_CLOUD_S if path.startswith("/api/export/laz") else HANGS_S):
            self.result.faults.append(f"{method} {path}: answered after {took_s:.0f} s")
        return response

    def status(self) -> dict[str, Any]:
        """Return the status of the run; {} while the server does not answer."""
        response = self.ask("GET", "/api/status")
        return {} if response is None else dict(response.json())

    def scan(self) -> int:
        """Return the index of the current scan; -1 before the first."""
        return int(self.status().get("scan_index", -1))

    def until_scan(self, index: int) -> None:
        """Wait until a scan is mapped."""
        self.until(lambda: self.scan() >= index, f"mapped scan {index}")

    def until_found(self) -> None:
        """Wait until a live source knows its robot, which does not send yet."""
        self.until(lambda: "announced and silent" in self.status().get("detail", ""), "found the robot")

    def until(self, holds: Callable[[], bool], what: str, limit_s: float = 60.0) -> bool:
        """Wait until a condition is true; a timeout is a fault."""
        end = time.monotonic() + limit_s
        while not holds():
            if time.monotonic() > end:
                self.result.faults.append(f"it never {what}")
                return False
            time.sleep(0.05)
        return True

    def annotate(self, edits: Edits, x: float) -> None:
        """Add an annotation; append its number and x if the server acknowledges it."""
        run = self.run_number()
        if run is None:
            return
        edit = {"run": run, "browser": BROWSER, "who": "Ann", "x": x, "y": 1.0}
        response = self.ask("POST", "/api/annotations", edit)
        if response is not None and response.status_code == 201:
            edits.append((int(response.json()["id"]), x))
            self.result.edits += 1

    def run_number(self) -> int | None:
        """Return the number of the open run; None without one."""
        known = self.ask("GET", "/api/annotations")
        return None if known is None or known.status_code != 200 else known.json()["run"]

    def worker(self) -> int | None:
        """Return the process that maps; None without one."""
        for pid in self._marked():
            with contextlib.suppress(OSError):
                if b"app.worker.process" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    return pid
        return None

    def kill(self, who: str) -> None:
        """End "web" or "worker" as kill -9 does."""
        pid = self.process.pid if who == "web" else self.worker()
        if pid is not None:
            os.kill(pid, signal.SIGKILL)

    def map_of(self, uri: str) -> list[Any]:
        """Return the trees of a run that is opened with the default parameters and played to its end."""
        self.ask("POST", "/api/parameters/preset", {"name": "forest"})
        self.ask("POST", "/api/loop", {"from_s": None, "to_s": None})
        # If the run is open already, its status is "finished" until the worker opens it again.
        self.ask("POST", "/api/open", {"uri": _OTHER_RUN})
        self.until(lambda: self.status().get("source") == _OTHER_RUN, "opened another run", _PATIENCE_S)
        self.ask("POST", "/api/open", {"uri": uri})
        self.ask("POST", "/api/command", {"type": "set_speed", "factor": 0.0})
        ended: dict[str, Any] = {}

        def is_mapped() -> bool:
            ended.update(self.status())
            if ended.get("state") == "paused":
                self.ask("POST", "/api/command", {"type": "play"})
            return bool(ended.get("source") == uri and ended.get("state") == "finished")

        self.until(is_mapped, f"mapped {uri}", _PATIENCE_S)
        trees = self.ask("GET", "/api/trees")
        return [] if trees is None else trees.json()["trees"]

    def stop(self) -> None:
        """End it as Ctrl-C does; tracebacks in its log and processes that remain are faults."""
        with contextlib.suppress(OSError):
            self.result.peak_mib = max(self.result.peak_mib, resident_mib(self.process.pid))
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                self.result.faults.append("it does not end")
                self.process.kill()
        self.process.wait()
        self.web.close()
        self.until(lambda: not self._marked(), "ended its processes", _ORPHAN_S)
        for pid in self._marked():
            os.kill(pid, signal.SIGKILL)
        self._log.close()
        text = (self.folder / "log.txt").read_bytes()[self._from :].decode(errors="replace")
        if "Traceback" in text:
            self.result.faults.append(
                "traceback: " + " / ".join(text.split("Traceback")[-1].splitlines()[-3:])
            )

    def _is_up(self) -> bool:
        if self.process.poll() is not None:
            raise StemmapError("the server does not start", where=str(self.folder / "log.txt"))
        try:
            return self.web.get("/health", timeout=5.0).status_code in (200, 503)
        except httpx.HTTPError:
            return False

    def _marked(self) -> list[int]:
        """Return the processes of this server, itself left out; those that have ended are not counted."""
        found = []
        for place in Path("/proc").iterdir():
            if place.name.isdigit() and int(place.name) != self.process.pid:
                with contextlib.suppress(OSError):
                    if f"{_MARK}={self._mark}".encode() in (place / "environ").read_bytes():
                        found.append(int(place.name))
        return found


def check_edits(result: Result, folder: Path, edits: Edits) -> None:
    """Report the acknowledged edits that are missing in the database of a folder."""
    with contextlib.closing(sqlite3.connect(folder / "data" / "annotations.sqlite")) as database:
        known = {(number, round(x, 3)) for number, x in database.execute("SELECT id, x FROM annotations")}
    lost = [edit for edit in edits if (edit[0], round(edit[1], 3)) not in known]
    if lost:
        result.faults.append(f"{len(lost)} of {len(edits)} acknowledged edits are lost")


def check_recording(result: Result, path: Path, period_s: float = 0.1) -> int:
    """Repair a recording and return its number of scans. A recording that cannot be read, or lacks scans in
    the middle, is a fault."""
    mended = path.with_suffix(".mended.mcap")
    try:
        repair(path, mended)
        with contextlib.closing(open_source(str(mended))) as source:
            stamps = [record.stamp_ns for record in source.records() if isinstance(record, Scan)]
    except StemmapError as error:
        result.faults.append(f"the recording cannot be read: {error}")
        return 0
    holes = sum(b - a > 1.5e9 * period_s for a, b in pairwise(stamps))
    if holes:
        result.faults.append(f"{holes} holes in a recording of {len(stamps)} scans")
    return len(stamps)
