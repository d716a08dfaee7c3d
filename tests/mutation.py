"""Mutation testing: `python -m tests.mutation [--folder DIR] [--only TEXT] [--minutes M [--seed S]]`.

Each mutant changes one expression, in a scratch worktree of the committed state. It is killed if a test
fails, or if a test does not end. Without --minutes, the mutants written by hand below are run, each with the
tests named beside it. With --minutes, operators, numbers and booleans in ROOMS are mutated in random order
until the time is over. Each of these mutants is run with the tests that execute its line, the fastest first.
The tests of each line are recorded before, one test file at a time. Recorded lines and results are stored in
the folder, so that a run that was stopped can be resumed. A table is printed at the end. Kernels run without
numba, so that nothing is compiled.
"""

from __future__ import annotations

import argparse
import ast
import gc
import hashlib
import importlib
import json
import math
import multiprocessing
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from itertools import accumulate, count, pairwise
from pathlib import Path

from _pytest.config import default_plugins

_ROOT = Path(__file__).parents[1]
_LIMIT_S = 900.0
#: Time for the start of pytest with a generated mutant; a test that waits for ever takes no computing time.
_START_S = 120.0
_KILLED = ("killed", "timeout")
_NUMBERS = count(1)  # times of files with a mutant [s]
#: Exit code of a run whose test computes too long; those of pytest are 0 to 5.
TIMEOUT = 9
#: Computing time of a test or its fixtures, while lines are recorded and with a generated mutant; sum of the
#: times of the tests of a generated mutant.
_RECORDED_S, _MUTATED_S, _TESTS_S = 1.0, 30.0, 60.0
#: Imported once. Each run is a fork, which imports only the project and its tests.
_LIBRARIES = (
    "pytest", "numpy", "numba", "scipy.optimize", "scipy.stats", "sklearn.cluster", "sklearn.ensemble",
    "hypothesis", "open3d", "fastapi", "sqlalchemy", "rosbags.highlevel", "shapely", "viser", "optuna",
    "filterpy.kalman", "laspy", "coverage", "xdist.plugin", "pytest_asyncio.plugin", "anyio.pytest_plugin",
    *(f"_pytest.{name}" for name in default_plugins),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mutant:
    """A change of the sources.

    Attributes:
        path: File.
        old, new: Text, and its replacement.
        tests: Arguments of pytest that should notice it, if it is written by hand.
        at: Position of the text [bytes]; -1 if it occurs once in the file.
        place: Its line and column, if it is generated, so that the name of the mutant remains when other
            lines of the file change.
        statement: The statement that it belongs to.
    """

    path: str
    old: str
    new: str
    tests: str = ""
    at: int = -1
    place: str = ""
    statement: tuple[int, int, str | None] = (0, 0, None)


_SLAM = "tests/pipeline/slam"
_LOOP = "tests/pipeline/loop_closure"
_LANDMARKS, _GRAPH = "pipeline/slam/particle_maps.py", "pipeline/slam/keyframe_graph.py"
_MERGED, _AUTH = "app/extensions/maps/merged_map.py", "app/web/auth.py"
_EVALUATION, _LIMITS_TESTS = (
    "tests/pipeline/evaluation/test_evaluation.py",
    "tests/app/sources/test_limited_process.py",
)
_DETECTION, _SCORE = "pipeline/loop_closure/detection.py", "pipeline/evaluation.py"
_CLOCK, _CHUNKS = "pipeline/io/readers/message_time.py", "pipeline/io/readers/container.py"
_RULE, _RAYS = "pipeline/classification/column_classifier.py", "pipeline/classification/ray_statistics.py"
_RULE_TESTS, _RAYS_TESTS = (
    "tests/pipeline/classification/test_decision_rule.py",
    "tests/pipeline/classification/test_ray_statistics.py -k absent",
)
_LIMITED = "app/sources/opening.py"
_UPDATE = f"{_SLAM}/test_fastslam.py -k 'textbook or views or positive'"
_GRAPH_TESTS = f"{_SLAM}/test_keyframe_graph.py -k 'turns or turned or weight'"
_MERGED_TESTS = "tests/app/extensions/maps/test_merged_map.py"
_GUARD = "tests/app/web/test_auth.py -k 'resembles or foreign or names'"
_TIMES = "tests/pipeline/io/test_clock_steps.py"
#: Tests that map whole runs; their mutants are in modules without kernels.
_WITH_NUMBA = (_MERGED_TESTS,)

MUTANTS = (
    Mutant(_LANDMARKS, "max(VARIANCE_MIN - smallest, 0.0)", "0.0", _UPDATE),
    Mutant(_LANDMARKS, "xx + lacking, xy, yy + lacking", "xx + lacking, xy, yy", _UPDATE),
    Mutant(_LANDMARKS, "- np.sqrt(0.25 * (xx - yy) ** 2", "+ np.sqrt(0.25 * (xx - yy) ** 2", _UPDATE),
    Mutant(_LANDMARKS, "S0 + R0, S1 + R1, S2 + R2", "R0, R1, R2", _UPDATE),
    Mutant(_LANDMARKS, "0.5 * (k00 * R1", "-0.5 * (k00 * R1", _UPDATE),
    Mutant(
        "pipeline/slam/keyframe_graph.py",
        "rotated_rows(known.covariance, turn)",
        "rotated_rows(known.covariance, -turn)",
        f"{_LOOP}/test_loop_motion.py -k covariance",
    ),
    Mutant(
        "pipeline/slam/keyframe_graph.py",
        "wrap_angle(now[:, 2] - was[:, 2])",
        "wrap_angle(was[:, 2] - now[:, 2])",
        f"{_LOOP}/test_loop_motion.py -k covariance",
    ),
    Mutant(_GRAPH, "C @ covariance @ C.T)))", "C.T @ covariance @ C)))", _GRAPH_TESTS),
    Mutant(_GRAPH, "C @ covariance @ C.T)))", "covariance)))", _GRAPH_TESTS),
    Mutant(_GRAPH, "for s in scans]), pose[:, 2])", "for s in scans]), -pose[:, 2])", _GRAPH_TESTS),
    Mutant(
        "pipeline/slam/motion.py",
        "G @ noise @ G.T",
        "noise",
        f"{_SLAM}/test_fastslam.py -k 'noise_that_differs or drawn_motions'",
    ),
    Mutant(
        "pipeline/slam/motion.py",
        "F @ covariance @ F.T",
        "covariance",
        f"{_SLAM}/test_fastslam.py -k 'noise_that_differs or drawn_motions'",
    ),
    Mutant(_DETECTION, " + C @ own @ C.T", "", f"{_LOOP}/test_detection.py -k through"),
    Mutant(_DETECTION, "C @ own @ C.T", "C.T @ own @ C", f"{_LOOP}/test_detection.py -k through"),
    Mutant(
        _DETECTION,
        "T_map_local.y - T_map_base.y, T_map_base.x",
        "T_map_base.y - T_map_local.y, T_map_base.x",
        f"{_LOOP}/test_detection.py -k through",
    ),
    Mutant(
        "pipeline/slam/particle_update.py",
        "likelihood - rules.miss_weight * missed",
        "likelihood + rules.miss_weight * missed",
        f"{_SLAM}/test_fastslam.py -k miss",
    ),
    Mutant(
        "pipeline/slam/particle_update.py",
        "near.score[j] -= rules.miss",
        "near.score[j] += rules.miss",
        f"{_SLAM}/test_fastslam.py -k miss",
    ),
    Mutant(_RULE, "GONE * (c.present + c.absent)", "GONE * c.present", _RULE_TESTS),
    Mutant(_RULE, "(c.absent >= GONE_SCANS) & ", "", _RULE_TESTS),
    Mutant(_RULE, "c.absent_lately >= LEFT_SCANS", "c.absent_lately > LEFT_SCANS", _RULE_TESTS),
    Mutant(_RAYS, "clear_range[b] > reach + BEHIND", "clear_range[b] > reach", _RAYS_TESTS),
    Mutant(_RAYS, "abs(clear_range[b] - reach) < NEAR", "clear_range[b] - reach < NEAR", _RAYS_TESTS),
    Mutant(_SCORE, "counted[matched] = in_reach[truth_of[matched]]", "pass", _EVALUATION),
    Mutant(
        _MERGED,
        "moved.P[:] = C @ tracks.P @ C.T",
        "moved.P[:] = C.T @ tracks.P @ C",
        _MERGED_TESTS,
    ),
    Mutant(_MERGED, "_flat(C @ full @ C.T + ", "_flat(C.T @ full @ C + ", _MERGED_TESTS),
    Mutant(
        _MERGED,
        "(tracks.sides << turn) | (tracks.sides >> (SECTORS - turn))",
        "(tracks.sides >> turn) | (tracks.sides << (SECTORS - turn))",
        _MERGED_TESTS,
    ),
    Mutant(
        _MERGED,
        "C[:2, :2] @ tracks.shared @ C[:2, :2].T",
        "C[:2, :2].T @ tracks.shared @ C[:2, :2]",
        _MERGED_TESTS,
    ),
    Mutant(
        _MERGED, "moved = C @ other.covariance @ C.T", "moved = C.T @ other.covariance @ C", _MERGED_TESTS
    ),
    Mutant(
        _MERGED, "wrap_angle(other.pose[:, 2] + T.yaw)", "wrap_angle(other.pose[:, 2] - T.yaw)", _MERGED_TESTS
    ),
    Mutant(
        _MERGED,
        "wrap_angle(poses[:, 2] + T.yaw)",
        "wrap_angle(poses[:, 2] - T.yaw)",
        _MERGED_TESTS,
    ),
    Mutant(
        _MERGED,
        "b.axis[:, 2:4] @ T.rotation().T",
        "b.axis[:, 2:4] @ T.rotation()",
        _MERGED_TESTS,
    ),
    Mutant(_AUTH, "return host in self._hosts", "return host.startswith(tuple(self._hosts))", _GUARD),
    Mutant(_AUTH, "return host in self._hosts", "return host.endswith(tuple(self._hosts))", _GUARD),
    Mutant(_AUTH, "origins[0].lower() in (", "origins[0].lower().startswith((", _GUARD),
    Mutant(_CLOCK, "away_ns = abs(time_ns", "away_ns = (time_ns", _TIMES),
    Mutant(_CLOCK, "_valid(log_ns + offset_ns)", "_valid(log_ns)", _TIMES),
    Mutant(_CHUNKS, "max(due_ns, time[:first].max()) - time[first]", "time[:first].max()", _TIMES),
    Mutant(_CHUNKS, "flatnonzero(topic == k)", "arange(len(topic))", _TIMES),
    Mutant(
        _LIMITED,
        "resource.setrlimit(resource.RLIMIT_CPU",
        "(lambda *_: None)(resource.RLIMIT_CPU",
        _LIMITS_TESTS,
    ),
    Mutant(
        _LIMITED,
        "resource.setrlimit(resource.RLIMIT_DATA",
        "(lambda *_: None)(resource.RLIMIT_DATA",
        _LIMITS_TESTS,
    ),
)


#: Folders and files of which mutants are generated.
ROOMS = (
    "pipeline/slam", "pipeline/tracking", "pipeline/detection", "pipeline/evaluation.py", "pipeline/geometry",
    "app/web/auth.py", "app/store", "pipeline/io/readers",
)  # fmt: skip
_OPERATORS = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "*"), ast.Mod: ("%", "*"), ast.MatMult: ("@", "+"),
    ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"), ast.LShift: ("<<", ">>"), ast.RShift: (">>", "<<"),
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"), ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"),
    ast.And: ("and", "or"), ast.Or: ("or", "and"), ast.Not: ("not ", ""), ast.USub: ("-", "+"),
}  # fmt: skip


