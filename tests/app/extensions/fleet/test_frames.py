"""Which maps of a fleet share a frame, and when another try is worth its cost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import app.extensions.fleet.fleet as module
from app.extensions.fleet.fleet import LEAST_TREES, MORE_TREES, Frames
from pipeline.geometry.poses import Pose2

STEMS = np.random.default_rng(3).uniform(-15.0, 15.0, (30, 2))


def shown(places: np.ndarray) -> dict[str, Any]:
    rows = [
        {"x": float(x), "y": float(y), "ellipse": [0.03, 0.03, 0.0], "dbh_cm": None, "sigma_dbh_cm": None}
        for x, y in places
    ]
    return {"trees": rows}


@pytest.mark.slow
async def test_a_map_is_laid_on_the_first_one_by_its_stems():
    T = Pose2(4.0, -3.0, 1.1)
    maps = {"a": ("one", shown(STEMS)), "b": ("two", shown(T.inverse().apply(STEMS[4:])))}
    frames = Frames()
    assert await frames.try_one(maps)
    assert frames.pose("a") == Pose2()
    found = frames.pose("b")
    assert found is not None
    np.testing.assert_allclose(found.as_array(), T.as_array(), atol=1e-3)
    assert frames.how("b").endswith("26 stems of a")
    assert not await frames.try_one(maps), "what is known is not asked again"
    strange = {**maps, "b": ("three", shown(np.random.default_rng(4).uniform(-15.0, 15.0, (30, 2))))}
    assert await frames.try_one(strange), "another source, another frame"
    assert frames.pose("b") is None
    assert "do not agree" in frames.how("b")


async def test_a_try_waits_for_more_trees(monkeypatch: pytest.MonkeyPatch):
    asked: list[int] = []

    async def refused(_a: dict[str, Any], b: dict[str, Any]) -> tuple[None, str]:
        asked.append(len(b["trees"]))
        return None, "too few stems"

    monkeypatch.setattr(module, "_aligned", refused)
    frames = Frames()
    for count in range(1, 20):
        await frames.try_one({"a": ("one", shown(STEMS)), "b": ("two", shown(STEMS[:count]))})
    assert asked == list(range(LEAST_TREES, 20, MORE_TREES))


async def test_the_same_recording_shares_its_frame_and_a_first_that_leaves_ends_it():
    maps = {"a": ("one", shown(STEMS)), "b": ("one", shown(STEMS[:1]))}
    frames = Frames()
    assert not await frames.try_one(maps)
    assert frames.pose("b") == Pose2()
    assert not await frames.try_one({"a": ("other", shown(STEMS[:1])), "b": maps["b"]})
    assert frames.pose("a") is frames.pose("b") is None
    assert "too few trees" in frames.how("a")
    assert frames.how("c") == "its frame is not known yet", "nobody has counted its trees"


@pytest.mark.parametrize("trees", [1, 30])
async def test_the_same_recording_is_left_when_another_source_is_opened(
    trees: int, monkeypatch: pytest.MonkeyPatch
):
    async def refused(_a: dict[str, Any], _b: dict[str, Any]) -> tuple[None, str]:
        return None, "other stems"

    monkeypatch.setattr(module, "_aligned", refused)
    maps = {"a": ("one", shown(STEMS)), "b": ("one", shown(STEMS))}
    frames = Frames()
    await frames.try_one(maps)
    assert "same recording" in frames.how("b")
    other = np.random.default_rng(4).uniform(-15.0, 15.0, (trees, 2))
    assert await frames.try_one({**maps, "b": ("two", shown(other))}) == (trees >= LEAST_TREES)
    assert frames.pose("b") is None
    assert "same recording" not in frames.how("b")
