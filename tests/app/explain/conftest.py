"""A simulated stand, mapped for a second and a half: enough for trees, clusters and columns."""

from __future__ import annotations

import pytest

from app.worker.process import new_session
from app.worker.protocol import Open
from app.worker.session import Session
from pipeline.config import preset


@pytest.fixture(scope="package")
def session() -> Session:
    mapped = new_session()
    mapped.open(Open("sim:stand?duration=1.5", "auto", 3))
    mapped.set_parameters(preset("forest"), 1)
    mapped.play()
    while mapped.pace == "replay":
        mapped.work()
    return mapped
