"""Examples that are kept on disk: read back as they were, or reported as damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.extensions.learning.examples import Examples, read_examples, stored_or_computed
from pipeline.errors import StemmapError


def examples():
    """Two stems."""
    return [Examples("a scene", True, False, np.ones((2, 4)), np.ones((2, 3)), np.array([1, 2]))]


def test_what_was_kept_is_read_and_not_made_again(tmp_path):
    made = stored_or_computed(tmp_path, "a scene", examples)
    again = stored_or_computed(tmp_path, "a scene", lambda: pytest.fail("made again"))
    assert np.array_equal(made[0].figures, again[0].figures)
    assert (again[0].scene, again[0].simulated, again[0].all_around) == ("a scene", True, False)


@pytest.mark.parametrize("content", [b"", b"\xff\xff\xff\x7f", b"\x02\x00\x00\x00{}"])
def test_a_damaged_file_is_named(tmp_path, content):
    (tmp_path / "broken.examples").write_bytes(content)
    with pytest.raises(StemmapError, match=r"broken\.examples"):
        read_examples(tmp_path / "broken.examples")


def test_a_file_that_cannot_be_written_whole_is_not_there(tmp_path, monkeypatch):
    def half(_path: Path, _data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(StemmapError, match="No space left"):
        stored_or_computed(tmp_path, "a scene", examples)
    assert not list(tmp_path.iterdir())
