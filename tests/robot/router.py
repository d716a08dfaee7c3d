"""A Zenoh router on this machine, as a robot has one: `python -m tests.robot.router PORT`."""

from __future__ import annotations

import json
import sys
import threading

import zenoh


def main(port: str) -> None:
    """Route until stdin ends."""
    settings = {
        "mode": "router",
        "listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]},
        "scouting": {"multicast": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))):
        print("ready", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    threading.current_thread().name = "router"
    main(sys.argv[1])
