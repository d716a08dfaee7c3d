"""What is kept of a compiled kernel: good while no source that it took in has changed."""

from __future__ import annotations

import subprocess
import sys
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
CALL = "from wood.tree import twice; print(twice(1.0), sum(twice.stats.cache_hits.values()))"


CALL_AND_LISTEN = """
from pipeline.jit import on_compiling
from wood.tree import twice

told = []
with on_compiling(lambda: told.append(1)):
    print(twice(1.0), bool(told))
"""


def environment(folder: Path) -> dict[str, str]:
    """Of a process that keeps its kernels in this folder."""
    told = {
        "PYTHONPATH": f"{folder}:{ROOT}",
        "NUMBA_CACHE_DIR": str(folder / "kept"),
        # Python itself takes a file of the same second and size for the one of before.
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    if sys.pycache_prefix:  # numba's own is read from there: it need not be compiled in each process
        told["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    return told


def call(folder: Path, factor: float, more: float, program: str = CALL) -> list[str]:
    """What a new process gets from the kernel, and how often it took what was kept."""
    (folder / "wood" / "leaf.py").write_text(LEAF.format(factor=factor, more=more))
    told = subprocess.run(
        [sys.executable, "-c", program],
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return told.stdout.split()


@pytest.mark.parametrize("caller", [CALLER, CALLER_OF_MODULE])
def test_a_kernel_is_compiled_anew_when_what_it_calls_in_another_file_changes(tmp_path, caller):
    (tmp_path / "wood").mkdir()
    (tmp_path / "wood" / "__init__.py").touch()
    (tmp_path / "wood" / "tree.py").write_text(caller)
    assert call(tmp_path, 2.0, 1.0) == ["4.0", "0"]
    assert call(tmp_path, 2.0, 1.0) == ["4.0", "1"]
    assert call(tmp_path, 2.0, 3.0) == ["8.0", "0"]
    assert call(tmp_path, 5.0, 3.0) == ["20.0", "0"]
    assert call(tmp_path, 5.0, 3.0) == ["20.0", "1"]


def test_compiling_is_told_and_taking_what_was_kept_is_not(tmp_path):
    (tmp_path / "wood").mkdir()
    (tmp_path / "wood" / "__init__.py").touch()
    (tmp_path / "wood" / "tree.py").write_text(CALLER)
    assert call(tmp_path, 2.0, 1.0, CALL_AND_LISTEN) == ["4.0", "True"]
    assert call(tmp_path, 2.0, 1.0, CALL_AND_LISTEN) == ["4.0", "False"]


def test_processes_that_compile_a_kernel_for_other_types_at_once_keep_all_of_them(tmp_path):
    (tmp_path / "wood").mkdir()
    (tmp_path / "wood" / "__init__.py").touch()
    (tmp_path / "wood" / "tree.py").write_text(CALLER)
    (tmp_path / "wood" / "leaf.py").write_text(LEAF.format(factor=2.0, more=1.0))
    values = ["1", "1.0", "numpy.ones(1)", "numpy.ones((1, 1))"]

    def begun(*values: str) -> subprocess.Popen[str]:
        calls = "".join(f"twice({value}); " for value in values)
        program = f"import numpy; from wood.tree import twice; {calls}"
        program += "print(sum(twice.stats.cache_hits.values()))"
        return subprocess.Popen(
            [sys.executable, "-c", program],
            cwd=tmp_path,
            env=environment(tmp_path),
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


def test_who_dies_while_it_keeps_a_kernel_leads_nobody_to_the_code_of_other_sources(tmp_path):
    (tmp_path / "wood").mkdir()
    (tmp_path / "wood" / "__init__.py").touch()
    (tmp_path / "wood" / "tree.py").write_text(CALLER)
    assert call(tmp_path, 2.0, 1.0) == ["4.0", "0"]
    assert call(tmp_path, 5.0, 1.0, DIE_BETWEEN) == []
    assert call(tmp_path, 5.0, 1.0) == ["10.0", "0"], "not 4, of the sources before"
    assert call(tmp_path, 5.0, 1.0) == ["10.0", "1"]
    kept = [file.name for file in (tmp_path / "kept").rglob("*twice-*.nbc")]
    assert len(kept) == 1, "what other sources left is gone"


def test_where_nothing_can_be_locked_kernels_are_kept_all_the_same(tmp_path, monkeypatch):
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


def test_a_kernel_that_took_a_class_which_is_called_otherwise_now_is_compiled_anew(tmp_path):
    (tmp_path / "wood").mkdir()
    (tmp_path / "wood" / "__init__.py").touch()
    for name in ("Leaf", "Needle"):
        (tmp_path / "wood" / "tree.py").write_text(OF_A_CLASS.format(name=name))
        assert call(tmp_path, 2.0, 1.0, "import wood.tree") == ["2.0"]


KEEP = """
import pathlib
from wood.tree import twice

print(twice({value}))
print(*(file.name for file in pathlib.Path("kept").rglob("*twice-*.nbc")))
"""


def test_who_has_read_an_index_finds_its_own_machine_code_or_none(tmp_path):
    """Sources that change to and fro while a process runs: what it has read is gone, and no other types' code
    stands under its name."""
    (tmp_path / "wood").mkdir()
    (tmp_path / "wood" / "__init__.py").touch()
    (tmp_path / "wood" / "tree.py").write_text(CALLER)
    told, of_whole_numbers = call(tmp_path, 2.0, 1.0, KEEP.format(value="1"))
    assert told == "4.0"
    call(tmp_path, 5.0, 1.0, KEEP.format(value="1"))
    told, of_floats = call(tmp_path, 2.0, 1.0, KEEP.format(value="1.0"))
    assert told == "4.0"
    assert of_floats != of_whole_numbers