#: First and last line of a statement without its body, and what it defines: None in a function, "" if it
#: has no name.
_Statement = tuple[int, int, str | None]


def generated() -> Iterator[Mutant]:
    """Yield the mutants of all operators, numbers and truth values of ROOMS."""
    for room in ROOMS:
        for file in [_ROOT / room] if room.endswith(".py") else sorted((_ROOT / room).rglob("*.py")):
            source = file.read_bytes()
            lines = source.splitlines(keepends=True)
            starts = [0, *accumulate(map(len, lines))]
            for at, old, new, statement in _changes(ast.parse(source), source, starts, (0, 0, "")):
                row = source.count(b"\n", 0, at)
                earlier = lines[:row].count(lines[row])
                number = f" #{earlier}" if earlier else ""
                place = f"{lines[row].decode().strip()} [{at - starts[row]}{number}]"
                yield Mutant(str(file.relative_to(_ROOT)), old, new, "", at, place, statement)


def _inner(node: ast.AST, around: _Statement) -> _Statement:
    """Return the innermost statement that a node belongs to."""
    name = around[2]
    match node:
        case ast.match_case(pattern, guard):
            return pattern.lineno, (guard or pattern).end_lineno or 0, name
        case ast.Match(subject):
            return node.lineno, subject.end_lineno or 0, name
        case ast.stmt():
            body = getattr(node, "body", None)
            last = max(node.lineno, body[0].lineno - 1) if body else node.end_lineno or 0
            target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
            defined = target.id if isinstance(target, ast.Name) else getattr(node, "name", "")
            return node.lineno, last, None if name is None else defined
    return around


