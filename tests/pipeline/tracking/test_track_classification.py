"""Leave-one-out training: a scene is classified by trees that were trained without it and without its
copies."""

from __future__ import annotations

import numpy as np
import pytest

from app.training.augmentation import name_of_copy
from app.training.examples import POLE, TREE, Examples
from app.training.validation import leave_one_out
from pipeline.classification.features import COUNT, NAMES

N = 40  # examples of each


def scene(name: str, label: list[int], thick: list[float], *, pasted: bool = False) -> Examples:
    """Things so thick that end in free air, far from one another."""
    axis = np.zeros((len(label), 5))
    axis[:, 0] = 3.0 * np.arange(len(label))
    figures = np.zeros((len(label), COUNT))
    figures[:, NAMES.index("highest return")] = 3.0
    figures[:, NAMES.index("free above the highest return")] = 2.0
    figures[:, NAMES.index("thick")] = thick
    return Examples(name, pasted, False, axis, figures, np.array(label))


@pytest.mark.parametrize("own", [False, True])
def test_copies_of_the_left_out_scene_are_not_used_for_training(own):
    """Copies of a say that its thick trees are poles, which turns its verdict when they are learned from."""
    real = [scene(name, [TREE] * N + [POLE] * N, [0.2] * N + [0.05] * N) for name in ("parks/a", "parks/b")]
    said = scene(name_of_copy("parks/b", 0), [TREE] * N + [POLE] * N, [0.2] * N + [0.05] * N, pasted=True)
    name = name_of_copy("parks/a" if own else "parks/c", 0)
    contrary = scene(name, [POLE] * (9 * N) + [TREE] * N, [0.2] * (9 * N) + [0.05] * N, pasted=True)
    first, _ = leave_one_out(real, [said, contrary], 0.35)
    assert first == f"left out parks/a: {N if own else 0} of {N} trees, 0 false"
