"""Heights of trees in closed form: seen tops, and the reasons why others are not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.extensions.clouds.inventory import Inventory, map_plot
from app.extensions.clouds.inventory.spooled_cloud import SpooledCloud
from app.sources.one_step import finish
from pipeline.config import preset
from tests.app.extensions.clouds.made import Made
from tests.pipeline.plots import ground, stem

FOREST = preset("forest")
TOP = 12.0  # m


def crown(x, y, rng, *, base=5.0, top=TOP, radius=1.2, points=6000):
    """Points in a cone with its tip at height `top`."""
    h = rng.uniform(base, top, points)
    r = radius * (top - h) / (top - base) * np.sqrt(rng.uniform(0.0, 1.0, points))
    a = rng.uniform(0.0, 2.0 * np.pi, points)
    return np.column_stack([x + r * np.cos(a), y + r * np.sin(a), h])


def tree(x, y, rng, top=TOP):
    """A tree on ground at height 0."""
    trunk = stem(x, y, 0.14, rng, height=6.0, sigma=0.003)
    trunk[:, 2] -= trunk[:, 2].min()
    return np.concatenate([trunk, crown(x, y, rng, top=top)])


def flat(side, rng):
    points = ground(side, 0.05, rng)
    points[:, 2] = np.abs(np.random.default_rng(1).normal(0.0, 0.01, len(points)))
    return points


def mapped(parts):
    return map_plot(Made(np.concatenate(parts)), FOREST)


def test_the_heights_of_trees_with_visible_tops_agree_with_their_sigmas():
    rng = np.random.default_rng(2)
    tops = (10.0, 12.0, 9.0, 14.0)
    places = ((3.0, 3.0), (9.0, 3.0), (3.0, 9.0), (9.0, 9.0))
    m = mapped([flat(12.0, rng), *(tree(x, y, rng, top) for (x, y), top in zip(places, tops, strict=True))])
    assert len(m.trees.number) == 4
    assert m.trees.height is not None
    assert m.trees.height_sigma is not None
    true = [
        tops[int(np.argmin([np.hypot(*(at - place)) for place in np.array(places)]))]
        for at in m.trees.position
    ]
    off = m.trees.height - np.array(true)
    assert np.abs(off).max() < 0.3
    assert np.abs(off / m.trees.height_sigma).max() < 4.0
    assert m.crowns.hidden == ("",) * 4


def test_each_point_of_two_crowns_belongs_to_its_tree():
    rng = np.random.default_rng(3)
    m = mapped([flat(12.0, rng), tree(3.5, 6.0, rng), tree(8.5, 6.0, rng)])
    high = m.whole[:, 3] > 1.0
    expected = (m.whole[:, 0] > 6.0).astype(int)
    assert np.array_equal(m.crowns.tree[high], expected[high])
    assert (m.crowns.tree[m.whole[:, 3] < 0.2] == -1).all()


@pytest.mark.slow_after(2)
@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("cut off at its top", lambda points: points[points[:, 2] < 8.0]),
        ("another crown continues above", lambda points: np.vstack([points, roof()])),
        ("not connected with it", lambda points: np.vstack([points, *broken_top()])),
        ("border of the plot", lambda points: points[points[:, 0] < 6.2]),
        ("ends abruptly", lambda points: np.vstack([points[~above_middle(points)], twigs()])),
        (
            "ground at the stem",
            lambda points: points[(points[:, 2] > 0.1) | ~in_middle(points, 2.0)],
        ),
    ],
)
def test_a_height_that_is_not_seen_has_a_reason_and_no_number(reason, change):
    rng = np.random.default_rng(4)
    others = [tree(x, y, rng) for x, y in ((2.0, 2.0), (2.0, 10.0), (10.0, 2.0), (10.0, 10.0))]
    m = mapped([change(np.concatenate([flat(12.0, rng), tree(6.0, 6.0, rng), *others]))])
    row = int(np.argmin(np.hypot(*(m.trees.position - 6.0).T)))
    assert np.hypot(*(m.trees.position[row] - 6.0)) < 0.1
    assert reason in m.crowns.hidden[row]
    assert np.isnan(m.trees.height[row])
    assert np.isnan(m.trees.height_sigma[row])


def in_middle(points, reach):
    """Whether each point is near the tree in the middle."""
    return np.hypot(*(points[:, :2] - 6.0).T) < reach


def above_middle(points):
    """Whether each point is in the upper part of the tree in the middle."""
    return in_middle(points, 3.0) & (points[:, 2] > 5.0)


def twigs():
    """Branches at the stem of the tree in the middle."""
    rng = np.random.default_rng(8)
    return rng.normal((6.0, 6.0, 4.5), (0.5, 0.5, 0.3), (1500, 3))


def roof():
    """A layer of leaves above the tree in the middle, one metre above its tip."""
    rng = np.random.default_rng(5)
    return rng.uniform((5.0, 5.0, TOP + 1.0), (7.0, 7.0, TOP + 1.5), (3000, 3))


def broken_top():
    """Broad branches of the tree in the middle, and its top aside of its stem, above a gap."""
    rng = np.random.default_rng(9)
    branches = rng.uniform((4.8, 4.8, TOP - 1.5), (7.2, 7.2, TOP - 0.5), (6000, 3))
    return branches, rng.uniform((6.8, 5.8, TOP + 0.3), (7.2, 6.2, TOP + 0.8), (50, 3))


@pytest.mark.parametrize("gap", [0.2, 0.45])
def test_the_sigma_of_a_height_contains_the_largest_gap_between_the_highest_returns(gap):
    rng = np.random.default_rng(10)
    single = [[4.0, 4.0, TOP + gap]]
    m = mapped([flat(8.0, rng), tree(4.0, 4.0, rng), single])
    assert m.trees.height is not None
    assert m.trees.height_sigma is not None
    assert m.trees.height[0] == pytest.approx(TOP + gap, abs=0.05)
    assert gap <= m.trees.height_sigma[0] < gap + 0.15


def test_steps_report_progress_and_may_be_left_and_begun_again():
    rng = np.random.default_rng(6)
    points = np.concatenate([flat(8.0, rng), tree(4.0, 4.0, rng)])
    inventory = Inventory(Made(points, part=2000))
    steps = inventory.steps(FOREST)
    shares = [next(steps) for _ in range(12)]
    assert shares == sorted(shares)
    steps.close()
    again = finish(inventory.steps(FOREST))
    other = finish(inventory.steps(FOREST.replace({"detection.radius_min": 0.2})))
    back = finish(inventory.steps(FOREST))
    once = map_plot(Made(points), FOREST)
    inventory.close()
    assert len(again.trees.number) == 1
    assert len(other.trees.number) == 0
    for m in (back, once):
        assert np.array_equal(m.trees.position, again.trees.position)
        assert np.array_equal(m.crowns.height, again.crowns.height, equal_nan=True)


class Counting(Made):
    """A cloud that counts how often it is read."""

    read = 0

    def parts(self):
        self.read += 1
        yield from super().parts()


def test_a_spooled_cloud_is_read_once_and_gives_the_same_points():
    points = np.random.default_rng(7).uniform(0.0, 9.0, (70_000, 3))
    cloud = Counting(points)
    spooled = SpooledCloud(cloud)
    first, second = (np.concatenate(list(spooled.parts())) for _ in range(2))
    assert np.array_equal(first, points.astype(np.float32))
    assert np.array_equal(first, second)
    assert cloud.read == 1
    spooled.close()


class MadeOfDrive(Made):
    """The cloud of a drive."""

    @property
    def description(self):
        return replace(super().description, cut_above=True)


def test_the_cloud_of_a_drive_gives_no_heights():
    rng = np.random.default_rng(2)
    found = map_plot(MadeOfDrive(np.concatenate([flat(8.0, rng), tree(4.0, 4.0, rng)])), FOREST)
    assert len(found.trees.number) == 1
    assert found.trees.height is not None
    assert np.isnan(found.trees.height).all()
    assert "field of view" in found.crowns.hidden[0]