def _changes(
    node: ast.AST, source: bytes, starts: list[int], around: _Statement
) -> Iterator[tuple[int, str, str, _Statement]]:
    """Yield position, text, replacement and statement of each change of a syntax tree. Types, decorators,
    texts and error messages are left out."""
    statement = _inner(node, around)

    def begin(part: ast.expr) -> int:
        return starts[part.lineno - 1] + part.col_offset

    def end(part: ast.expr) -> int:
        return starts[(part.end_lineno or 1) - 1] + (part.end_col_offset or 0)

    def between(left: ast.expr, right: ast.expr, operator: ast.AST) -> Iterator[tuple[int, str, str]]:
        old, new = _OPERATORS.get(type(operator), ("", ""))
        at = source.find(old.encode(), end(left), begin(right))
        if old and at >= 0:
            yield at, old, new

    def here() -> Iterator[tuple[int, str, str]]:
        match node:
            case ast.BinOp(left, operator, right):
                yield from between(left, right, operator)
            case ast.Compare(left, comparisons, rights):
                for one, comparison, other in zip((left, *rights), comparisons, rights, strict=False):
                    yield from between(one, other, comparison)
            case ast.BoolOp(operator, values):
                for one, other in pairwise(values):
                    yield from between(one, other, operator)
            case ast.UnaryOp(ast.Not() | ast.USub() as operator):
                yield begin(node), *_OPERATORS[type(operator)]
            case ast.Constant(bool() as value):
                yield begin(node), str(value), str(not value)
            case ast.Constant(int() | float() as value):
                old = source[begin(node) : end(node)].decode()
                yield begin(node), old, str(value + 1 if isinstance(value, int) else 2 * value or 1.0)

    if isinstance(node, ast.Raise | ast.JoinedStr):
        return
    yield from ((*change, statement) for change in here())
    for name, child in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        if name == "body" and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            statement = (0, 0, None)
        for part in child if isinstance(child, list) else [child]:
            if isinstance(part, ast.AST):
                yield from _changes(part, source, starts, statement)


