"""Means, the best sets, and what is told of them."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from app.extensions.search.jobs import JobResult
from app.extensions.search.report import (
    CRITERIA,
    MOST_LINES,
    Comparison,
    SweepPlan,
    best_of,
    compare_results,
    files,
    json_text,
    lines,
    page,
)
from app.extensions.search.scoring import PreparedRun
from pipeline.config.model import Value
from tests.app.extensions.search.jobs import job, scores

EVIL = "<script>alert(1)</script>\x1b[31m"


@pytest.fixture
def comparison() -> Comparison:
    """Three sets on two runs; the last failed on one of them, one has a name that would do harm."""
    values = (0.1, 0.2, 0.3)
    sets: tuple[dict[str, Value], ...] = tuple({"clustering.eps": eps} for eps in values)
    runs = (PreparedRun("first", job(0.1).run, "forest"), PreparedRun(EVIL, job(0.1).run, "forest"))
    jobs = {(s, r): job(values[s], seed=r) for s in range(3) for r in range(2)}
    answers = {
        (0, 0): JobResult(scores(0.8, found=3), seconds=2.0, looked=True),
        (0, 1): JobResult(scores(0.6, found=2), seconds=1.0),
        (1, 0): JobResult(scores(0.9, found=4, wrong=2), seconds=2.0),
        (1, 1): JobResult(scores(None, found=4), seconds=2.0),
        (2, 0): JobResult(scores(1.0), seconds=2.0),
        (2, 1): JobResult(None, error="the disk is full"),
    }
    return compare_results(SweepPlan(runs, sets, jobs, {}), answers)


def test_counts_are_added_up_and_all_else_is_the_mean(comparison):
    mean = comparison.means[0].figures
    assert (mean["TA"], mean["TA_of"], mean["f1"]) == (5, 8, pytest.approx(0.7))
    assert comparison.means[1].figures["f1"] == pytest.approx(0.9), "of the run that tells it"
    assert comparison.means[0].seconds == pytest.approx(3.0)


def test_a_set_that_failed_somewhere_is_best_at_nothing(comparison):
    assert comparison.means[2].error == "the disk is full"
    assert comparison.best["F1"] == 2
    assert comparison.best["fewest false trees, then most true ones"] == 1
    assert 3 not in comparison.best.values()


def test_sets_that_are_alike_in_a_goal_have_no_best(comparison):
    figures = comparison.means[1].figures
    alike = [replace(row, figures=figures, error="") for row in comparison.means[:2]]
    goal = CRITERIA["F1"]
    assert best_of(alike, goal) == 0
    assert best_of(alike[:1], goal) == alike[0].set_number
    told = lines(replace(comparison, best=dict.fromkeys(comparison.best, 0)))
    assert "best F1: none; all sets are equal or unknown" in told


def test_sets_as_good_as_the_best_are_named(comparison):
    best, other = comparison.means[1], comparison.means[0]
    means = (replace(best, set_number=1), replace(other, set_number=2), replace(best, set_number=3))
    told = lines(replace(comparison, means=means, best=dict.fromkeys(comparison.best, 1)))
    assert any(
        line.startswith("best F1: set 1") and line.endswith(", equal to 1 other set: 3") for line in told
    )
    assert best_of(means, CRITERIA["F1"]) == 1


def test_the_tables_hold_every_row(comparison, tmp_path):
    names = files(comparison, tmp_path / "out")
    assert sorted(names) == sorted(file.name for file in (tmp_path / "out").iterdir())
    rows = list(csv.DictReader(io.StringIO((tmp_path / "out" / "results.csv").read_text())))
    assert [(row["set"], row["run"], row["clustering.eps"]) for row in rows[:3]] == [
        ("1", "1", "0.1"), ("1", "2", "0.1"), ("2", "1", "0.2"),
    ]  # fmt: skip
    assert (rows[0]["f1"], rows[3]["f1"], rows[5]["error"]) == ("0.8", "", "the disk is full")
    told = json.loads((tmp_path / "out" / "results.json").read_text())
    assert len(told["results"]) == 6
    assert told["best"] == comparison.best
    assert "seconds" not in json_text(comparison)


def test_the_terminal_shows_each_set_and_the_best(comparison):
    told = lines(comparison)
    assert sum("clustering.eps=0.2" in line for line in told) >= 3
    assert any("failed: the disk is full" in line for line in told)
    assert any(line.startswith("best F1: set 2") for line in told)


class Tags(HTMLParser):
    """Collects the tags of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [str(value) for name, value in attrs if name in ("src", "href")]


def test_the_page_stands_alone_and_texts_are_texts(comparison):
    tags = Tags()
    tags.feed(page(comparison))
    assert tags.tags.count("tr") == 3 * 4
    assert "svg" in tags.tags
    assert "script" not in tags.tags
    assert tags.addresses == []


def test_a_spreadsheet_computes_no_name(comparison, tmp_path):
    runs = tuple(
        replace(run, name=name) for run, name in zip(comparison.plan.runs, ("=1+1", "-2"), strict=True)
    )
    files(replace(comparison, plan=replace(comparison.plan, runs=runs)), tmp_path)
    with (tmp_path / "results.csv").open() as file:
        assert {row["source"] for row in csv.DictReader(file)} == {"'=1+1", "'-2"}


def test_a_set_without_a_right_tree_comes_before_one_that_failed():
    values = tuple(0.01 * (k + 1) for k in range(MOST_LINES + 1))
    sets: tuple[dict[str, Value], ...] = tuple({"clustering.eps": eps} for eps in values)
    run = PreparedRun("first", job(0.1).run, "forest")
    jobs = {(s, 0): job(eps) for s, eps in enumerate(values)}
    answers = {(s, 0): JobResult(scores(0.5), seconds=1.0) for s in range(MOST_LINES - 1)}
    answers[MOST_LINES - 1, 0] = JobResult(None, error="the disk is full")
    answers[MOST_LINES, 0] = JobResult(scores(0.0), seconds=1.0)
    text = "\n".join(lines(compare_results(SweepPlan((run,), sets, jobs, {}), answers)))
    assert "the disk is full" not in text
    assert f"{values[-1]:g}" in text
