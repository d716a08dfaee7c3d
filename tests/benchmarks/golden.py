"""Regression check of complete runs: `python -m tests.benchmarks golden`.

The script maps a fixed list of sources with the command `stemmap map` of the present environment and compares
the SHA-256 digest of each output file with `golden.json`. `--write` stores the present digests and key
figures there, `--only` selects sources, `--out` keeps the output files. The exit code is 1 if an output
differs.

Two parts of the output are excluded from the digests: the version in `run.json`, and the paths of the data
folder and of temporary folders, which are replaced by a fixed word. The digests are those of one type of
processor: sums of vectorised loops can differ in the last bit between two types, see `compiled_sums`.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

GOLDEN = Path(__file__).with_name("golden.json")
DATA = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[3] / "shared" / "data")).resolve()
DATA_WORD, FOLDER_WORD = b"DATA", b"FOLDER"  # these words replace the paths of this machine
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
RUN_RECORD, STATE, STATE_TREE = "run.json", "state.zip", "tree.json"
OXFORD_EVERY, OXFORD_SEED = 5, 1
MOST_SHOWN = 3  # lines of an error that are printed

Figures = dict[str, float | int | None]


class SkippedError(Exception):
    """A source cannot be mapped here; the message states the reason."""


@dataclass(frozen=True, slots=True)
class Source:
    """A source and the flags with which it is mapped.

    Attributes:
        place: URI of a simulated run, path relative to the data folder, or empty where `prepare` writes the
            source.
        flags: Further words of the command.
        prepare: Writes the source into an empty folder.
        path_rms: Error of the path [m] where `run.json` reports none, from the folder of the results.
    """

    place: str
    flags: tuple[str, ...] = ()
    prepare: Callable[[Path], None] | None = None
    path_rms: Callable[[Path], float] | None = None


@dataclass(frozen=True, slots=True)
class Result:
    """Digests of the output files by name, the key figures, and the duration of the command [s]."""

    files: dict[str, str]
    figures: Figures
    seconds: float = field(default=0.0, compare=False)


# --- sources --------------------------------------------------------------------------------------


def _write_oxford(folder: Path) -> None:
    """Write the Oxford Evo stems, every fifth frame, with perturbed odometry (see `cases.oxford`)."""
    from app.extensions.formats.tree_manager import TRAJECTORY, trajectory_text
    from tests.benchmarks.cases.oxford import BIAS, DISTANCE, TURN
    from tests.benchmarks.tree_manager_folder import perturbed, read_recorded, write_states

    recorded = read_recorded(_evo())
    write_states(recorded, folder, OXFORD_EVERY)
    rng = np.random.default_rng(OXFORD_SEED)
    odometry = perturbed(
        recorded.poses, distance=DISTANCE, turn=np.radians(TURN), bias=np.radians(BIAS), rng=rng
    )
    (folder / TRAJECTORY).write_text(trajectory_text(recorded.stamp_ns, odometry), encoding="utf-8")


def _oxford_rms(out: Path) -> float:
    """RMS error of the path after rigid alignment in the plane [m]."""
    with (out / "path.csv").open(encoding="utf-8") as file:
        path = np.array([[float(row["x_m"]), float(row["y_m"])] for row in csv.DictReader(file)])
    truth = np.load(_evo())["trajectory"][:, 1:3]
    path, truth = path - path.mean(axis=0), truth - truth.mean(axis=0)
    left, _, right = np.linalg.svd(path.T @ truth)
    turn = left @ np.diag([1.0, np.linalg.det(left @ right)]) @ right
    return float(np.sqrt(np.mean(np.sum((path @ turn - truth) ** 2, axis=1))))


def _evo() -> Path:
    file = DATA / "oxford_evo" / "Evo.npz"
    if not file.is_file():
        raise SkippedError("oxford_evo/Evo.npz is absent; set STEMMAP_DATA")
    return file


SOURCES: dict[str, Source] = {
    "sim_paper": Source("sim:paper", ("--preset", "paper")),
    "sim_stand": Source("sim:stand"),
    "sim_slope": Source("sim:slope"),
    "sim_dense": Source("sim:dense"),
    "sim_long": Source("sim:long?duration=60"),
    "kitti": Source("kitti"),
    "park_00": Source("park_trunks/00"),
    "victoria_park": Source("victoria_park/victoria_park_ascii.zip", ("--preset", "laser2d", "--seed", "1")),
    "oxford_every_5": Source("", ("--seed", str(OXFORD_SEED)), prepare=_write_oxford, path_rms=_oxford_rms),
    "pine_plot": Source("forest/pine_plot.laz"),
}


# --- one run --------------------------------------------------------------------------------------


def mapped(source: Source, out: Path) -> Result:
    """Map a source into a folder and return its digests and key figures.

    Raises:
        SkippedError: The data is absent.
        RuntimeError: The command failed.
    """
    with tempfile.TemporaryDirectory(prefix="stemmap-golden-") as folder:
        place = _place(source, Path(folder))
        command = [_console_script(), "map", place, *source.flags, "--out", str(out), "--force"]
        environment = {**dict.fromkeys(THREADS, "1"), **os.environ}
        begin = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        seconds = time.perf_counter() - begin
        out.with_name(f"{out.name}.stdout").write_text(done.stdout, encoding="utf-8")
        out.with_name(f"{out.name}.stderr").write_text(done.stderr, encoding="utf-8")
        if done.returncode not in (0, 3):  # 3: a part of the input was left out
            lines = done.stderr.strip().splitlines()[-MOST_SHOWN:]
            raise RuntimeError(f"exit code {done.returncode}: {' / '.join(lines)}")
        words = {folder.encode(): FOLDER_WORD, str(DATA).encode(): DATA_WORD}
        files = {path.relative_to(out).as_posix(): path for path in sorted(out.rglob("*")) if path.is_file()}
        digests = {name: _digest(path, words) for name, path in files.items()}
    return Result(digests, _figures(source, out), seconds)


def _place(source: Source, folder: Path) -> str:
    """The source as the command takes it."""
    if source.prepare is not None:
        source.prepare(folder)
        return str(folder)
    if source.place.startswith("sim:"):
        return source.place
    if not (DATA / source.place).exists():
        raise SkippedError(f"{source.place} is absent; set STEMMAP_DATA")
    return str(DATA / source.place)


def _console_script() -> str:
    """The command `stemmap` of the environment of this Python."""
    script = shutil.which("stemmap", path=str(Path(sys.executable).parent))
    if script is None:
        raise SystemExit("the command stemmap is not installed beside this Python")
    return script


def _digest(path: Path, words: Mapping[bytes, bytes]) -> str:
    """SHA-256 of a file without version and machine paths; of an archive, of its members."""
    data = path.read_bytes()
    if path.name == STATE:
        digest = hashlib.sha256()
        with zipfile.ZipFile(path) as archive:
            for name in sorted(archive.namelist()):
                member = archive.read(name)
                digest.update(_replaced(member, words) if name == STATE_TREE else member)
        return digest.hexdigest()
    if path.name == RUN_RECORD:
        record = json.loads(_replaced(data, words))
        record.pop("stemmap")
        data = json.dumps(record, sort_keys=True).encode()
    return hashlib.sha256(data).hexdigest()


def _replaced(data: bytes, words: Mapping[bytes, bytes]) -> bytes:
    for path, word in words.items():
        data = data.replace(path, word)
    return data


def _figures(source: Source, out: Path) -> Figures:
    """Key figures of a run; those for which no truth is known are None."""
    record: dict[str, Any] = json.loads((out / RUN_RECORD).read_text(encoding="utf-8"))
    trees, path = record.get("evaluation") or {}, record.get("path_error") or {}
    rms = source.path_rms(out) if source.path_rms else path.get("rms")
    figures: Figures = {
        "trees": record["trees"],
        "matched": (trees.get("TA") or {}).get("count"),
        "F1": trees.get("f1"),
        "DBH RMSE [m]": trees.get("dbh_rmse"),
        "ATE RMS [m]": rms,
    }
    return {name: round(value, 6) if isinstance(value, float) else value for name, value in figures.items()}


# --- all runs -------------------------------------------------------------------------------------


def read_golden() -> dict[str, Result]:
    """The stored results by source."""
    if not GOLDEN.is_file():
        return {}
    stored = json.loads(GOLDEN.read_text(encoding="utf-8"))
    return {name: Result(entry["files"], entry["figures"]) for name, entry in stored.items()}


def write_golden(results: Mapping[str, Result]) -> None:
    """Store results in the order of SOURCES."""
    plain = {
        name: {"files": results[name].files, "figures": results[name].figures}
        for name in SOURCES
        if name in results
    }
    GOLDEN.write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")


def compared(name: str, then: Result | None, now: Result) -> list[str]:
    """Lines of the table for one source."""
    if then is None:
        return [f"{name:<16} not stored  {now.seconds:7.1f} s"]
    if then == now:
        return [f"{name:<16} same        {now.seconds:7.1f} s"]
    names = {**then.files, **now.files}
    differ = [file for file in names if then.files.get(file) != now.files.get(file)]
    lines = [f"{name:<16} differs     {now.seconds:7.1f} s  {', '.join(differ)}"]
    for figure in {**then.figures, **now.figures}:
        before, after = then.figures.get(figure), now.figures.get(figure)
        mark = "" if before == after else "  *"
        lines.append(f"    {figure:<14} then {_shown(before):>10}  now {_shown(after):>10}{mark}")
    return lines


def _shown(value: float | int | None) -> str:
    return "-" if value is None else f"{value:.6g}"


def main(words: Sequence[str] | None = None) -> int:
    """Map the sources and print the table; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", choices=tuple(SOURCES), help="these sources only"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="keep the output files in this folder")
    parser.add_argument("--write", action="store_true", help=f"store the results in {GOLDEN.name}")
    arguments = parser.parse_args(words)
    stored, failed = read_golden(), False
    with tempfile.TemporaryDirectory(prefix="stemmap-golden-") as temporary:
        folder = (arguments.out or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        for name in arguments.only or SOURCES:
            try:
                result = mapped(SOURCES[name], folder / name)
            except SkippedError as reason:
                print(f"{name:<16} skipped: {reason}", flush=True)
                continue
            except RuntimeError as reason:
                print(f"{name:<16} failed: {reason}", flush=True)
                failed = True
                continue
            print("\n".join(compared(name, stored.get(name), result)), flush=True)
            failed = failed or (not arguments.write and stored.get(name) != result)
            if arguments.write:
                stored[name] = result
                write_golden(stored)
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
