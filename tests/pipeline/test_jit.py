"""The cache of compiled kernels: an entry is valid until one of its sources changes."""

from __future__ import annotations

import importlib
import subprocess
import sys
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

CALLER = """
from pipeline.jit import compiled
from wood.leaf import FACTOR, grown

@compiled
def twice(x):
    return FACTOR * grown(x)
"""
CALLER_OF_MODULE = """
import wood.leaf
from pipeline.jit import compiled

FACTOR, grown = wood.leaf.FACTOR, wood.leaf.grown

@compiled
def twice(x):
    return FACTOR * grown(x)
"""
LEAF = """
from pipeline.jit import compiled

FACTOR = {factor}

@compiled
def grown(x):
    return x + {more}
"""
CALL = """
from pipeline.jit import count_kept, on_compiling
from wood.tree import twice

told = []
before = count_kept()
with on_compiling(lambda: told.append(1)):
    print(twice(1.0), sum(twice.stats.cache_hits.values()), bool(told), before, count_kept())
"""
# Kernels loaded, whether one was compiled, and the kernels in the cache (`twice`, `grown`) before and after.
COMPILED, LOADED = ["0", "True", "0", "2"], ["1", "False", "2", "2"]


def environment(folder: Path, *, in_tree: bool = False) -> dict[str, str]:
    """Environment of a process that stores its kernels in this folder, or beside their sources."""
    told = {
        "PYTHONPATH": f"{folder}:{ROOT}",
        **({} if in_tree else {"NUMBA_CACHE_DIR": str(folder / "kept")}),
        # Python itself takes a file of the same second and size for the one of before.
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    if sys.pycache_prefix:  # numba's own is read from there: it need not be compiled in each process
        told["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    return told


def call(
    folder: Path, factor: float, more: float, program: str = CALL, *, in_tree: bool = False
) -> list[str]:
    """Return the words that a process prints: the result, the kernels loaded, and whether one compiled."""
    (folder / "wood" / "leaf.py").write_text(LEAF.format(factor=factor, more=more))
    told = subprocess.run(
        [sys.executable, "-c", program],
        cwd=folder,
        env=environment(folder, in_tree=in_tree),
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return told.stdout.split()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a package `wood`, whose kernel calls one of another file."""
    (tmp_path / "wood").mkdir()
    (tmp_path / "wood" / "__init__.py").touch()
    (tmp_path / "wood" / "tree.py").write_text(CALLER)
    return tmp_path


@pytest.mark.slow
def test_a_kernel_is_compiled_again_when_a_function_or_a_constant_of_another_file_changes(folder):
    assert call(folder, 2.0, 1.0) == ["4.0", *COMPILED]
    assert call(folder, 2.0, 1.0) == ["4.0", *LOADED]
    assert call(folder, 2.0, 3.0) == ["8.0", *COMPILED]
    assert call(folder, 5.0, 3.0) == ["20.0", *COMPILED]


def test_a_change_is_seen_through_attributes_of_a_module(folder):
    (folder / "wood" / "tree.py").write_text(CALLER_OF_MODULE)
    assert call(folder, 2.0, 1.0) == ["4.0", *COMPILED]
    assert call(folder, 5.0, 3.0) == ["20.0", *COMPILED]


@pytest.mark.slow
def test_processes_that_compile_a_kernel_for_different_types_at_once_store_all_of_them(folder):
    (folder / "wood" / "leaf.py").write_text(LEAF.format(factor=2.0, more=1.0))
    values = ["1", "1.0", "numpy.ones(1)", "numpy.ones((1, 1))"]

    def begun(*values: str) -> subprocess.Popen[str]:
        calls = "".join(f"twice({value}); " for value in values)
        program = f"import numpy; from wood.tree import twice; {calls}"
        program += "print(sum(twice.stats.cache_hits.values()))"
        return subprocess.Popen(
            [sys.executable, "-c", program],
            cwd=folder,
            env=environment(folder),
            stdout=subprocess.PIPE,
            text=True,
        )

    first = [begun(value) for value in values]
    assert [process.communicate(timeout=120)[0] for process in first] == ["0\n"] * 4
    assert begun(*values).communicate(timeout=120)[0] == "4\n"


DIE_BETWEEN = """
import os
from pathlib import Path
from wood.tree import twice

file = twice._cache._cache_file
file._save_data = lambda *_: os._exit(0)  # killed when the index is written and the machine code is not
twice(1.0)
"""


@pytest.mark.slow
def test_a_process_that_dies_while_it_stores_a_kernel_leaves_no_code_of_other_sources(folder):
    assert call(folder, 2.0, 1.0) == ["4.0", *COMPILED]
    assert call(folder, 5.0, 1.0, DIE_BETWEEN) == []
    told = call(folder, 5.0, 1.0)
    assert told[:3] == ["10.0", *COMPILED[:2]], "not 4.0, the result of the earlier sources"
    assert call(folder, 5.0, 1.0) == ["10.0", *LOADED]
    kept = [file.name for file in (folder / "kept").rglob("*twice-*.nbc")]
    assert len(kept) == 1, "the files of other sources are removed"


def test_kernels_are_stored_where_files_cannot_be_locked(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl", reason="no locks of files on this system")
    from pipeline.jit import locked

    def refused(*_: object) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refused)
    with locked(tmp_path / "some.nbi"):
        pass
    with pytest.raises(OSError, match="of the work itself"), locked(tmp_path / "some.nbi"):
        raise OSError("of the work itself")


OF_A_CLASS = """
from typing import NamedTuple
from pipeline.jit import compiled

class {name}(NamedTuple):
    x: float

@compiled
def twice(of):
    return 2.0 * of.x

print(twice({name}(1.0)))
"""


@pytest.mark.slow
def test_a_kernel_is_compiled_again_when_the_class_of_its_argument_is_renamed(folder):
    for name in ("Leaf", "Needle"):
        (folder / "wood" / "tree.py").write_text(OF_A_CLASS.format(name=name))
        assert call(folder, 2.0, 1.0, "import wood.tree") == ["2.0"]


KEEP = """
import pathlib
from wood.tree import twice

print(twice({value}))
print(*(file.name for file in pathlib.Path("kept").rglob("*twice-*.nbc")))
"""


@pytest.mark.slow
def test_a_process_loads_the_machine_code_of_the_index_that_it_read_or_none(folder):
    """Sources change and change back while a process runs: two types never share a file name."""
    told, of_whole_numbers = call(folder, 2.0, 1.0, KEEP.format(value="1"))
    assert told == "4.0"
    call(folder, 5.0, 1.0, KEEP.format(value="1"))
    told, of_floats = call(folder, 2.0, 1.0, KEEP.format(value="1.0"))
    assert told == "4.0"
    assert of_floats != of_whole_numbers


@pytest.mark.slow
def test_kernels_that_were_delivered_beside_their_sources_are_used_from_another_folder(folder):
    assert call(folder, 2.0, 1.0, in_tree=True) == ["4.0", *COMPILED]
    assert call(folder, 2.0, 1.0) == ["4.0", *LOADED]
    assert call(folder, 5.0, 1.0) == ["10.0", *COMPILED]  # the delivered ones are of other sources
    assert call(folder, 3.0, 1.0, in_tree=True) == ["6.0", *COMPILED]  # another version is delivered
    assert call(folder, 3.0, 1.0) == ["6.0", *LOADED]


TARGET = """
import platform
import sys

import llvmlite.binding

if sys.argv[1:]:
    platform.machine = lambda: sys.argv[1]
    features = {name: True for name in sys.argv[2:]}
    llvmlite.binding.get_host_cpu_features = lambda: features
import numba

import pipeline.jit

print(numba.config.CPU_NAME, repr(numba.config.CPU_FEATURES))
"""
V3 = ["avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"]


@pytest.mark.slow_after(2)
@pytest.mark.parametrize(
    ("machine", "chosen", "target"),
    [
        (["x86_64", *V3], "", "x86-64-v3 ''"),
        (["x86_64", *V3, "avx512f"], "", "x86-64-v3 ''"),
        (["x86_64", *V3[1:]], "", "None None"),
        (["aarch64"], "", "generic ''"),
        (["riscv64"], "", "None None"),
        (["x86_64", *V3], "skylake", "skylake None"),
    ],
)
def test_all_machines_of_an_architecture_compile_for_one_target(tmp_path, machine, chosen, target):
    told = subprocess.run(
        [sys.executable, "-c", TARGET, *machine],
        env={**environment(tmp_path), **({"NUMBA_CPU_NAME": chosen} if chosen else {})},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert told.stdout.strip() == target


def test_a_wheel_takes_the_kernels_along_and_an_editable_one_does_not(tmp_path, monkeypatch):
    plugin = types.ModuleType("hatchling.builders.hooks.plugin.interface")
    plugin.BuildHookInterface = object  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, plugin.__name__, plugin)
    monkeypatch.delitem(sys.modules, "pipeline.wheel_kernels", raising=False)
    hook = importlib.import_module("pipeline.wheel_kernels").KernelsInWheel()
    hook.root = str(tmp_path)
    kernel = tmp_path / "pipeline" / "slam" / "__pycache__" / "a.f-1.py311.nbi"
    kernel.parent.mkdir(parents=True)
    kernel.touch()
    (kernel.parent / "a.cpython-311.pyc").touch()
    (kernel.parent.parent / "a.py").touch()
    (kernel.parent / "gone.f-1.py311.nbi").touch()
    for version, files in (
        ("standard", {str(kernel): "pipeline/slam/__pycache__/a.f-1.py311.nbi"}),
        ("editable", {}),
    ):
        build: dict[str, dict[str, str]] = {"force_include": {}}
        hook.initialize(version, build)
        assert build["force_include"] == files
    monkeypatch.delitem(sys.modules, "pipeline.wheel_kernels")


def test_kernels_are_compiled_for_that_target(tmp_path):
    program = (
        "import numba, pipeline.jit\nfrom numba.core.registry import cpu_target\n"
        "print(numba.config.CPU_NAME in (None, cpu_target.target_context.codegen().magic_tuple()[1]))"
    )
    told = subprocess.run(
        [sys.executable, "-c", program],
        env=environment(tmp_path),
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert told.stdout.strip() == "True"


CONSTANTS = """
from pipeline.jit import compiled

@compiled
def grown(x, by):
    return x + by

@compiled
def thrice(x, by):
    return grown(x, 1) + grown(x, 2) + grown(x, by)
"""


def test_a_kernel_is_compiled_once_for_constant_and_variable_integers(folder):
    (folder / "wood" / "constants.py").write_text(CONSTANTS)
    program = "from wood.constants import grown, thrice; print(thrice(0, 3), len(grown.signatures))"
    assert call(folder, 1.0, 1.0, program) == ["6", "1"]
