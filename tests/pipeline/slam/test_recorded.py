"""Recorded steps in one compiled loop are the steps one by one, to the byte."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from pipeline.config import preset
from pipeline.geometry.gaussian import rows_of
from pipeline.geometry.poses import Pose2
from pipeline.slam import FastSlam
from pipeline.slam.recorded import Recorded, drive
from tests.pipeline.strategies import ALL_FREE, detections

STEPS, JUMP = 60, 35
RADIUS, SIGMA = 6.0, 0.05


def _walk(jump, stuck=()):
    """A circle among trees: what the wheels say of each step, and what is seen after it."""
    random = np.random.default_rng(3)
    trees = random.uniform(-12.0, 12.0, (40, 2))
    pose, steps, seen = Pose2(RADIUS, 0.0, np.pi / 2), [], []
    for t in range(STEPS):
        true = Pose2(*([0.25, 0.0, 0.25 / RADIUS] if t % 7 else [0.0, 0.0, 0.0]))
        if t == JUMP:
            true = Pose2(jump, 0.0, 0.0)
        pose = pose @ true
        told = Pose2(0.25, 0.0, 0.25 / RADIUS) if t == JUMP else Pose2() if t in stuck else true
        steps.append(np.array([told.x * random.normal(1.0, 0.05), told.y, told.yaw]))
        near = pose.inverse().apply(trees)
        near = near[np.hypot(*near.T) < 8.0]
        seen.append(detections(near + random.normal(0.0, SIGMA, near.shape), sigma=SIGMA))
    return steps, seen


def _recorded(steps, seen):
    return Recorded(
        np.array(steps),
        np.concatenate([one.centre for one in seen]),
        np.concatenate([rows_of(one.covariance) for one in seen]),
        np.cumsum([0, *(len(one.centre) for one in seen)]),
        ALL_FREE,
    )


@pytest.mark.parametrize(
    ("changes", "jump", "stuck"),
    [
        ({"particles": 30}, 0.25, ()),
        ({"particles": 30}, 2.0, ()),  # the wheels slip, and the trees put the motion right
        ({"particles": 30}, 0.25, range(40, 52)),
        ({"particles": 7, "weight_power": 1.0}, 0.25, ()),  # resampled often
        ({"particles": 10, "method": "fastslam1", "update_distance": 0.6}, 0.25, ()),
        ({"particles": 10, "update_distance": 0.6}, 0.25, range(20, 30)),
    ],
)
def test_one_loop_is_the_steps_one_by_one(changes, jump, stuck):
    steps, seen = _walk(jump, stuck)
    parameters = preset("forest").slam.model_copy(update=changes)
    single, whole = FastSlam(parameters, 5), FastSlam(parameters, 5)
    estimates = [
        single.process(t, Pose2(*step), one, ALL_FREE)
        for t, (step, one) in enumerate(zip(steps, seen, strict=True))
    ]
    first = drive(whole, 0, _recorded(steps[:25], seen[:25]))
    then = drive(whole, 25, _recorded(steps[25:], seen[25:]))
    told = [np.concatenate(parts) for parts in zip(_columns(first), _columns(then), strict=True)]
    wanted = [
        [[e.T_map_base.x, e.T_map_base.y, e.T_map_base.yaw] for e in estimates],
        [e.n_eff for e in estimates],
    ]
    for column, one_by_one in zip(told, wanted, strict=True):
        assert column.tobytes() == np.array(one_by_one).tobytes()
    assert any(e.resampled for e in estimates) or changes["particles"] > 7
    assert (single.state.recent.distrust > 0.0) == (jump > 1.0 or bool(stuck))
    _same(single, whole)


def _columns(driven):
    return driven.pose, driven.n_eff


def _same(one, other):
    """All that is known is the same but for the memory of the frame, and so is the path."""
    a, b = one.state.copy(), other.state.copy()
    for field in fields(a):
        if field.name not in ("maps", "genealogy", "frame", "shared"):
            was, now = getattr(a, field.name), getattr(b, field.name)
            assert np.asarray(was).tobytes() == np.asarray(now).tobytes() or was == now, field.name
    assert not a.shared.begun, "nothing was measured"
    assert not b.shared.begun
    for name, was, now in zip(a.maps._fields, a.maps, b.maps, strict=True):
        assert was.tobytes() == now.tobytes(), name
    assert one.path().tobytes() == other.path().tobytes()
    assert a.genealogy.distinct_ancestors == b.genealogy.distinct_ancestors
