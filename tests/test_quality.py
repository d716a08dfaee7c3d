"""Lint, format and strict types are part of the tests; README and the parameters say the same."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.config import PRESETS, Parameters, field_specs, markdown_table, preset
from pipeline.config.model import FieldSpec

ROOT = Path(__file__).resolve().parents[1]


def run(*words: str) -> str:
    """Run a tool of this environment on the whole project; what it said when it was not content."""
    told = subprocess.run(
        [sys.executable, "-m", *words], cwd=ROOT, capture_output=True, text=True, timeout=900, check=False
    )
    return "" if told.returncode == 0 else f"{told.stdout}\n{told.stderr}"


def test_lint():
    assert run("ruff", "check", ".") == ""


def test_format():
    assert run("ruff", "format", "--check", ".") == ""


def test_types():
    assert run("mypy") == ""


# --- what people read -----------------------------------------------------------------------------


def test_the_parameter_table_is_current():
    table = markdown_table({name: preset(name) for name in PRESETS})
    text = (ROOT / "docs" / "parameters.md").read_text(encoding="utf-8")
    assert text.endswith(table), "generate it with: stemmap params --format markdown > docs/parameters.md"


@pytest.mark.parametrize("spec", field_specs(), ids=lambda s: s.name)
def test_a_parameter_is_named_and_said_in_full(spec: FieldSpec):
    assert re.fullmatch(r"[a-z]+\.[a-zA-Z][a-z0-9_]*", spec.name)
    assert spec.doc[0].isupper() or spec.doc[0].isdigit()
    assert spec.doc.endswith(".")
    assert not spec.title.endswith(".")
    assert len(spec.title) <= 30, "a slider has no room for more"
    if spec.kind == "choice":
        assert len(spec.choices) >= 2
        assert spec.default in spec.choices


def test_titles_within_a_stage_differ():
    for stage in Parameters.model_fields:
        titles = [s.title for s in field_specs() if s.name.startswith(f"{stage}.")]
        assert len(titles) == len(set(titles))


# --- what is in the repository ---------------------------------------------------------------------


def tracked() -> list[str]:
    """The files of the repository."""
    try:
        told = subprocess.run(
            ["git", "ls-files", "-z"],  # noqa: S607 - whichever git the person has
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not in a git repository")
    return [name for name in told.stdout.split("\0") if name and (ROOT / name).is_file()]


def test_no_lock_file_is_kept():
    kept = {"uv.lock", "poetry.lock", "Pipfile.lock", "pdm.lock", "package-lock.json", "yarn.lock"}
    assert not {Path(name).name for name in tracked()} & kept


FOREIGN = re.compile(
    r"files\.pythonhosted|pypi\.org/simple|registry\.npmjs|index[-_]url|extra-index|/home/[a-z]|/Users/[A-Z]"
)


def test_no_address_of_a_registry_and_no_path_of_somebody_s_machine():
    here = Path(__file__).name
    for name in tracked():
        path = ROOT / name
        if path.suffix in (".png", ".jpg", ".ico", ".woff2") or path.name in (here, "uv.lock"):
            continue
        text = path.read_text(encoding="utf-8", errors="replace")
        assert not FOREIGN.search(text), f"{name}: {FOREIGN.search(text)}"


def test_no_large_file_and_nothing_left_to_do():
    left = re.compile(r"\b(TODO|FIXME|XXX|coming soon)\b")
    here = Path(__file__).name
    for name in tracked():
        path = ROOT / name
        assert path.stat().st_size < 2_000_000, name
        if path.suffix in (".py", ".js", ".css", ".html", ".md", ".toml") and path.name != here:
            assert not left.search(path.read_text(encoding="utf-8")), name


def test_words_that_say_nothing_name_no_file():
    for name in tracked():
        # A command's file is called as the command is, and `info` is what bag tools call this one.
        if name.endswith(".py") and name != "app/cli/info.py":
            assert Path(name).stem not in {"utils", "helpers", "manager", "common", "misc", "data2", "info"}


def test_viser_is_pinned_and_both_open3d_are_never_wanted_together():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert '"viser==1.1.1"' in text
    assert re.search(r'"open3d-cpu[^"]*;[^"]*==', text)
    assert re.search(r'"open3d>[^"]*;[^"]*!=', text)
