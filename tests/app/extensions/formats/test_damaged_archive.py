"""Damaged texts in the archive of Victoria Park."""

from __future__ import annotations

import zipfile
from pathlib import Path

from tests.benchmarks.mutating import read_all
from tests.benchmarks.real_files import real_file
from tests.pipeline.io.test_bad_input import mutations

MUTATIONS = 60


def test_damaged_texts_in_a_sound_zip_end_with_a_clear_error_or_with_losses(
    shared_data: Path, tmp_path: Path
):
    (tmp_path / "small.zip").write_bytes(real_file("Victoria Park zip", shared_data, tmp_path))
    with zipfile.ZipFile(tmp_path / "small.zip") as whole:
        texts = {name: whole.read(name)[:20_000] for name in whole.namelist()}
    damaged = tmp_path / "damaged.zip"
    refused = 0
    for number, changed in enumerate(mutations(texts["LASER.txt"], seed=1)):
        name = ("LASER.txt", "DRS.txt", "GPS.txt")[number % 3]
        with zipfile.ZipFile(damaged, "w") as archive:
            for member, text in texts.items():
                archive.writestr(member, changed if member == name else text)
        refused += read_all(damaged) != ""
    assert refused < MUTATIONS
