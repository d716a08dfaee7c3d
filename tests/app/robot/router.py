"""A Zenoh router on this machine: `python -m tests.app.robot.router PORT [OTHER_PORT]`."""

from __future__ import annotations

import json
import sys
import threading

import zenoh


def main(port: str, other: str = "") -> None:
    """Route until stdin ends; with another router, pass all on to it and from it."""
    settings = {
        "mode": "router",
        "listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]},
        "connect": {"endpoints": [f"tcp/127.0.0.1:{other}"] if other else []},
        "scouting": {"multicast": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))):
        print("ready", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    threading.current_thread().name = "router"
    main(*sys.argv[1:])
