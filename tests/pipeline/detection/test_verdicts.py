"""Verdicts: each reason is reachable, the first failed check decides, and each cluster keeps its row."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import PRESETS, Parameters, preset
from pipeline.detection.verdicts import checks, classify_clusters, detections
from pipeline.types.records import Clusters, Verdict
from tests.pipeline.strategies import clusters

FOREST = preset("forest").detection
PAPER = preset("paper").detection

REASONS: list[tuple[Verdict, dict[str, Any]]] = [
    (Verdict.TREE, {}),
    (Verdict.HIDDEN, {"hidden": [True]}),
    (Verdict.TOO_THICK, {"extent": [[0.2, 1.3, 1.0]]}),
    (Verdict.TOO_THICK, {"extent": [[1.3, 0.2, 1.0]]}),
    (Verdict.TOO_THICK, {"radius": [0.7]}),
    (Verdict.TOO_LOW, {"extent": [[0.2, 0.4, 0.4]]}),
    (Verdict.AT_BORDER, {"cut": [True]}),
    (Verdict.TOO_LONG, {"eccentricity": [61.0]}),
    (Verdict.TOO_LONG, {"eccentricity": [np.inf]}),
    (Verdict.NOT_ROUND, {"radial_std": [0.07]}),
    (Verdict.NO_ARC, {"arc": [0.5]}),
    (Verdict.TOO_THIN, {"radius": [0.03]}),
]


@pytest.mark.parametrize(("verdict", "columns"), REASONS, ids=lambda v: getattr(v, "label", str(v)))
def test_each_reason_is_reached(verdict, columns):
    assert classify_clusters(clusters(**columns), FOREST).verdict.tolist() == [verdict]


def test_too_round_is_reached_by_the_preset_of_the_text():
    p = preset("paper-text").detection
    assert classify_clusters(clusters(eccentricity=[9.9]), p).verdict.tolist() == [Verdict.TOO_ROUND]
    assert classify_clusters(clusters(eccentricity=[10.0]), p).verdict.tolist() == [Verdict.TREE]


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("eccentricity", FOREST.e_max),
        ("radial_std", FOREST.cylindrical_stddev_thresh),
        ("radius", FOREST.radius_min),
        ("radius", FOREST.radius_max),
        ("arc", np.radians(FOREST.arc_min)),
    ],
)
def test_a_figure_on_its_bound_is_still_a_tree(column, value):
    assert classify_clusters(clusters(**{column: [value]}), FOREST).verdict.tolist() == [Verdict.TREE]


def test_the_first_reason_in_the_order_wins():
    worst = clusters(
        hidden=[True], extent=[[9, 9, 0]], eccentricity=[999.0], radial_std=[9.0], arc=[0.0], radius=[9.0]
    )
    assert classify_clusters(worst, FOREST).verdict.tolist() == [Verdict.HIDDEN]
    seen = clusters(extent=[[0.2, 0.4, 0]], eccentricity=[999.0], radial_std=[9.0], arc=[0.0])
    assert classify_clusters(seen, FOREST).verdict.tolist() == [Verdict.TOO_LOW]


def test_without_a_circle_its_figures_are_not_asked_for():
    no_circle = clusters(radius=[np.nan], radius_sigma=[np.nan], arc=[0.0])
    assert classify_clusters(no_circle, FOREST).verdict.tolist() == [Verdict.TREE]


def test_the_paper_keeps_by_eccentricity_and_radial_deviation_alone():
    thing = clusters(
        extent=[[0.5, 2.0, 0.1]],
        radius=[np.nan],
        radius_sigma=[np.nan],
        arc=[0.0],
        eccentricity=[19.9],
        cut=[True],
    )
    assert classify_clusters(thing, PAPER).verdict.tolist() == [Verdict.TREE]
    for column, value, verdict in (
        ("eccentricity", 20.1, Verdict.TOO_LONG),
        ("radial_std", 0.11, Verdict.NOT_ROUND),
    ):
        assert classify_clusters(clusters(**{column: [value]}), PAPER).verdict.tolist() == [verdict]


def _many():
    columns = [clusters(**columns) for _, columns in REASONS]
    return Clusters(
        *(np.concatenate([getattr(c, name) for c in columns]) for name in Clusters.__dataclass_fields__)
    )


def test_nothing_is_dropped_and_nothing_left_open():
    many = _many()
    judged = classify_clusters(many, FOREST)
    assert len(judged.verdict) == len(many.size)
    assert judged.verdict.tolist() == [verdict for verdict, _ in REASONS]
    np.testing.assert_array_equal(judged.centre, many.centre)


def test_detections_are_the_trees_in_the_base_frame():
    judged = classify_clusters(_many(), FOREST)
    found = detections(judged, np.array([0.3, -0.2, 0.8]), FOREST)
    assert found.cluster.tolist() == [0]
    np.testing.assert_allclose(found.centre, [[4.5, -0.2]])
    assert found.radius.tolist() == [0.2]


@pytest.mark.parametrize("bearing", [0.0, 1.1, -2.5])
def test_the_error_of_the_sensor_lies_along_and_across_the_ray(bearing):
    ray = np.array([np.cos(bearing), np.sin(bearing)])
    across = np.array([-ray[1], ray[0]])
    judged = classify_clusters(clusters(centre=[5.0 * ray], covariance=[np.eye(2) * 1e-4]), FOREST)
    R = detections(judged, np.zeros(3), FOREST).covariance[0]
    assert ray @ R @ ray == pytest.approx(1e-4 + FOREST.sigma_range**2)
    assert across @ R @ across == pytest.approx(1e-4 + (5.0 * np.radians(FOREST.sigma_bearing)) ** 2)
    assert ray @ R @ across == pytest.approx(0.0, abs=1e-12)


def test_a_tree_without_a_circle_gives_no_radius():
    judged = classify_clusters(clusters(radius=[np.nan], radius_sigma=[np.nan]), FOREST)
    assert np.isnan(detections(judged, np.zeros(3), FOREST).radius).all()


def test_no_clusters_give_no_detections():
    none = Clusters(*(getattr(_many(), name)[:0] for name in Clusters.__dataclass_fields__))
    assert len(detections(classify_clusters(none, FOREST), np.zeros(3), FOREST).cluster) == 0


def test_what_a_missing_part_changes_is_asked_after_the_border():
    cut = clusters(cut=[True], eccentricity=[999.0], radial_std=[9.0], arc=[0.0], radius=[9.0])
    assert classify_clusters(cut, FOREST).verdict.tolist() == [Verdict.AT_BORDER]
    assert classify_clusters(clusters(cut=[True], extent=[[0.2, 1.3, 1.0]]), FOREST).verdict.tolist() == [
        Verdict.TOO_THICK
    ]


@pytest.mark.parametrize(("verdict", "columns"), REASONS, ids=lambda v: getattr(v, "label", str(v)))
def test_each_check_holds_its_value_against_its_limit(verdict, columns):
    table = clusters(**columns)
    for check in checks(table, FOREST):
        (value,) = check.value
        if check.relation:
            assert check.limit == Parameters().flat()[check.parameter]
            fails = value > check.limit if check.relation == "at most" else value < check.limit
        else:
            fails = value != 0.0
        assert check.fails.tolist() == [bool(fails)]
    failing = [check.verdict for check in checks(table, FOREST) if check.fails[0]]
    assert [verdict] == (failing[:1] or [Verdict.TREE])


def test_without_a_circle_nothing_is_asked_of_it():
    table = clusters(radius=[np.nan], arc=[0.0])
    untold = [check for check in checks(table, FOREST) if np.isnan(check.value[0])]
    assert [check.figure for check in untold] == ["visible arc", "radius", "radius"]
    assert not any(check.fails[0] for check in untold)


figures = st.one_of(st.floats(0.0, 5.0), st.just(np.nan), st.just(np.inf))


@given(
    st.lists(figures, min_size=6, max_size=6), st.booleans(), st.booleans(), st.sampled_from(sorted(PRESETS))
)
def test_the_checks_decide_as_the_judge_does(row, hidden, cut, name):
    along, up, eccentricity, radial_std, radius, arc = row
    table = clusters(
        extent=[[along, 0.1, up]],
        eccentricity=[20.0 * eccentricity],
        radial_std=[0.05 * radial_std],
        radius=[0.3 * radius],
        arc=[arc],
        hidden=[hidden],
        cut=[cut],
    )
    p = preset(name).detection
    failing = [check.verdict for check in checks(table, p) if check.fails[0]]
    assert classify_clusters(table, p).verdict.tolist() == (failing[:1] or [Verdict.TREE])
