"""A running scene and what it asks for."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from app.scene import Scene
from tests.app.scene.recorder import Recorder


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture
async def scene(recorder: Recorder) -> AsyncIterator[Scene]:
    shown = Scene(recorder, asyncio.get_running_loop())
    yield shown
    shown.close()
