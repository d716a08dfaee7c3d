"""Requests to the worker: each one gets its own answer, or an error with a reason."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from app.dashboard.selection import NoStoryError, WorkerClient
from app.worker.protocol import Answer, WorkerBusyError
from tests.app.explain.stories import cluster_story, tree_story


async def test_answers_in_any_order_reach_their_requests():
    asked: list[Any] = []

    async def send(question: Any) -> None:
        asked.append(question)

    client = WorkerClient(send, lambda: 1)
    first = asyncio.create_task(client.tree(7))
    second = asyncio.create_task(client.cluster(5, 2))
    await asyncio.sleep(0)
    client.take(Answer(asked[1].ticket, cluster=cluster_story(scan=5, cluster=2)))
    client.take(Answer(asked[0].ticket, tree=tree_story(7)))
    client.take(Answer(999, tree=tree_story(8)))  # answers no request
    assert (await first).tree == 7
    assert ((await second).scan, (await second).cluster) == (5, 2)


async def test_a_refusal_and_a_missing_answer_raise_an_error_with_the_reason():

    async def refuse(question: Any) -> None:
        client.take(Answer(question.ticket, missing="gone"))

    client = WorkerClient(refuse, lambda: 1)
    with pytest.raises(NoStoryError, match="gone"):
        await client.tree(7)

    async def swallow(_question: Any) -> None: ...

    silent = WorkerClient(swallow, lambda: 1, patience_s=0.01)
    with pytest.raises(WorkerBusyError, match="busy"):
        await silent.cluster(0, 0)
    assert silent._waiting == {}


async def test_without_a_run_there_is_no_story():

    async def send(_question: Any) -> None:
        raise AssertionError("nothing must be sent")

    with pytest.raises(NoStoryError, match="nothing is mapped"):
        await WorkerClient(send, lambda: None).tree(7)
