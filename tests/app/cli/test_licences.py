"""The list of packages has all that are declared, each with a licence."""

from __future__ import annotations

import tomllib
from itertools import chain
from pathlib import Path

import pytest

from app.cli import main

_HERE = Path(__file__).parents[3]


def test_each_declared_package_is_listed_with_version_and_licence(capsys: pytest.CaptureFixture[str]):
    assert main(["licences"]) == 0
    rows = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert all(len(row) == 3 for row in rows)
    names = {name.lower().replace("_", "-") for name, _, _ in rows}
    declared = tomllib.loads((_HERE / "pyproject.toml").read_text())["project"]["dependencies"]
    plain = {
        text.replace("=", ">").partition(">")[0].partition("[")[0] for text in declared if ";" not in text
    }
    assert plain <= names
    assert {"stemmap", "starlette"} <= names  # itself, and what a package needs
    assert names >= {"numpy"}
    assert not {"playwright", "ruff"} & names
    assert [row for row in rows if row[2] in ("", "unknown")] == []


def test_the_reasons_name_each_declared_package():
    text = (_HERE / "docs" / "deployment.md").read_text()
    declared = tomllib.loads((_HERE / "pyproject.toml").read_text())["project"]
    needed = [*declared["dependencies"], *chain(*declared["optional-dependencies"].values())]
    names = {text.replace("=", ">").partition(">")[0].partition("[")[0].partition(";")[0] for text in needed}
    assert [name for name in sorted(names) if f"`{name}`" not in text] == []
