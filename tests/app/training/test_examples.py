"""Examples that are kept on disk: read back as they were, and sizes are checked before memory is taken."""

from __future__ import annotations

import io
import zipfile
from typing import IO

import numpy as np
import pytest

from app.cli import main
from app.training.examples import Examples, read_examples, stored_or_computed
from pipeline.errors import StemmapError


def examples():
    """Two stems."""
    return [Examples("a scene", True, False, np.ones((2, 4)), np.ones((2, 3)), np.array([1, 2]))]


def test_what_was_kept_is_read_and_not_made_again(tmp_path):
    made = stored_or_computed(tmp_path, "a scene", examples)
    again = stored_or_computed(tmp_path, "a scene", lambda: pytest.fail("made again"))
    assert np.array_equal(made[0].figures, again[0].figures)
    assert (again[0].scene, again[0].simulated, again[0].all_around) == ("a scene", True, False)


def test_a_small_file_that_promises_gigabytes_is_refused(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 29,)}
    )
    with zipfile.ZipFile(tmp_path / "large.npz", "w") as archive:
        archive.writestr("axis0.npy", header.getvalue())
    with pytest.raises(StemmapError, match="is not complete"):
        read_examples(tmp_path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"nothing of that kind"])
def test_a_damaged_file_is_named(tmp_path, content):
    (tmp_path / "broken.npz").write_bytes(content)
    with pytest.raises(StemmapError, match=r"broken\.npz"):
        read_examples(tmp_path)


def test_what_training_needs_is_looked_for_before_hours_of_simulating(tmp_path, capsys):
    assert main(["train", "--out", str(tmp_path / "none" / "forest.json")]) == 1
    assert "folder for --out" in capsys.readouterr().err
    assert main(["train", str(tmp_path / "place"), "--out", str(tmp_path / "forest.json")]) == 1
    assert "no labelled scans" in capsys.readouterr().err


def test_a_file_that_cannot_be_written_whole_is_not_there(tmp_path, monkeypatch):
    def half(file: IO[bytes], **_columns: object) -> None:
        file.write(b"PK")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", half)
    with pytest.raises(StemmapError, match="No space left"):
        stored_or_computed(tmp_path, "a scene", examples)
    assert not list(tmp_path.iterdir())
