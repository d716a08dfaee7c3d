"""Mutation testing: `python -m tests.mutation [--folder DIR] [--only TEXT]`.

Each mutant changes one expression of the maths or of a check, in a scratch worktree of the committed state. A
mutant is killed if the tests named beside it fail. Results are stored as lines of JSON in the folder, so that
a run that was ended goes on where it was; the table is printed at the end. Kernels run without numba, so that
nothing is compiled.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_LIMIT_S = 900.0


@dataclass(frozen=True, slots=True)
class Mutant:
    """A change of the sources.

    Attributes:
        path: File.
        old, new: Text, which occurs once in the file, and its replacement.
        tests: Arguments of pytest that should notice it.
    """

    path: str
    old: str
    new: str
    tests: str


_SLAM = "tests/pipeline/slam"
_LOOP = "tests/pipeline/loop_closure"
_LANDMARKS, _GRAPH = "pipeline/slam/landmarks.py", "pipeline/slam/keyframe_graph.py"
_MERGED, _AUTH = "pipeline/io/checkpoints/merged_map.py", "app/web/auth.py"
_EVALUATION, _LIMITS_TESTS = (
    "tests/pipeline/evaluation/test_evaluation.py",
    "tests/app/common/test_limited_process.py",
)
_DETECTION, _SCORE = "pipeline/loop_closure/detection.py", "pipeline/evaluation/score.py"
_CLOCK, _CHUNKS = "pipeline/io/readers/message_time.py", "pipeline/io/readers/container.py"
_LIMITED = "app/common/limited_process.py"
_UPDATE = f"{_SLAM}/test_fastslam.py -k 'textbook or views or positive'"
_GRAPH_TESTS = f"{_SLAM}/test_keyframe_graph.py -k 'turns or turned or weight'"
_MERGED_TESTS = "tests/pipeline/io/test_merged_map.py"
_GUARD = "tests/app/web/test_auth.py -k 'resembles or foreign or names'"
_TIMES = "tests/pipeline/io/test_clock_steps.py"
#: Tests that map whole runs; their mutants are in modules without kernels.
_WITH_NUMBA = (_MERGED_TESTS,)

MUTANTS = (
    Mutant(_LANDMARKS, "VARIANCE_MIN, R0 / looks)", "VARIANCE_MIN)", _UPDATE),
    Mutant(_LANDMARKS, "VARIANCE_MIN, R2 / looks)", "VARIANCE_MIN)", _UPDATE),
    Mutant(_LANDMARKS, "k00 * R0 + k01 * R1, VARIANCE_MIN", "k00 * R0 + k01 * R1, 0.0", _UPDATE),
    Mutant(_LANDMARKS, "S0 + R0, S1 + R1, S2 + R2", "R0, R1, R2", _UPDATE),
    Mutant(_LANDMARKS, "0.5 * (k00 * R1", "-0.5 * (k00 * R1", _UPDATE),
    Mutant(
        "pipeline/slam/loop_correction.py",
        "rotated_rows(known.covariance, turn)",
        "rotated_rows(known.covariance, -turn)",
        f"{_LOOP}/test_loop_motion.py -k covariance",
    ),
    Mutant(
        "pipeline/slam/loop_correction.py",
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
    Mutant(_CHUNKS, "further_ns += max(due_ns, *newest.values()) - time_ns", "further_ns += time_ns", _TIMES),
    Mutant(
        _CHUNKS,
        "newest.get(message.channel, 0) - STEP_BACK_NS",
        "max(newest.values(), default=0) - STEP_BACK_NS",
        _TIMES,
    ),
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


def main() -> None:
    """Run the mutants that have no result yet, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=_ROOT / ".mutation", help="folder of the results")
    parser.add_argument("--only", default="", help="run only mutants whose file or change contains this text")
    given = parser.parse_args()
    given.folder.mkdir(exist_ok=True)
    results = given.folder / "results.jsonl"
    known = dict(map(json.loads, results.read_text().splitlines())) if results.exists() else {}
    wanted = [m for m in MUTANTS if given.only in f"{m.path} {m.old} {m.new}"]
    with tempfile.TemporaryDirectory(dir=given.folder) as scratch:
        tree = Path(scratch) / "tree"
        _git("worktree", "add", "--detach", "--force", str(tree), "HEAD")
        for kernel in (*_ROOT.glob("app/**/*.nb[ci]"), *_ROOT.glob("pipeline/**/*.nb[ci]")):
            (tree / kernel.relative_to(_ROOT)).parent.mkdir(exist_ok=True)
            shutil.copy2(kernel, tree / kernel.relative_to(_ROOT))
        try:
            for number, mutant in enumerate(wanted):
                if _key(mutant) in known:
                    continue
                known[_key(mutant)] = outcome = _outcome(mutant, tree)
                print(f"{number + 1}/{len(wanted)} {outcome}: {_key(mutant)}", flush=True)
                with results.open("a") as file:
                    file.write(json.dumps([_key(mutant), outcome]) + "\n")
        finally:
            _git("worktree", "remove", "--force", str(tree))
    outcomes = {_key(m): known[_key(m)] for m in wanted}
    print(f"{sum(o == 'killed' for o in outcomes.values())} of {len(outcomes)} mutants killed")
    for name, outcome in outcomes.items():
        if outcome != "killed":
            print(f"{outcome}: {name}")


def _key(mutant: Mutant) -> str:
    return f"{mutant.path}: {mutant.old} -> {mutant.new or '(nothing)'}"


def _outcome(mutant: Mutant, tree: Path) -> str:
    """Return "killed", "survived", or why the mutant cannot be judged."""
    file = tree / mutant.path
    text = file.read_text()
    if text.count(mutant.old) != 1:
        return "not applicable"
    if _exit_code_unchanged(mutant.tests, tree, mutant.tests in _WITH_NUMBA) != 0:
        return "its tests do not pass without it"
    file.write_text(text.replace(mutant.old, mutant.new))
    try:
        return "survived" if _exit_code(mutant.tests, tree, mutant.tests in _WITH_NUMBA) == 0 else "killed"
    except subprocess.TimeoutExpired:
        return "killed"
    finally:
        file.write_text(text)


@cache
def _exit_code_unchanged(tests: str, tree: Path, compiled: bool) -> int:
    return _exit_code(tests, tree, compiled)


def _exit_code(tests: str, tree: Path, compiled: bool) -> int:
    """Return the exit code of pytest: 0 if all tests pass, 5 if none is selected.

    Raises:
        subprocess.TimeoutExpired: It took longer than _LIMIT_S.
    """
    words = ["-n0", "-x", "-q", "-p", "no:cacheprovider", *shlex.split(tests)]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    if not compiled:
        words = ["-p", "tests.without_numba", "-W", "ignore::RuntimeWarning", *words]
        environment["NUMBA_DISABLE_JIT"] = "1"
    return subprocess.run(
        [sys.executable, "-m", "pytest", *words],
        cwd=tree, env=environment, capture_output=True, timeout=_LIMIT_S, check=False,
    ).returncode  # fmt: skip


def _git(*arguments: str) -> None:
    subprocess.run(["git", *arguments], cwd=_ROOT, check=True, capture_output=True)  # noqa: S607


if __name__ == "__main__":
    main()
