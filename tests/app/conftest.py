"""What the tests of the web application share."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest_asyncio

from tests.app.server_for_tests import BEARER, Running, running


@pytest_asyncio.fixture
async def both() -> AsyncIterator[Running]:
    """A client that may do all, and the dashboard it talks to."""
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        yield client, dashboard
