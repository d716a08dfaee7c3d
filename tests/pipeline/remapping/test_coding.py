"""What is laid out for a packer comes back to the bit, on a grid or not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.quantisation import POINT, rounded
from pipeline.remapping.coding import (
    Cutter,
    heights_coded,
    heights_from,
    image_coded,
    image_from,
    places_coded,
    places_from,
    row_coded,
    row_from,
)

COUNTS = st.integers(0, 60)
SEEDS = st.integers(0, 1 << 30)


@settings(max_examples=60, deadline=None)
@given(COUNTS, SEEDS, st.sampled_from([0.01, 3.0, 5e6]), st.booleans())
def test_places_come_back(count, seed, spread, on_grid):
    rng = np.random.default_rng(seed)
    columns = rng.normal(0.0, spread, (count, 3)).astype(np.float32)
    if on_grid:
        columns = rounded(columns, POINT)
    told = places_coded(columns[:, :2], columns[:, 2], POINT)
    points, height = places_from(Cutter(bytearray(told)), count, POINT)
    assert points[:, :2].tobytes() == columns[:, :2].tobytes()
    assert not points[:, 2].any()
    assert height.tobytes() == columns[:, 2].tobytes()


@pytest.mark.parametrize("odd", [np.nan, np.inf, -0.0, 1e30, 0.001])
def test_what_lies_on_no_grid_comes_back_too(odd):
    height = np.zeros((4, 6))
    height[1, 2] = odd
    again = heights_from(Cutter(bytearray(heights_coded(height, POINT))), 4, 6, POINT)
    assert again.tobytes() == height.tobytes()


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.floats(0.0, 1.0), st.sampled_from([0, 5, 65535]))
def test_heights_rows_and_images_come_back(seed, share, largest):
    rng = np.random.default_rng(seed)
    height = rounded(rng.normal(0.0, 2.0, (7, 5)), POINT)
    again = heights_from(Cutter(bytearray(heights_coded(height, POINT))), 7, 5, POINT)
    assert again.tobytes() == height.tobytes()
    image = np.where(rng.random((9, 4)) < share, rng.integers(0, largest + 1, (9, 4)), 0).astype(np.uint16)
    assert image_from(Cutter(bytearray(image_coded(image))), 9, 4).tobytes() == image.tobytes()
    row = rng.choice([np.inf, 0.0, -0.0, np.nan, rng.random()], 20)
    assert row_from(Cutter(bytearray(row_coded(row))), 20).tobytes() == row.tobytes()


def test_neighbours_make_a_turning_sensor_small():
    """Two walls of sixteen rings, 30 mm of noise: half of what single differences take, and less."""
    rng = np.random.default_rng(0)
    angle = np.repeat(np.arange(400) * 0.0035, 16)
    reach = np.where(np.arange(6400) % 16 < 8, 6.0, 14.0) + rng.normal(0.0, 0.03, 6400)
    columns = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.tile(np.arange(16) * 0.3, 400)], 1)
    columns = rounded(columns.astype(np.float32), POINT)
    import zstandard

    size = len(zstandard.compress(places_coded(columns[:, :2], columns[:, 2], POINT), 1))
    assert size < 6400 * 2.5


def test_what_is_cut_or_has_no_neighbour_is_refused():
    columns = rounded(np.random.default_rng(0).normal(0.0, 1.0, (9, 3)).astype(np.float32), POINT)
    told = places_coded(columns[:, :2], columns[:, 2], POINT)
    with pytest.raises(ValueError, match="buffer"):
        places_from(Cutter(bytearray(told[:-1])), 9, POINT)
    with pytest.raises(ValueError, match="neighbour"):
        places_from(Cutter(bytearray(told[:-1] + b"\x7f")), 9, POINT)
    with pytest.raises(ValueError, match="first"):
        row_from(Cutter(bytearray(b"\0" * 9)), 5)


@pytest.mark.parametrize("block", [b"", b"no Zstandard at all"])
def test_a_block_that_is_not_packed_is_a_value_error(block):
    from pipeline.remapping.packing import HEAD, unpack

    with pytest.raises(ValueError, match=r"[Zz]standard|frame|content|size"):
        unpack(np.zeros((), HEAD), bytearray(block))
