"""What ends at the close of a dashboard ends although something else fails to."""

from __future__ import annotations

import logging

import pytest

from app.common.timers import ended


async def test_the_rest_is_ended_where_one_fails(caplog: pytest.LogCaptureFixture):
    done = []

    async def fails() -> None:
        raise OSError("the disk is full")

    async def ends() -> None:
        done.append("ended")

    with caplog.at_level(logging.ERROR):
        await ended([fails, ends])
    assert done == ["ended"]
    assert "the disk is full" in caplog.text
