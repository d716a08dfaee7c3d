"""The file of a stored map."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

import numpy as np
import pytest

from app.extensions.maps.localisation import StoredMap
from pipeline.errors import StemmapError
from pipeline.io.checkpoints.codec import record_bytes
from tests.app.extensions.maps.localisation.stands import stand, trees_at


@dataclass
class Later:
    """A file of a later version."""

    format: int
    name: str


def example():
    """A map with known and unknown diameters and a terrain."""
    place = stand(1)
    trees = trees_at(place - 1000.0)
    dbh = np.where(np.arange(len(place)) % 3 == 0, np.nan, 0.3)
    cells = np.stack(np.meshgrid(np.arange(0.25, 40.0, 0.5), np.arange(0.25, 40.0, 0.5)), axis=-1).reshape(
        -1, 2
    )
    terrain = np.column_stack([cells, 0.1 * cells[:, 0]])
    return StoredMap.of(replace(trees, dbh=dbh, dbh_sigma=0.1 * dbh), terrain)


def test_a_file_gives_the_map_to_its_precision():
    stored = example()
    again = StoredMap.of_bytes(stored.as_bytes(), "file")
    np.testing.assert_array_equal(again.number, stored.number)
    np.testing.assert_allclose(again.position, stored.position, atol=0.0006)
    np.testing.assert_allclose(again.covariance, stored.covariance, atol=1e-4)
    np.testing.assert_allclose(again.dbh, stored.dbh, atol=1e-4)
    np.testing.assert_allclose(again.dbh_sigma, stored.dbh_sigma, atol=1e-4)
    heights = 0.1 * again.terrain[:, 0]
    np.testing.assert_allclose(again.terrain[:, 2], heights, atol=0.01)
    assert again.as_bytes() == stored.as_bytes()


def test_a_stem_needs_about_ten_bytes():
    place = stand(2, side=150.0)
    assert len(StoredMap.of(trees_at(place)).as_bytes()) < 20 * len(place)


def test_a_northing_is_not_written_as_another_place():
    with pytest.raises(StemmapError, match="km from the origin"):
        StoredMap.of(trees_at(np.array([[500_000.0, 5_300_000.0]]))).as_bytes()


def test_a_later_format_is_named():
    content = record_bytes(Later(format=2, name="stand"))
    with pytest.raises(StemmapError, match="has format 2, and this version reads 1"):
        StoredMap.of_bytes(zlib.compress(content, 9), "file")


@pytest.mark.parametrize(
    "damage", [lambda b: b[:-5], lambda b: b[:2], lambda b: b[:40] + b[44:], lambda b: b[:9] + b[:9:-1]]
)
def test_a_damaged_file_is_refused(damage):
    with pytest.raises(StemmapError, match="the map of stems is damaged"):
        StoredMap.of_bytes(damage(example().as_bytes()), "file")


@pytest.mark.parametrize("content", [b"", b"x", b"x_m,y_m\n1,2\n", b"\x89MCAP0\r\n", zlib.compress(b"{}", 1)])
def test_a_file_of_another_format_is_not_called_damaged(content):
    with pytest.raises(StemmapError, match=r"is not a stored map \(file\)\. Give the folder of a run"):
        StoredMap.of_bytes(content, "file")
