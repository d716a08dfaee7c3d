"""Texts of the parameters, and rules for the files of the repository. `.ci/run` checks style and types."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from pipeline.config import PRESETS, Parameters, field_specs, markdown_table, preset
from pipeline.config.model import FieldSpec

ROOT = Path(__file__).resolve().parents[1]


def test_the_parameter_table_is_current():
    table = markdown_table({name: preset(name) for name in PRESETS})
    text = (ROOT / "docs" / "parameters.md").read_text(encoding="utf-8")
    assert text.endswith(table), "generate it with: stemmap params --format markdown > docs/parameters.md"


def flaws(spec: FieldSpec) -> list[str]:
    """Rules for the name, the title and the description of a parameter that it breaks."""
    rules = {
        "its name is no dotted name": re.fullmatch(r"[a-z]+\.[a-zA-Z][a-z0-9_]*", spec.name) is not None,
        "its description begins neither a sentence nor with a choice": spec.doc[0].isupper()
        or spec.doc[0].isdigit()
        or spec.doc.partition(":")[0] in spec.choices,
        "its description has no full stop": spec.doc.endswith("."),
        "its title ends with a full stop": not spec.title.endswith("."),
        "its title is too long for a slider": len(spec.title) <= 30,
        "it has fewer than two choices": spec.kind != "choice" or len(spec.choices) >= 2,
        "its default is not a choice": spec.kind != "choice" or spec.default in spec.choices,
    }
    return [f"{spec.name}: {rule}" for rule, holds in rules.items() if not holds]


def test_every_parameter_is_named_and_described_in_full():
    assert [flaw for spec in field_specs() for flaw in flaws(spec)] == []


def test_titles_within_a_stage_differ():
    for stage in Parameters.model_fields:
        titles = [s.title for s in field_specs() if s.name.startswith(f"{stage}.")]
        assert len(titles) == len(set(titles))


def test_no_id_of_the_page_occurs_twice():
    text = (ROOT / "static" / "index.html").read_text(encoding="utf-8")
    ids = re.findall(r'\sid="([^"]+)"', text)
    assert [name for name in sorted(set(ids)) if ids.count(name) > 1] == []


def tracked() -> list[str]:
    """Return the files under version control."""
    try:
        told = subprocess.run(
            ["git", "ls-files", "-z"],  # noqa: S607 - git of the search path
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


def test_no_registry_address_and_no_path_of_a_machine():
    here = Path(__file__).name
    offenders = []
    for name in tracked():
        path = ROOT / name
        if path.suffix in (".png", ".jpg", ".ico", ".woff2") or path.name in (here, "uv.lock"):
            continue
        text = path.read_text(encoding="utf-8", errors="replace")
        offenders += [f"{name}: {found[0]}" for found in FOREIGN.finditer(text)]
    assert offenders == []


def test_no_large_file_and_no_open_task():
    left = re.compile(r"\b(TODO|FIXME|XXX|coming soon)\b")
    here = Path(__file__).name
    offenders = []
    for name in tracked():
        path = ROOT / name
        is_text = path.suffix in (".py", ".js", ".css", ".html", ".md", ".toml") and path.name != here
        if path.stat().st_size >= 2_000_000 or (is_text and left.search(path.read_text(encoding="utf-8"))):
            offenders.append(name)
    assert offenders == []


def test_no_file_has_a_name_without_meaning():
    empty = {"utils", "helpers", "manager", "common", "misc", "data2", "info"}
    # The file of a command has the name of the command.
    allowed = {"app/cli/info.py"}
    assert [n for n in tracked() if n.endswith(".py") and Path(n).stem in empty and n not in allowed] == []


def test_viser_is_pinned_and_both_open3d_are_never_required_together():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert '"viser==1.1.1"' in text
    assert re.search(r'"open3d-cpu[^"]*;[^"]*==', text)
    assert re.search(r'"open3d>[^"]*;[^"]*!=', text)


def test_the_citation_names_this_version():
    about = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    assert f"version: {about['version']}" in lines
    assert f"license: {about['license']}" in lines
