"""A router and robots of their own, each a process that ends with its test."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.robot.source import LiveSource, open_live
from pipeline.geometry.poses import Pose3
from pipeline.io.recording.mcap_writer import write_recording
from pipeline.types.records import Odometry, Record, Scan, Sensor

ROOT = Path(__file__).resolve().parents[3]
SCANS, POINTS = 15, 30_000
START_NS = 1_700_000_000_000_000_000


class Child:
    """A Python process that says what it does in lines, and goes on at a line from us."""

    def __init__(self, *words: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, *words], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def hear(self) -> str:
        """Its next line."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, "the process ended without a word"
        return line.strip()

    def go(self) -> None:
        """Let it go on."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def kill(self) -> None:
        """End it as a power cut would."""
        self._process.kill()
        self._process.wait(30)
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            stream.close()


class Robot(Child):
    """The independent publisher with a recording."""

    def __init__(self, port: int, run: Path, name: str) -> None:
        script = str(ROOT / "tests" / "app" / "robot" / "publisher.py")
        super().__init__(script, str(port), str(run), "--robot", name)
        assert json.loads(self.hear()) == {"ready": True}

    def send(self) -> None:
        """Begin."""
        self.go()

    def sent(self) -> int:
        """Wait until all is sent; how many scans."""
        return int(json.loads(self.hear())["scans"])


def listening(uri: str) -> LiveSource:
    """A live source that listens, without a recorder."""
    source = open_live(uri)
    source.start()
    return source


def until(condition: Callable[[], Any], state: Callable[[], str] = str, limit_s: float = 60.0) -> None:
    """Wait for a condition, patiently: the machine may be loaded; `state` tells what was instead."""
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, f"it did not come about: {state()}"
        time.sleep(0.01)


def free_port() -> int:
    """A port that nobody has now."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


def clouds(scans: int, points: int = POINTS, period_ns: int = 100_000_000) -> Iterator[Record]:
    """A robot that drives at 1 m/s through random points of 16 rings, with odometry at 50 Hz."""
    rng = np.random.default_rng(7)
    table = rng.uniform(-20.0, 20.0, (points, 3)).astype(np.float32)
    ring = (np.arange(points) % 16).astype(np.int32)
    table[:, 2] = np.hypot(table[:, 0], table[:, 1]) * np.tan(np.radians(2.0 * ring - 15.0))
    for k in range(scans):
        for part in range(5):
            stamp = START_NS + k * period_ns + part * period_ns // 5
            yield Odometry(stamp, Pose3.from_euler([1e-9 * (stamp - START_NS), 0.0, 0.0], 0.0, 0.0, 0.0))
            if part == 0:
                yield Scan(stamp, np.roll(table, k, axis=0), np.full(points, k, np.float32), np.roll(ring, k))
    yield Odometry(START_NS + scans * period_ns, Pose3.from_euler([0.1 * scans, 0.0, 0.0], 0.0, 0.0, 0.0))


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 15 scans of 30,000 points."""
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    mounted = Pose3.from_euler([0.2, 0.0, 0.9], 0.0, 0.0, 0.0)
    write_recording(path, clouds(SCANS), sensor=Sensor("VLP-16", 16), T_base_lidar=mounted)
    return path


@pytest.fixture
def router() -> Iterator[int]:
    """The port of a Zenoh router."""
    pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed")
    port = free_port()
    child = Child("-m", "tests.app.robot.router", str(port))
    assert child.hear() == "ready"
    yield port
    child.kill()


@pytest.fixture
def robots(router: int, drive: Path) -> Iterator[Callable[[str], Robot]]:
    """Starts robots that have announced themselves and wait for `send`."""
    pytest.importorskip("zenoh_ros2_sdk", reason="zenoh-ros2-sdk, the independent robot, is not installed")
    started: list[Robot] = []

    def start(name: str) -> Robot:
        started.append(Robot(router, drive, name))
        return started[-1]

    yield start
    for robot in started:
        robot.kill()
