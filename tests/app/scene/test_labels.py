"""What is written above clusters and trees."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from app.scene import Scene
from app.scene.map import unseen_arcs
from app.scene.nodes import MOST_LABELS, Label, LabelNodes, short
from app.scene.scan import cluster_labels
from tests.app.scene.frames import make_frame, make_trees, texts_of
from tests.pipeline.strategies import trees

PATH = np.zeros((1, 4))


def test_clusters_are_labelled_by_the_ratio_of_eigenvalues_and_trees_by_dbh(scene: Scene):
    frame = make_frame(0, trees=4, clusters=3)
    far = replace(frame.clusters, centroid=frame.clusters.centroid * np.array([4.0, 4.0, 1.0]))
    scene.show(replace(frame, clusters=far), PATH)
    assert {"e 5.0", "e ∞"} <= set(texts_of(scene._scan._labels))
    assert any(re.fullmatch(r"\d+: \d+ cm, e \d+(\.\d)?", text) for text in texts_of(scene._map._labels))
    scene.choose("labels", False)
    assert texts_of(scene._scan._labels) == texts_of(scene._map._labels) == []


def test_a_cluster_at_a_labelled_tree_has_no_label_of_its_own(scene: Scene):
    frame = make_frame(0)
    offset = frame.sensor_offset[:2]
    at = frame.estimate.T_map_base.apply(frame.clusters.centroid[:, :2] + offset)
    trees = make_trees(len(at))
    scene.show(replace(frame, trees=replace(trees, position=at + 0.05)), PATH)
    assert len(texts_of(scene._map._labels)) == len(at)
    assert texts_of(scene._scan._labels) == []


@pytest.mark.parametrize(
    ("label_by", "expected"), [("verdict", "too long"), ("DBH", "30 cm"), ("none", None)]
)
def test_labels_say_what_was_chosen(scene: Scene, label_by: str, expected: str | None):
    scene.show(make_frame(0), PATH)
    scene.choose("label_by", label_by)
    shown = texts_of(scene._scan._labels)
    assert shown == [] if expected is None else expected in shown


def test_trees_come_first_when_there_are_too_many():
    frame = make_frame(0, clusters=200)
    labels = cluster_labels(frame, np.arange(200), "verdict")
    assert len(labels) == MOST_LABELS
    assert {label.text for label in labels} == {"tree"}


async def test_a_label_that_says_the_same_costs_nothing(scene: Scene):
    labels = LabelNodes(scene._server.scene, "/some")
    labels.show([Label(1, "a", (0.0, 0.0, 0.0)), Label(2, "b", (1.0, 0.0, 0.0))])
    before = scene.messages
    labels.show([Label(2, "b", (1.05, 0.0, 0.0)), Label(1, "a", (0.0, 0.05, 0.0))])
    assert scene.messages == before
    labels.show([Label(3, "c", (9.0, 0.0, 0.0))])
    assert texts_of(labels) == ["c"]


@pytest.mark.parametrize(("value", "text"), [(3.2189, "3.2"), (16.457, "16"), (123.4, "100"), (np.inf, "∞")])
def test_figures_that_tremble_are_short(value: float, text: str):
    assert short(value) == text


def test_a_stem_of_another_program_is_labelled_and_drawn_without_eccentricity_and_height(scene: Scene):
    frame = make_frame(0)
    unknown = np.full(len(frame.clusters.size), np.nan)
    extent = np.column_stack([frame.clusters.extent[:, :2], unknown])
    ready = replace(frame.clusters, eccentricity=unknown, extent=extent)
    scene.show(replace(frame, clusters=ready), PATH)
    assert set(texts_of(scene._scan._labels)) == {"tree", "too long"}
    scene.choose("colour_by", "eccentricity")
    fits = scene._server.scene.get_handle_by_name("/world/robot/scan/fits")
    assert fits is not None
    assert np.isfinite(fits.batched_scales).all()  # type: ignore[attr-defined]


def test_the_arcs_of_a_tree_without_a_diameter_are_the_sides_that_were_never_seen():
    seen = (1 << 36) - 1 - (0b111 << 8)  # all but 80 to 110 degrees
    one = replace(trees([[2.0, 1.0]]), sides=np.array([seen]))
    arcs = unseen_arcs(one, np.array([0.3]))
    assert arcs.shape == (3, 2, 3)
    angle = np.degrees(np.arctan2(arcs[:, :, 1] - 1.0, arcs[:, :, 0] - 2.0))
    np.testing.assert_allclose(angle, [[80, 90], [90, 100], [100, 110]], atol=1e-6)
    np.testing.assert_allclose(arcs[:, :, 2], 0.35)
    assert len(unseen_arcs(replace(one, sides=None), np.array([0.0]))) == 0
