"""The health of a run as it is summed up and sent."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from app.batch.summary import JUST_BEGUN, MOST_SPANS, RunHealth, health_word
from app.dashboard.payload import health_payload
from pipeline.types.records import Frame, Health, HealthState
from tests.app import fakes
from tests.app.scene.frames import make_frame


def a_frame(index: int, health: Health) -> Frame:
    """A frame of this health."""
    frame = make_frame(index)
    return replace(frame, estimate=replace(frame.estimate, health=health))


def test_spans_are_scans_after_one_another_in_one_state() -> None:
    words: list[HealthState] = ["good", "weak", "weak", "lost", "good", "weak"]
    run = RunHealth()
    for k, word in enumerate(words):
        run.add(a_frame(k, Health(state=word, reason="" if word == "good" else f"why {k}", n_eff=90.0 - k)))
    record = run.record(0)
    assert record["scans"] == {"good": 2, "weak": 3, "lost": 1}
    assert [s["scans"] for s in record["spans"]] == [[1, 2], [3, 3], [5, 5]]
    assert record["spans"][0]["reason"] == "why 1"
    assert record["spans"][0]["time_s"] == [0.1, 0.2]
    assert record["worst"]["n_eff"] == 85.0
    assert "innovation" not in record["worst"], "never known"
    assert len(run.summary()) == 1


def test_a_long_run_of_changes_is_bounded_and_counted() -> None:
    run = RunHealth()
    for k in range(2 * MOST_SPANS + 10):
        run.add(a_frame(k, Health(state="weak" if k % 2 else "good", reason="why" if k % 2 else "")))
    record = run.record(0)
    assert len(record["spans"]) == MOST_SPANS
    assert record["spans_left_out"] == 5


def test_a_good_run_says_nothing() -> None:
    run = RunHealth()
    run.add(a_frame(0, Health()))
    assert run.summary() == []


def test_the_page_gets_plain_numbers_and_null_for_what_is_not_known() -> None:
    payload = health_payload(Health(sigma_xy=0.12345, innovation=float("nan")))
    assert json.loads(json.dumps(payload, allow_nan=False)) == payload
    assert payload["innovation"] is None
    assert payload["sigma_xy_m"] == 0.123
    assert (payload["state"], payload["reason"]) == ("good", "")


@pytest.mark.parametrize(
    ("index", "trees", "state", "word"),
    [
        (500, 0, "good", "no trees yet"),
        (JUST_BEGUN - 1, 3, "good", "just begun"),
        (JUST_BEGUN, 3, "good", "good"),
        (2, 0, "lost", "lost"),
        (500, 3, "weak", "weak"),
    ],
)
def test_nothing_is_called_good_before_there_is_a_map_that_could_be(
    index: int, trees: int, state: HealthState, word: str
) -> None:
    shot = a_frame(index, Health(state=state))
    confirmed = np.ones(trees, np.bool_)
    assert health_word(replace(shot, trees=replace(fakes.trees(trees), confirmed=confirmed))) == word
    assert health_word(None) == "no scan yet"


def test_the_pose_of_a_sensor_that_has_not_moved_is_not_called_good() -> None:
    frame = a_frame(JUST_BEGUN, Health(state="good"))
    assert (health_word(frame, 0.02), health_word(frame, 0.5)) == ("static", "good")
    assert health_word(a_frame(JUST_BEGUN, Health(state="lost")), 0.0) == "lost"
