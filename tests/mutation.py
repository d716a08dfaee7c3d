"""Mutation testing: `python -m tests.mutation [--folder DIR] [--only TEXT] [--minutes M [--seed S]]`.

Each mutant changes one expression, in a scratch worktree of the committed state. It is killed if its tests
fail. Without --minutes, the mutants written by hand below are run, each with the tests named beside it. With
--minutes, mutants of every operator and number of ROOMS are run in a random order for so long, each with all
tests of its room that take less than two seconds without numba. Results are stored as lines of JSON in the
folder, so that a run that was ended goes on where it was; the table is printed at the end. Kernels run
without numba, so that nothing is compiled.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_LIMIT_S, _GENERATED_LIMIT_S = 900.0, 150.0


@dataclass(frozen=True, slots=True)
class Mutant:
    """A change of the sources.

    Attributes:
        path: File.
        old, new: Text, and its replacement.
        tests: Arguments of pytest that should notice it; for a generated mutant, its room.
        at: Position of the text [bytes]; -1 if it occurs once in the file.
        line: Its line, if it is generated.
    """

    path: str
    old: str
    new: str
    tests: str
    at: int = -1
    line: int = 0


_SLAM = "tests/pipeline/slam"
_LOOP = "tests/pipeline/loop_closure"
_LANDMARKS, _GRAPH = "pipeline/slam/particle_maps.py", "pipeline/slam/keyframe_graph.py"
_MERGED, _AUTH = "pipeline/io/checkpoints/merged_map.py", "app/web/auth.py"
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
_MERGED_TESTS = "tests/pipeline/io/test_merged_map.py"
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
        "G[i, a] * noise[a, b] * G[j, b]",
        "(noise[i, j] if a == i and b == j else 0.0)",
        f"{_SLAM}/test_fastslam.py -k 'noise_that_differs or drawn_motions'",
    ),
    Mutant(
        "pipeline/slam/motion.py",
        "F[i, a] * covariance[a, b] * F[j, b]",
        "(covariance[i, j] if a == i and b == j else 0.0)",
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
    Mutant(_CLOCK, "return abs(stamp_ns - message.log_ns", "return (stamp_ns - message.log_ns", _TIMES),
    Mutant(_CLOCK, "time_ns = message.log_ns + self.offset_ns", "time_ns = message.log_ns", _TIMES),
    Mutant(_CHUNKS, "max(due_ns, time[:first].max()) - time[first]", "time[:first].max()", _TIMES),
    Mutant(_CHUNKS, "flatnonzero(channel == number)", "arange(len(channel))", _TIMES),
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


#: Folders and files of which mutants are generated, and the tests that should notice them.
ROOMS = {
    "pipeline/slam": "tests/pipeline/slam",
    "pipeline/tracking": "tests/pipeline/tracking",
    "pipeline/detection": "tests/pipeline/detection",
    "pipeline/evaluation.py": "tests/pipeline/evaluation",
    "pipeline/geometry": "tests/pipeline/geometry tests/pipeline/evaluation tests/pipeline/preprocessing "
    "tests/pipeline/tracking tests/pipeline/slam/test_joint_association.py "
    "tests/pipeline/slam/test_measured_pose.py",
    "app/web/auth.py": "tests/app/web/test_auth.py",
    "app/store": "tests/app/store",
    "pipeline/io/readers": "tests/pipeline/io",
}
_OPERATORS = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "*"), ast.Mod: ("%", "*"), ast.MatMult: ("@", "+"),
    ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"), ast.LShift: ("<<", ">>"), ast.RShift: (">>", "<<"),
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"), ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"),
    ast.And: ("and", "or"), ast.Or: ("or", "and"), ast.Not: ("not ", ""), ast.USub: ("-", "+"),
}  # fmt: skip


def generated() -> Iterator[Mutant]:
    """Yield the mutants of all operators, numbers and truth values of ROOMS."""
    for room in ROOMS:
        files = [_ROOT / room] if room.endswith(".py") else sorted((_ROOT / room).rglob("*.py"))
        for file in files:
            source = file.read_bytes()
            starts = [0]
            for line in source.splitlines(keepends=True):
                starts.append(starts[-1] + len(line))
            for line_number, at, old, new in _changes(ast.parse(source), source, starts):
                yield Mutant(str(file.relative_to(_ROOT)), old, new, room, at, line_number)


def _changes(node: ast.AST, source: bytes, starts: list[int]) -> Iterator[tuple[int, int, str, str]]:
    """Yield line, position, text and replacement of each change of a syntax tree. Types, decorators, texts
    and error messages are left out."""

    def begin(part: ast.expr) -> int:
        return starts[part.lineno - 1] + part.col_offset

    def between(left: ast.expr, right: ast.expr, operator: ast.AST) -> Iterator[tuple[int, int, str, str]]:
        old, new = _OPERATORS.get(type(operator), ("", ""))
        end = starts[(left.end_lineno or 1) - 1] + (left.end_col_offset or 0)
        at = source.find(old.encode(), end, begin(right))
        if old and at >= 0:
            yield left.end_lineno or 1, at, old, new

    match node:
        case ast.Raise() | ast.JoinedStr():
            return
        case ast.BinOp(left, operator, right):
            yield from between(left, right, operator)
        case ast.Compare(left, comparisons, rights):
            for one, comparison, other in zip((left, *rights), comparisons, rights, strict=False):
                yield from between(one, other, comparison)
        case ast.BoolOp(operator, values):
            for one, other in pairwise(values):
                yield from between(one, other, operator)
        case ast.UnaryOp(ast.Not() | ast.USub() as operator):
            yield node.lineno, begin(node), *_OPERATORS[type(operator)]
        case ast.Constant(bool() as value):
            yield node.lineno, begin(node), str(value), str(not value)
        case ast.Constant(int() | float() as value):
            length = (node.end_col_offset or 0) - node.col_offset
            old = source[begin(node) : begin(node) + length].decode()
            yield (
                node.lineno,
                begin(node),
                old,
                str(value + 1 if isinstance(value, int) else 2 * value or 1.0),
            )
    for name, child in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for part in child if isinstance(child, list) else [child]:
            if isinstance(part, ast.AST):
                yield from _changes(part, source, starts)


def main() -> None:
    """Run the mutants that have no result yet, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=_ROOT / ".mutation", help="folder of the results")
    parser.add_argument("--only", default="", help="run only mutants whose file or change contains this text")
    parser.add_argument("--minutes", type=float, help="run generated mutants for so long")
    parser.add_argument("--seed", type=int, default=0, help="of their order")
    given = parser.parse_args()
    given.folder.mkdir(exist_ok=True)
    results = given.folder / "results.jsonl"
    known = dict(map(json.loads, results.read_text().splitlines())) if results.exists() else {}
    mutants = list(MUTANTS)
    if given.minutes is not None:
        mutants = list(generated())
        print(f"{len(mutants)} mutants are generated", flush=True)
        random.Random(given.seed).shuffle(mutants)
    wanted = [m for m in mutants if given.only in f"{m.path} {m.old} {m.new}"]
    end = time.monotonic() + 60.0 * (given.minutes or float("inf"))
    with tempfile.TemporaryDirectory(dir=given.folder) as scratch:
        tree = Path(scratch) / "tree"
        _git("worktree", "add", "--detach", "--force", str(tree), "HEAD")
        for kernel in (*_ROOT.glob("app/**/*.nb[ci]"), *_ROOT.glob("pipeline/**/*.nb[ci]")):
            (tree / kernel.relative_to(_ROOT)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(kernel, tree / kernel.relative_to(_ROOT))
        try:
            for number, mutant in enumerate(wanted):
                if _key(mutant) in known:
                    continue
                if time.monotonic() > end:
                    break
                known[_key(mutant)] = outcome = _outcome(mutant, tree, given.folder)
                print(f"{number + 1}/{len(wanted)} {outcome}: {_key(mutant)}", flush=True)
                with results.open("a") as file:
                    file.write(json.dumps([_key(mutant), outcome]) + "\n")
        finally:
            _git("worktree", "remove", "--force", str(tree))
    done = [mutant for mutant in wanted if _key(mutant) in known]
    rooms = dict.fromkeys(m.tests if m.line else "by hand" for m in done)
    for room in rooms:
        outcomes = [known[_key(m)] for m in done if room in (m.tests, "by hand")]
        print(f"{room}: {outcomes.count('killed')} of {len(outcomes)} killed")
    print(f"{sum(known[_key(m)] == 'killed' for m in done)} of {len(done)} mutants killed")
    for mutant in done:
        if known[_key(mutant)] != "killed":
            print(f"{known[_key(mutant)]}: {_key(mutant)}")


def _key(mutant: Mutant) -> str:
    place = f"{mutant.path}:{mutant.line}@{mutant.at}" if mutant.line else mutant.path
    return f"{place}: {mutant.old} -> {mutant.new or '(nothing)'}"


def _outcome(mutant: Mutant, tree: Path, folder: Path) -> str:
    """Return "killed", "survived", or why the mutant cannot be judged."""
    file = tree / mutant.path
    text = file.read_bytes()
    old, tests, limit_s = mutant.old.encode(), mutant.tests, _LIMIT_S
    at = text.find(old) if mutant.at < 0 else mutant.at
    if mutant.line:
        tests, limit_s = _quick_tests(mutant, tree, folder), _GENERATED_LIMIT_S
        if text[at : at + len(old)] != old:
            return "not applicable"
    elif text.count(old) != 1:
        return "not applicable"
    elif _exit_code_unchanged(tests, tree, tests in _WITH_NUMBA) != 0:
        return "its tests do not pass without it"
    file.write_bytes(text[:at] + mutant.new.encode() + text[at + len(old) :])
    try:
        code = _exit_code(tests, tree, tests in _WITH_NUMBA, limit_s)
        # A test fails, or a module cannot be imported; other codes are errors of the call.
        return {0: "survived", 1: "killed", 2: "killed"}.get(code, f"pytest ends with {code}")
    except subprocess.TimeoutExpired:
        return "killed"
    finally:
        file.write_bytes(text)


def _quick_tests(mutant: Mutant, tree: Path, folder: Path) -> str:
    """Return the argument of pytest for the quick tests of a room, those of the file of the mutant first.
    They are found by a run without any change, whose result is kept in the folder."""
    known = folder / f"{mutant.tests.replace('/', '-')}.txt"
    if not known.exists():
        words = f"{ROOMS[mutant.tests]} -m 'not slow and not browser'"
        _exit_code(words, tree, compiled=False, limit_s=3600.0, quick=known)
    names = known.read_text().splitlines()
    names.sort(key=lambda name: Path(mutant.path).stem not in name)
    ordered = folder / "tests.txt"
    ordered.write_text("\n".join(names) + "\n")
    return f"@{ordered.resolve()}"


@cache
def _exit_code_unchanged(tests: str, tree: Path, compiled: bool) -> int:
    return _exit_code(tests, tree, compiled)


def _exit_code(
    tests: str, tree: Path, compiled: bool, limit_s: float = _LIMIT_S, quick: Path | None = None
) -> int:
    """Return the exit code of pytest: 0 if all tests pass, 5 if none is selected.

    Args:
        tests: Arguments of pytest.
        tree: Worktree.
        compiled: Whether kernels run under numba.
        limit_s: Longest time [s].
        quick: File for the names of the tests that pass and are quick; all tests are run then.

    Raises:
        subprocess.TimeoutExpired: It took longer.
    """
    words = ["-n0", "-q", "-p", "no:cacheprovider", *shlex.split(tests)]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    if not compiled:
        words = ["-p", "tests.without_numba", "-W", "ignore::RuntimeWarning", *words]
        environment["NUMBA_DISABLE_JIT"] = "1"
    if quick is None:
        words.insert(0, "-x")
    else:
        # A test that is skipped in the middle may leave an exception in a destructor.
        words += ["-W", "ignore::pytest.PytestUnraisableExceptionWarning"]
        environment["STEMMAP_QUICK_TESTS"] = str(quick.resolve())
    return subprocess.run(
        [sys.executable, "-m", "pytest", *words],
        cwd=tree, env=environment, capture_output=True, timeout=limit_s, check=False,
    ).returncode  # fmt: skip


def _git(*arguments: str) -> None:
    subprocess.run(["git", *arguments], cwd=_ROOT, check=True, capture_output=True)  # noqa: S607


if __name__ == "__main__":
    main()
