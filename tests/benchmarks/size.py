"""Measures the size of the code: `python -m tests.benchmarks size [ROOT]`, of this clone or another one.

Code lines are lines that are neither blank, nor comments, nor part of a docstring. The core is `app` without
`app/extensions`, and `pipeline`. An import chain counts the modules (or the folders) of `app` of which each
imports the next when it is loaded; imports inside of functions and for type checking do not count, and
members of a circle of imports count once. Kernels are functions that Numba compiles. Named numbers are
constants of a module, in capitals, outside of the declared parameters.
"""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

PACKAGES = ("app", "pipeline")
EXTENSIONS = "app/extensions"
WEB = "app.web.app"  # packages that the web process imports
HEAVY = ("numba", "scipy", "sklearn", "open3d")
KERNEL = re.compile(r"^@compiled\w*$", re.MULTILINE)
#: Names of the parts of viser's client that are not public.
PRIVATE_VISER = re.compile(r"__viser\w*")
_root = Path(__file__).parents[2]


def code_lines(text: str) -> int:
    """Number of lines of a module without blanks, comments and docstrings."""
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(getattr(first.value, "value", None), str):
                docstrings |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    return sum(
        1
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.strip().startswith("#") and number not in docstrings
    )


def files(package: str) -> list[Path]:
    """All modules of a package."""
    return sorted((_root / package).rglob("*.py"))


def imports_of(package: str) -> dict[str, set[str]]:
    """The modules of a package that each of its modules imports when it is loaded."""
    modules = {_name(path): path for path in files(package)}
    graph = {}
    for name, path in modules.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found = {target for target in _targets(tree) if target in modules}
        graph[name] = found - {name}
    return graph


def folders_of(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """The same for folders: `app.extensions.search` for all modules in it."""
    folders: dict[str, set[str]] = {}
    for name, targets in graph.items():
        folder = ".".join(name.split(".")[:2])
        found = {".".join(target.split(".")[:2]) for target in targets} - {folder, "app"}
        folders.setdefault(folder, set()).update(found)
    return folders


def longest_chain(graph: dict[str, set[str]]) -> list[str]:
    """The longest chain of modules of which each imports the next."""
    sys.setrecursionlimit(10_000)

    @cache
    def from_module(name: str) -> tuple[str, ...]:
        chains = [from_module(target) for target in sorted(graph[name]) if name not in _reach(target)]
        longest: tuple[str, ...] = ()
        for chain in chains:
            longest = chain if len(chain) > len(longest) else longest
        return (name, *longest)

    @cache
    def _reach(name: str) -> frozenset[str]:
        seen, waiting = {name}, [name]
        while waiting:
            for target in graph[waiting.pop()] - seen:
                seen.add(target)
                waiting.append(target)
        return frozenset(seen)

    return max((list(from_module(name)) for name in sorted(graph)), key=len, default=[])


def imported_by(module: str) -> list[str]:
    """All modules that `import module` loads."""
    code = f"import json, sys, {module}; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=_root, capture_output=True, check=True)
    return list(json.loads(done.stdout))


def own(modules: Iterable[str]) -> list[str]:
    """The modules of this project."""
    return [name for name in modules if name.split(".")[0] in PACKAGES]


def most_methods() -> tuple[int, str]:
    """The largest number of methods of a class, and its name."""
    found = [(0, "")]
    for path in (path for package in PACKAGES for path in files(package)):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                methods = sum(isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef) for each in node.body)
                found.append((methods, node.name))
    return max(found)


def _name(path: Path) -> str:
    parts = path.relative_to(_root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _targets(tree: ast.Module) -> Iterator[str]:
    waiting: list[ast.AST] = list(tree.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                continue
            waiting += ast.iter_child_nodes(node)


def named_numbers(text: str) -> int:
    """Number of constants of a module in capitals whose value contains a number."""
    found = 0
    for node in ast.parse(text).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        names = [each for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)]
        values = [each.value for each in ast.walk(node.value) if isinstance(each, ast.Constant)]
        if any(type(value) in (int, float) for value in values):
            found += sum(name.id == name.id.upper() for name in names)
    return found


def rooms() -> Iterator[tuple[str, int, int]]:
    """Code lines and named numbers of each folder of `pipeline`."""
    for folder in sorted(path for path in (_root / "pipeline").iterdir() if (path / "__init__.py").exists()):
        texts = [path.read_text(encoding="utf-8") for path in folder.rglob("*.py")]
        yield folder.name, sum(map(code_lines, texts)), sum(map(named_numbers, texts))


def main(words: list[str]) -> None:
    """Print the table of a clone, by default this one."""
    global _root
    if words:
        _root = Path(words[0]).resolve()
    lines = {
        path.relative_to(_root).as_posix(): code_lines(path.read_text(encoding="utf-8"))
        for package in PACKAGES
        for path in files(package)
    }
    tests = [
        path.read_text(encoding="utf-8")
        for path in files("tests")
        if "benchmarks" not in path.relative_to(_root).parts
    ]
    texts = [path.read_text(encoding="utf-8") for package in PACKAGES for path in files(package)]
    scripts = [path.read_text(encoding="utf-8") for path in (_root / "static").rglob("*.js")]
    graph = imports_of("app")
    modules, folders = longest_chain(graph), longest_chain(folders_of(graph))
    web = imported_by(WEB)
    heavy = [name for name in HEAVY if name in web]
    methods, of_class = most_methods()
    every = sorted(lines.values())

    def total(folder: str) -> int:
        return sum(count for name, count in lines.items() if name.startswith(f"{folder}/"))

    rows = [
        ("code lines of the core", sum(every) - total(EXTENSIONS)),
        ("code lines of extensions", total(EXTENSIONS)),
        ("code lines in all", sum(every)),
        *((f"code lines in {each}", total(each)) for each in PACKAGES),
        ("files", len(every)),
        ("median code lines of a file", every[len(every) // 2]),
        ("kernels", sum(len(KERNEL.findall(text)) for text in texts)),
        ("code lines of tests without benchmarks", sum(map(code_lines, tests))),
        ("lines of JavaScript", sum(len(text.splitlines()) for text in scripts)),
        ("JavaScript files with private viser", sum(bool(PRIVATE_VISER.search(text)) for text in scripts)),
        ("modules imported by pipeline.mapper", len(own(imported_by("pipeline.mapper")))),
        ("modules imported by the web process", len(own(web))),
        ("deepest chain of modules inside app", len(modules)),
        ("deepest chain of folders inside app", len(folders)),
        (f"most methods of a class ({of_class})", methods),
    ]  # fmt: skip
    for name, value in rows:
        print(f"{name:42}{value:>8,}")
    print(f"heavy libraries of the web process: {', '.join(heavy) or 'none'}")
    print("modules: " + " -> ".join(modules))
    print("folders: " + " -> ".join(folders))
    print(f"{'folder of pipeline':38}{'lines':>8}{'numbers':>9}")
    for folder, code, numbers in rooms():
        print(f"{folder:38}{code:>8,}{numbers:>9}")


if __name__ == "__main__":
    main(sys.argv[1:])
