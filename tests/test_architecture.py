"""The house stays as it was planned: imports run one way, and the pipeline knows no web and no clock."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# What every stage may stand on; each entry may import itself and those before it.
FOUNDATION = (
    "errors",
    "geometry",
    "compiled",
    "pages",
    "files",
    "saving",
    "health",
    "clearance",
    "readings",
    "records",
    "parameters",
    "direction",
    "cells",
    "association",
    "bend",
    "visibility",
    "terrain",
    "growing_path",
    "turns",
    "resolution",
    "gyro",
    "measured_in_time",
    "odometry_in_time",
    "watch",
    "late",
)
# One stage each: they never know one another.
STAGES = (
    "acquisition",
    "filters",
    "ground",
    "clustering",
    "shape",
    "detection",
    "obstacles",
    "stems",
    "gathering",
    "height_map",
    "slam",
    "relocalisation",
    "tracking",
    "evaluation",
    "export",
    "exchange",
    "truth_table",
    "steps",
)
# What stands around the stages and what each may know beside the foundation.
AROUND = {
    "plot": {"clustering", "gathering"},
    # A simulated robot looks where it drives, with the stages that a real one uses.
    "simulation": {"plot", "acquisition", "ground", "obstacles"},
    "sources": {"simulation", "truth_table", "exchange", "plot"},
    "recording": {"sources", "simulation"},
    "loops": {"slam", "relocalisation"},
    "recovery": {"slam", "relocalisation", "loops"},
    "perception": {
        "acquisition",
        "filters",
        "ground",
        "clustering",
        "shape",
        "detection",
        "obstacles",
        "stems",
        "gathering",
    },
    "innovation": {"slam"},
    "mapper_records": {*STAGES, "perception", "recovery"},
    "mapper": {*STAGES, "perception", "loops", "recovery", "innovation", "mapper_records"},
    "rerun": {*STAGES, "perception", "mapper", "mapper_records"},
    "saved_map": {*STAGES, "mapper", "mapper_records", "recovery"},
    "merged_map": {*STAGES, "saved_map"},
}
FORBIDDEN_IN_PIPELINE = {
    "app",
    "viser",
    "fastapi",
    "uvicorn",
    "starlette",
    "websockets",
    "threading",
    "multiprocessing",
    "asyncio",
    "concurrent",
    "time",
    "logging",
    "random",
    "tqdm",
    "subprocess",
}
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


def rooms(path: Path) -> set[str]:
    """The rooms of the pipeline that a file imports from."""
    return {name.split(".")[1] for name in imports(path) if name.startswith("pipeline.")}


def room_of(path: Path) -> str:
    """The room of the pipeline that a file belongs to."""
    return path.relative_to(ROOT / "pipeline").parts[0].removesuffix(".py")


PIPELINE = files("pipeline")
EVERYTHING = files("pipeline", "app")


def test_every_room_has_its_place():
    known = {"__init__", *FOUNDATION, *STAGES, *AROUND}
    assert {room_of(path) for path in PIPELINE} <= known, "name the new room here, with what it may know"


@pytest.mark.parametrize("path", PIPELINE, ids=name_of)
def test_imports_run_one_way(path):
    room = room_of(path)
    if room in FOUNDATION:
        allowed = set(FOUNDATION[: FOUNDATION.index(room) + 1])
    else:
        allowed = {room, *FOUNDATION, *AROUND.get(room, set())}
    known = {*FOUNDATION, *STAGES, *AROUND}
    assert rooms(path) & known <= allowed


@pytest.mark.parametrize("path", PIPELINE, ids=name_of)
def test_the_pipeline_knows_no_web_no_thread_and_no_clock(path):
    assert not {name.split(".")[0] for name in imports(path)} & FORBIDDEN_IN_PIPELINE


@pytest.mark.parametrize("path", EVERYTHING, ids=name_of)
def test_only_the_scene_knows_viser(path):
    knows = any(name.split(".")[0] == "viser" for name in imports(path))
    # The bridge only asks where the installed viser keeps its page.
    assert not knows or "scene" in path.relative_to(ROOT).parts or path.name == "viser_bridge.py"


def calls(path: Path) -> Iterator[ast.Call]:
    """Every call in a file."""
    return (node for node in ast.walk(tree_of(path)) if isinstance(node, ast.Call))


@pytest.mark.parametrize("path", PIPELINE, ids=name_of)
def test_the_pipeline_prints_nothing_and_has_no_random_state_of_its_own(path):
    for call in calls(path):
        text = ast.unparse(call.func)
        assert text not in ("print", "input")
        assert not text.endswith((".now", ".utcnow", ".today")), "there is no clock in the pipeline"
        if text.startswith(("np.random.", "numpy.random.")):
            assert text.endswith((".default_rng", ".SeedSequence")), text
            assert call.args, "a generator without a seed"


@pytest.mark.parametrize("path", EVERYTHING, ids=name_of)
def test_nothing_is_evaluated_unpickled_or_given_to_a_shell(path):
    assert not {name.split(".")[0] for name in imports(path)} & FORBIDDEN_ANYWHERE
    for call in calls(path):
        assert ast.unparse(call.func) not in ("eval", "exec", "os.system", "os.popen", "__import__")
        for keyword in call.keywords:
            assert keyword.arg != "allow_pickle" or ast.unparse(keyword.value) == "False"
            assert keyword.arg != "shell" or ast.unparse(keyword.value) == "False"


@pytest.mark.parametrize("path", EVERYTHING, ids=name_of)
def test_no_file_and_no_function_grows_past_reading(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            assert node.end_lineno - node.lineno < 90, f"{node.name} is {node.end_lineno - node.lineno} lines"


@pytest.mark.parametrize("path", EVERYTHING, ids=name_of)
def test_every_module_says_what_it_is(path):
    tree = tree_of(path)
    if not tree.body:
        return
    assert ast.get_docstring(tree)
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{node.name} has no docstring"


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
