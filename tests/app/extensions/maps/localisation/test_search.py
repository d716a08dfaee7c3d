"""The masks of a search."""

from __future__ import annotations

import numpy as np
import pytest

from app.extensions.maps.localisation.search import MASK, MASK_NEAR, MapIndex, mask_pairs, ones
from pipeline.loop_closure.stem_matching import cells_of
from tests.app.extensions.maps.localisation.stands import stand, stored


def test_ones_counts_the_bits_of_a_word():
    for word in (0, 1, 2**63, 2**64 - 1, 0x0123456789ABCDEF):
        assert ones(np.uint64(word)) == word.bit_count()


@pytest.mark.slow
def test_the_mask_of_a_pair_has_the_cells_near_its_neighbours():
    place, side = stand(1, side=30.0), 0.7
    pair = np.array([[0, 1], [5, 3]], np.int32)
    mask = np.zeros((2, MASK * MASK // 64), np.uint64)
    bits = mask_pairs(place, *cells_of(place, (MASK + 1) * side), pair, side, MASK_NEAR, mask)
    axis = np.linspace(0.0, 1.0, 21)
    for (a, b), words in zip(pair.tolist(), mask, strict=True):
        along = (place[b] - place[a]) / np.hypot(*(place[b] - place[a]))
        arm = np.delete(place, [a, b], axis=0) - 0.5 * (place[a] + place[b])
        own = np.column_stack([arm @ along, arm @ [-along[1], along[0]]]) / side + 0.5 * MASK
        for i in range(MASK):
            for j in range(MASK):
                cell = np.stack(np.meshgrid(i + axis, j + axis), axis=-1).reshape(-1, 2)
                away = side * np.hypot(*(cell[:, None] - own[None]).T).min()
                at = MASK * i + j
                is_set = bool(int(words[at // 64]) >> (at % 64) & 1)
                assert is_set == (away <= MASK_NEAR) or abs(away - MASK_NEAR) < 0.01
    assert bits == sum(int(word).bit_count() for word in mask.ravel())


def test_the_share_of_set_bits_is_known():
    index = MapIndex.of(stored(stand(1)), 0.1)
    bits = sum(int(word).bit_count() for word in index.mask.ravel())
    assert index.mask_chance == bits / (64 * index.mask.size)
