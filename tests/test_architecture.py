"""Forbidden calls and docstrings of `app` and `pipeline`. `.ci/run` checks the import contracts."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

FORBIDDEN_ANYWHERE = {"pickle", "marshal", "shelve", "dill", "cloudpickle"}


@cache
def tree_of(path: Path) -> ast.Module:
    """The parsed file."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def files(*folders: str) -> list[Path]:
    """All Python files of some folders."""
    return sorted(file for folder in folders for file in (ROOT / folder).rglob("*.py"))


def name_of(path: Path) -> str:
    """For the name of a test: the path from the root."""
    return path.relative_to(ROOT).as_posix()


def imports(path: Path) -> Iterator[str]:
    """Every module that a file imports, anywhere in it; `from a import b` gives a and a.b."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


PIPELINE = files("pipeline")
EVERYTHING = files("pipeline", "app")


@cache
def calls(path: Path) -> list[tuple[ast.Call, str]]:
    """Every call in a file, with the dotted name of what is called."""
    return [(node, dotted(node.func)) for node in ast.walk(tree_of(path)) if isinstance(node, ast.Call)]


def dotted(node: ast.AST) -> str:
    """`a.b.c` of an expression, with "" for a part that is no name."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def test_the_pipeline_does_not_print_and_has_no_global_random_state():
    offenders = []
    for path in PIPELINE:
        for call, text in calls(path):
            printing = text in ("print", "input")
            clock = text.endswith((".now", ".utcnow", ".today"))
            generator = text.endswith((".default_rng", ".SeedSequence")) and bool(call.args)
            global_random = text.startswith(("np.random.", "numpy.random.")) and not generator
            if printing or clock or global_random:
                offenders.append(f"{name_of(path)}:{call.lineno} {text}")
    assert not offenders


def test_nothing_is_evaluated_unpickled_or_passed_to_a_shell():
    offenders = []
    for path in EVERYTHING:
        if {name.split(".")[0] for name in imports(path)} & FORBIDDEN_ANYWHERE:
            offenders.append(name_of(path))
        for call, text in calls(path):
            evaluates = text in ("eval", "exec", "os.system", "os.popen", "__import__")
            unsafe = any(
                keyword.arg in ("allow_pickle", "shell") and ast.unparse(keyword.value) != "False"
                for keyword in call.keywords
            )
            if evaluates or unsafe:
                offenders.append(f"{name_of(path)}:{call.lineno}")
    assert not offenders


def test_every_module_and_every_public_name_has_a_docstring():
    offenders = []
    for path in EVERYTHING:
        tree = tree_of(path)
        if tree.body and not ast.get_docstring(tree):
            offenders.append(name_of(path))
        for node in tree.body:
            if not isinstance(node, ast.FunctionDef | ast.ClassDef) or node.name.startswith("_"):
                continue
            if not ast.get_docstring(node):
                offenders.append(f"{name_of(path)}:{node.lineno} {node.name}")
    assert not offenders


HEAVY = (
    "numpy",
    "numba",
    "scipy",
    "sklearn",
    "open3d",
    "viser",
    "fastapi",
    "pydantic",
    "rosbags",
    "filterpy",
)


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["map", "--help"], ["serve", "--help"]])
def test_help_loads_nothing_heavy(words):
    code = (
        "import sys\nfrom app.cli import main\n"
        f"status = main({words!r})\n"
        f"print('HEAVY', sorted(set({HEAVY!r}) & set(sys.modules)))\nsys.exit(status)"
    )
    told = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert told.returncode == 0, told.stderr
    assert "HEAVY []" in told.stdout


def test_the_web_process_starts_without_numerical_libraries():
    code = (
        "import sys, app.web.app, app.web.serving, app.scene.scene\n"
        "from app.common.settings import Settings\nfrom app.dashboard.parameters import ParameterState\n"
        "from app.web.auth import AccessTokens\nfrom app.worker.protocol import Open\n"
        "app.web.app.build(Settings(), port=1, tokens=AccessTokens('t' * 16), source=Open('sim:paper'),\n"
        "    parameter_state=ParameterState())\n"
        "print('HEAVY', sorted({'numba', 'scipy', 'sklearn', 'open3d'} & set(sys.modules)))"
    )
    told = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert told.returncode == 0, told.stderr
    assert "HEAVY []" in told.stdout
