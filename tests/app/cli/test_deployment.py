"""The container file and the unit of docs/deployment are built and started where their programs exist."""

from __future__ import annotations

import shutil
import subprocess
import time
import urllib.request
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
FOLDER = ROOT / "docs" / "deployment"
IMAGE = "stemmap-test"


def _run(*words: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, timeout=timeout_s, check=False, cwd=ROOT)


def _engine() -> str:
    """Return the program for containers; skips the test where none works."""
    for name in ("podman", "docker"):
        if shutil.which(name) and _run(name, "info").returncode == 0:
            return name
    pytest.skip("neither podman nor docker runs here")


@pytest.mark.slow
def test_the_container_is_built_and_answers():
    engine = _engine()
    built = _run(engine, "build", "-f", str(FOLDER / "Containerfile"), "-t", IMAGE, ".", timeout_s=3600.0)
    assert built.returncode == 0, built.stderr[-2000:]
    words = ("run", "-d", "--rm", "--read-only", "--tmpfs", "/tmp", "--cap-drop", "all")  # noqa: S108
    started = _run(engine, *words, "-p", "127.0.0.1::8000", IMAGE)
    assert started.returncode == 0, started.stderr
    name = started.stdout.strip()
    try:
        address = _run(engine, "port", name, "8000").stdout.split()[0]
        assert _answers(f"http://{address}/health"), _run(engine, "logs", name).stderr[-2000:]
    finally:
        _run(engine, "stop", name)


def test_systemd_accepts_the_unit(tmp_path: Path):
    if shutil.which("systemd-analyze") is None:
        pytest.skip("there is no systemd-analyze here")
    # The program of the unit is in /opt, which a test does not write to.
    text = (FOLDER / "stemmap.service").read_text().replace("/opt/stemmap/bin/stemmap", "/bin/true")
    unit = tmp_path / "stemmap.service"
    unit.write_text(text)
    told = _run("systemd-analyze", "verify", "--man=no", str(unit))
    own = [line for line in told.stderr.splitlines() if unit.name in line]
    assert told.returncode == 0, told.stderr
    assert own == []


@pytest.mark.slow
def test_the_service_starts_and_answers():
    if shutil.which("systemctl") is None or _run("systemctl", "is-system-running").stdout.strip() not in (
        "running",
        "degraded",
    ):
        pytest.skip("systemd does not run here")
    if not Path("/opt/stemmap/bin/stemmap").exists():
        pytest.skip("the program is not installed in /opt/stemmap")
    started = _run("systemctl", "start", str(FOLDER / "stemmap.service"))
    assert started.returncode == 0, started.stderr
    try:
        assert _answers("http://127.0.0.1:8000/health")
    finally:
        _run("systemctl", "stop", "stemmap.service")


def _answers(url: str, timeout_s: float = 120.0) -> bool:
    """Return whether an address answers with 200 within a time."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        try:
            with urllib.request.urlopen(url, timeout=5.0) as answer:  # noqa: S310
                return bool(answer.status == 200)
        except OSError:
            time.sleep(0.5)
    return False