@dataclass(frozen=True, slots=True)
class Coverage:
    """Lines of ROOMS that quick tests execute.

    Attributes:
        seconds: Time of each test.
        tests: The tests that execute a line, by file and line.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    tests: dict[str, dict[int, set[str]]] = field(default_factory=lambda: defaultdict(dict))

    def add(self, recorded: Path) -> None:
        """Add what `tests.without_numba` recorded."""
        content = json.loads(recorded.read_text())
        names = list(content["seconds"])
        self.seconds.update(content["seconds"])
        for path, lines in content["lines"].items():
            for line, numbers in lines.items():
                self.tests[path].setdefault(int(line), set()).update(names[k] for k in numbers)

    def of(self, mutant: Mutant) -> list[str]:
        """Return the tests of a mutant: those that execute its statement. A statement that runs at import has
        those that execute a line that mentions what it defines, or else any line of its file. The quickest
        tests are chosen, in the order of their files."""
        first, last, name = mutant.statement
        lines = self.tests[mutant.path]
        found = set().union(*(lines.get(line, ()) for line in range(first, last + 1)))
        if name:
            word = re.compile(rf"\b{name}\b")
            for path, by_line in self.tests.items():
                # An empty module is recorded with a line 0.
                text = dict(enumerate((_ROOT / path).read_text().splitlines(), 1))
                found.update(*(tests for line, tests in by_line.items() if word.search(text.get(line, ""))))
        if name is not None and not found:
            found.update(*lines.values())
        chosen, left_s = [], _TESTS_S
        for test in sorted(found, key=lambda test: (self.seconds[test], test)):
            left_s -= self.seconds[test]
            if left_s > 0.0:
                chosen.append(test)
        files = dict.fromkeys(test.split("::")[0] for test in chosen)
        return [test for file in files for test in chosen if test.startswith(f"{file}::")]


def recorded(folder: Path, tree: Path, minutes: float) -> Coverage:
    """Return the lines that quick tests execute. A file of tests is recorded once for each state of ROOMS
    and of itself. Files that mention ROOMS come first; what is left after so many minutes is not used."""
    state = _git("rev-parse", *(f"HEAD:{room}" for room in ROOMS))
    folder /= hashlib.sha256(state.encode()).hexdigest()[:12]
    folder.mkdir(parents=True, exist_ok=True)
    listed = _git("ls-tree", "-r", "HEAD", "tests/app", "tests/pipeline").splitlines()
    files = [(blob, path) for _, _, blob, path in map(str.split, listed) if "/test_" in path]
    rooms = re.compile("|".join(room.removesuffix(".py").replace("/", r"\.") for room in ROOMS))
    files.sort(key=lambda file: -len(rooms.findall((tree / file[1]).read_text())))
    found, used, end = Coverage(), 0, time.monotonic() + 60.0 * minutes
    for blob, path in files:
        lines = folder / f"{blob}.json"
        if not lines.exists() and time.monotonic() < end:
            begin, words = time.monotonic(), f"{path} -m 'not slow and not browser'"
            code = _exit_code(words, tree, test_limit_s=_RECORDED_S, lines=lines)
            print(f"recorded: {path}: {code}, {time.monotonic() - begin:.0f} s", flush=True)
        if lines.exists():
            found.add(lines)
            used += 1
    print(f"{len(found.seconds)} quick tests are recorded, of {used} of {len(files)} files", flush=True)
    return found


def main() -> None:
    """Run the mutants that have no result yet, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=_ROOT / ".mutation", help="folder of the results")
    parser.add_argument("--only", default="", help="run only mutants whose file or change contains this text")
    parser.add_argument("--minutes", type=float, help="run generated mutants for so long")
    parser.add_argument("--seed", type=int, default=0, help="of their order")
    parser.add_argument("--record-minutes", type=float, default=math.inf, help="record lines for so long")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    for library in _LIBRARIES:
        importlib.import_module(library)
    gc.freeze()  # a fork does not search them for garbage
    given.folder.mkdir(exist_ok=True)
    results = given.folder / "results.jsonl"
    commit = _git("rev-parse", "HEAD").strip()
    known: dict[str, str] = {}
    for line in results.read_text().splitlines() if results.exists() else []:
        key, outcome, of_commit = json.loads(line)
        if outcome in _KILLED or of_commit == commit:
            known[key] = outcome
    mutants = list(MUTANTS)
    if given.minutes is not None:
        mutants = list(generated())
        print(f"{len(mutants)} mutants are generated", flush=True)
        random.Random(given.seed).shuffle(mutants)
    wanted = [m for m in mutants if given.only in f"{m.path} {m.old} {m.new}"]
    with tempfile.TemporaryDirectory(dir=given.folder) as scratch:
        tree = Path(scratch).resolve() / "tree"
        _git("worktree", "add", "--detach", "--force", str(tree), "HEAD")
        for kernel in (*_ROOT.glob("app/**/*.nb[ci]"), *_ROOT.glob("pipeline/**/*.nb[ci]")):
            (tree / kernel.relative_to(_ROOT)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(kernel, tree / kernel.relative_to(_ROOT))
        try:
            lines = Coverage()
            if given.minutes is not None:
                lines = recorded(given.folder / "lines", tree, given.record_minutes)
            end = time.monotonic() + 60.0 * (given.minutes or math.inf)
            done: dict[Mutant, str] = {}
            for number, mutant in enumerate(wanted):
                key = _key(mutant)
                if key not in known:
                    if time.monotonic() > end:
                        break
                    known[key] = _outcome(mutant, tree, lines)
                    print(f"{number + 1}/{len(wanted)} {known[key]}: {key}", flush=True)
                    with results.open("a") as file:
                        file.write(json.dumps([key, known[key], commit]) + "\n")
                done[mutant] = known[key]
        finally:
            _git("worktree", "remove", "--force", str(tree))
    _report(done)


def _report(done: dict[Mutant, str]) -> None:
    """Print the outcomes by package, the share of killed mutants, and the other mutants."""
    for room in ROOMS:
        print(
            room, dict(Counter(outcome for mutant, outcome in done.items() if mutant.path.startswith(room)))
        )
    killed = sum(outcome in _KILLED for outcome in done.values())
    low, high = _wilson(killed, len(done))
    print(f"{killed} of {len(done)} mutants killed, 95 % interval {low:.1%} to {high:.1%}")
    for mutant, outcome in done.items():
        if outcome not in _KILLED:
            print(f"{outcome}: {_key(mutant)}")


def _wilson(successes: int, trials: int, z: float = 1.96) -> tuple[float, float]:
    """Return the interval of Wilson for a share."""
    if not trials:
        return 0.0, 1.0
    share = successes / trials
    half = z * (share * (1.0 - share) / trials + z**2 / (4.0 * trials**2)) ** 0.5
    middle, scale = share + z**2 / (2.0 * trials), 1.0 + z**2 / trials
    return (middle - half) / scale, (middle + half) / scale


def _key(mutant: Mutant) -> str:
    place = f"{mutant.path}: {mutant.place}" if mutant.place else mutant.path
    return f"{place}: {mutant.old} -> {mutant.new or '(nothing)'}"


def _outcome(mutant: Mutant, tree: Path, lines: Coverage) -> str:
    """Return "killed", "timeout", "survived", or why the mutant cannot be judged."""
    file = tree / mutant.path
    text = file.read_bytes()
    old, tests, limit_s, test_limit_s = mutant.old.encode(), mutant.tests, _LIMIT_S, 0.0
    at = text.find(old) if mutant.at < 0 else mutant.at
    if mutant.place:
        names = lines.of(mutant)
        if not names:
            return "no quick test executes it"
        chosen = tree / "tests.txt"
        chosen.write_text("\n".join(names) + "\n")
        tests, test_limit_s = f"@{chosen}", _MUTATED_S
        limit_s = _START_S + 10.0 * sum(lines.seconds[name] for name in names)
        if text[at : at + len(old)] != old:
            return "not applicable"
    elif text.count(old) != 1:
        return "not applicable"
    elif _exit_code_unchanged(tests, tree, tests in _WITH_NUMBA) != 0:
        return "its tests do not pass without it"
    times = file.stat()
    file.write_bytes(text[:at] + mutant.new.encode() + text[at + len(old) :])
    os.utime(
        file, (number := next(_NUMBERS), number)
    )  # else its byte code may count as that of another state
    try:
        code = _exit_code(tests, tree, tests in _WITH_NUMBA, limit_s, test_limit_s)
    finally:
        file.write_bytes(text)
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
    if code == 4 and _exit_code(f"{tests} --collect-only", tree) == 0:
        return "killed"  # the module of a test cannot be imported
    return {0: "survived", 1: "killed", 2: "killed", TIMEOUT: "timeout"}.get(code, f"pytest ends with {code}")


@cache
def _exit_code_unchanged(tests: str, tree: Path, compiled: bool) -> int:
    return _exit_code(tests, tree, compiled)


def _exit_code(
    tests: str,
    tree: Path,
    compiled: bool = False,
    limit_s: float = _LIMIT_S,
    test_limit_s: float = 0.0,
    lines: Path | None = None,
) -> int:
    """Return the exit code of pytest: 0 if all tests pass, 5 if none is selected, or TIMEOUT.

    Args:
        tests: Arguments of pytest.
        tree: Worktree.
        compiled: Whether kernels run under numba.
        limit_s: Longest time [s].
        test_limit_s: Longest computing time of a test, without limit if it is 0 [s].
        lines: File for the lines that the tests execute; all tests are run then, and none is mutated.
    """
    words = ["-n0", "-q", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    if not compiled:
        words += ["-p", "tests.without_numba", "-W", "ignore::RuntimeWarning"]
    if lines is None:
        words += ["-x"]
    else:
        # A test that is skipped in the middle may leave an exception in a destructor.
        words += ["-W", "ignore::pytest.PytestUnraisableExceptionWarning"]
        words += ["-W", "ignore::coverage.exceptions.CoverageWarning"]  # no line of ROOMS is executed
    settings = {
        "PYTHONPATH": str(tree),
        "STEMMAP_DATA": os.environ.get("STEMMAP_DATA", str(_ROOT.parent / "shared" / "data")),
        "NUMBA_DISABLE_JIT": str(int(not compiled)),
        "STEMMAP_TEST_LIMIT_S": str(test_limit_s),
        "STEMMAP_TEST_LINES": str(lines.resolve() if lines else ""),
    }
    process = multiprocessing.get_context("fork").Process(
        target=_run_pytest, args=([*words, *shlex.split(tests)], tree, settings)
    )
    process.start()
    try:
        process.join(limit_s)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid or 0, signal.SIGKILL)  # also the processes that its tests started
        process.join()
    return TIMEOUT if process.exitcode == -signal.SIGKILL else process.exitcode or 0


def _run_pytest(words: list[str], tree: Path, settings: dict[str, str]) -> None:
    """Run pytest in a worktree, in a process of its own group, and end the process with its exit code."""
    os.setpgid(0, 0)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.chdir(tree)
    with (tree.parent / "pytest.log").open("w") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    os.environ.update(settings)
    import numba
    import pytest

    numba.config.DISABLE_JIT = int(settings["NUMBA_DISABLE_JIT"])
    sys.path.insert(0, str(tree))
    for name in [name for name in sys.modules if name == "tests" or name.startswith("tests.")]:
        del sys.modules[name]
    sys.argv = ["pytest", *words]
    code = pytest.main(words)
    sys.stdout.flush()
    os._exit(code)


def _git(*arguments: str) -> str:
    return subprocess.run(
        ["git", *arguments],  # noqa: S607
        cwd=_ROOT, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip


if __name__ == "__main__":
    main()
