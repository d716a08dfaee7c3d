"""Each question gets its own answer, or words why not."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from app.explain.questions import NoStoryError, Questions
from app.explain.recent_scans import Recent
from app.worker.internal_protocol import Answer
from tests.app.explain.stories import cluster_story, tree_story
from tests.app.fakes import frame


async def test_answers_find_who_asked_in_any_order():
    asked: list[Any] = []

    async def send(question: Any) -> None:
        asked.append(question)

    questions = Questions(send)
    first = asyncio.create_task(questions.tree(1, 7))
    second = asyncio.create_task(questions.cluster(1, 5, 2))
    await asyncio.sleep(0)
    questions.take(Answer(asked[1].ticket, cluster=cluster_story(scan=5, cluster=2)))
    questions.take(Answer(asked[0].ticket, tree=tree_story(7)))
    questions.take(Answer(999, tree=tree_story(8)))  # of nobody
    assert (await first).tree == 7
    assert ((await second).scan, (await second).cluster) == (5, 2)


async def test_a_refusal_and_silence_are_told_in_words():

    async def refuse(question: Any) -> None:
        questions.take(Answer(question.ticket, missing="gone"))

    questions = Questions(refuse)
    with pytest.raises(NoStoryError, match="gone"):
        await questions.tree(1, 7)

    async def swallow(_question: Any) -> None: ...

    silent = Questions(swallow, patience_s=0.01)
    with pytest.raises(NoStoryError, match="busy"):
        await silent.cluster(1, 0, 0)
    assert silent._waiting == {}


def test_of_the_pictures_the_newest_are_kept_without_their_raw_points():
    recent = Recent()
    for index in range(100):
        recent.keep(1, frame(index, index))
    assert recent.find(1, 10) is None
    assert recent.find(2, 99) is None
    kept = recent.find(1, 99)
    assert kept is not None
    assert len(kept.raw) == 0
    assert len(kept.filtered) > 0
