"""Where other decision trees took what ends in free air for a pole, the story says so, and by what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.explain import build
from pipeline.classification.features import COUNT, NAMES
from pipeline.classification.forest import CLASSES, FREE_END, ONE_WAY, Forest, forest_of, vote
from pipeline.config import preset
from pipeline.types.records import Columns, Verdict
from tests.app.scene.frames import make_frame

TREE, POLE = {"share": [1.0, 0, 0, 0, 0, 0]}, {"share": [0, 1.0, 0, 0, 0, 0]}
THICK = NAMES.index("thick")


def asked() -> Forest:
    """Says tree of all, and of what ends in free air pole where it is thin."""
    by_width = {"figure": "thick", "at_most": 0.05, "yes": POLE, "no": TREE}
    data = {"classes": [kind.label for kind in CLASSES], ONE_WAY: [TREE], FREE_END: [by_width]}
    return forest_of(data, ONE_WAY)


def column(forest: Forest, top: float, thick: float) -> Columns:
    figures = np.zeros((1, COUNT))
    figures[0, NAMES.index("highest return")] = top
    figures[0, NAMES.index("free above the highest return")] = 2.0
    figures[0, THICK] = thick
    share = vote(figures, forest)
    verdict = np.array([CLASSES[int(share[0].argmax())]], np.int32)
    rays = np.zeros((1, 1), np.int32)
    return Columns(
        np.zeros((1, 2), np.int64), np.zeros((1, 5)), np.full(1, 6.0), np.full(1, 4.0),
        np.zeros(1), np.zeros(1), rays, rays, figures, share, verdict,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("top", "thick", "share", "verdict", "told"),
    [(3.0, 0.02, 0.0, "pole", ["thick"]), (3.0, 0.2, 1.0, "tree", []), (1.5, 0.02, None, "tree", [])],
)
def test_a_pole_in_free_air_is_told_by_the_trees_that_took_it_for_one(
    monkeypatch: pytest.MonkeyPatch,
    top: float,
    thick: float,
    share: float | None,
    verdict: str,
    told: list[str],
) -> None:
    forest = asked()
    monkeypatch.setattr(build, "kept_forests", lambda: lambda _name, _all_around: forest)
    frame = replace(make_frame(), columns=column(forest, top, thick))
    story = build.column_story(frame, np.zeros(2), preset("forest"), False)
    assert story is not None
    assert (story.tree_in_free_air, story.verdict) == (share, verdict)
    assert [figure.figure for figure in story.effects] == told
    assert all(figure.effect < 0.0 for figure in story.effects)
    assert story.verdict == Verdict.POLE.label or story.votes["tree"] == 1.0
