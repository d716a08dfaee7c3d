"""What the flags of the dashboard ask of its first source."""

from __future__ import annotations

from math import pi
from typing import Any

import pytest

from app.cli import main
from app.worker.protocol import Open


def test_what_is_chosen_for_a_source_is_opened(monkeypatch: pytest.MonkeyPatch):
    opened: list[Open] = []

    def serve(_: object, *, source: Open, **__: Any) -> int:
        opened.append(source)
        return 0

    monkeypatch.setattr("app.web.serving.serve", serve)
    chosen = ["--unit", "ft", "--up=-y", "--as", "cloud", "--topic", "scan=/top", "--mount", "0,0,1,0,0,180"]
    assert main(["sim:stand", "--seed", "3", "--odometry", "static", "--no-browser", *chosen]) == 0
    assert opened == [
        Open(
            "sim:stand",
            "static",
            3,
            {"scan": "/top"},
            (0.0, 0.0, 1.0, 0.0, 0.0, pi),
            form="cloud",
            unit="ft",
            up="-y",
        )
    ]
