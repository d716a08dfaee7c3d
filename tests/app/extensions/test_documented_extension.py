"""The extension in docs/extensions.md works as another installed package, with its own test."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder for sys.path with the files of the documentation, and the metadata that pip would write."""
    text = (ROOT / "docs" / "extensions.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```(?:toml|python)\n(.*?)```", text, re.DOTALL)
    names = ("pyproject.toml", "stemmap_lines/__init__.py", "stemmap_lines/reader.py", "test_lines.py")
    (tmp_path / "stemmap_lines").mkdir()
    for name, block in zip(names, blocks, strict=True):
        (tmp_path / name).write_text(block)
    project = tomllib.loads(blocks[0])["project"]
    metadata = tmp_path / "stemmap_lines-1.0.dist-info"
    metadata.mkdir()
    name, version = project["name"], project["version"]
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    entries = [
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
        for group, points in project["entry-points"].items()
    ]
    (metadata / "entry_points.txt").write_text("".join(entries))
    return tmp_path


def stemmap(folder: Path, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the program with the package in the folder."""
    return subprocess.run(
        [sys.executable, "-c", "import sys; from app.cli import main; sys.exit(main())", *words],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(folder), **variables},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_the_documented_reader_reads(installed: Path, monkeypatch: pytest.MonkeyPatch):
    listed = stemmap(installed, "extensions")
    assert re.search(r"^lines +on .*\(stemmap-lines 1.0\)$", listed.stdout, re.MULTILINE), listed
    ring = [[4.0, 0.1 * k, 0.5] for k in range(-20, 20)]
    lines = [json.dumps({"t": 0.1 * k, "points": ring}) for k in range(5)]
    file = installed / "drive.scanl"
    file.write_text("\n".join([*lines, "no scan"]))
    told = stemmap(installed, "info", str(file))
    assert "scans as lines" in told.stdout, told
    assert "lines that are no scan" in told.stdout + told.stderr
    off = stemmap(installed, "info", str(file), STEMMAP_EXTENSIONS="")
    assert off.returncode == 1
    assert "The extension lines is switched off" in off.stderr


def test_its_own_test_passes(installed: Path):
    tested = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:dash",
         "--rootdir", str(installed), "-c", os.devnull, str(installed / "test_lines.py")],
        cwd=installed,
        env={**os.environ, "PYTHONPATH": f"{installed}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )  # fmt: skip
    assert tested.returncode == 0, tested.stdout + tested.stderr
