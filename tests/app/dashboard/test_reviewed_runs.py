"""The reviews of a stored map by the annotations of its recording."""

from __future__ import annotations

from app.dashboard.run_recorder import _reviews
from app.store.records import Content
from pipeline.io.result_files import REJECTED


def test_a_whole_cloud_is_reviewed_in_the_frame_of_its_map() -> None:
    trees = [{"number": 1, "x": 470602.5, "y": 3810202.5}, {"number": 2, "x": 470610.0, "y": 3810202.5}]
    stored = {"trees": trees, "offset": [470600.0, 3810200.0]}
    assert _reviews(stored, [Content(2.5, 2.5, "pole")])[1] == REJECTED
    assert (
        _reviews({"trees": [{"number": 1, "x": 2.5, "y": 2.5}]}, [Content(2.5, 2.5, "pole")])[1] == REJECTED
    )
