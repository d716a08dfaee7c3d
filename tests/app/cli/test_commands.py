"""The command line: what it says, what it returns, and that it never answers with a traceback."""

from __future__ import annotations

import json
import os
import py_compile
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.cli import COMMANDS, _check_command, flags, main
from app.cli import map as map_command
from app.common.text import COMPILING
from pipeline.config import field_specs, from_toml, preset
from pipeline.jit import on_compiling, others_compile
from pipeline.odometry.lidar_odometry import LOST
from pipeline.types.records import Notice, Scan

RUN = "sim:paper?duration=2"


class Told:
    """What a command said and returned."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err

    def refused(self, code: int, *says: str) -> None:
        """It ended with a code and one clear line on stderr, and wrote nothing to stdout."""
        assert (self.code, self.out) == (code, ""), self.err
        assert self.err.count("\n") == 1, self.err
        assert self.err.startswith("stemmap")
        for words in says:
            assert words in self.err


def stemmap(capsys: pytest.CaptureFixture[str], *words: object) -> Told:
    """Run a command in this process."""
    code = main([str(word) for word in words])
    told = capsys.readouterr()
    return Told(code, told.out, told.err)


def test_an_option_that_is_mistyped_is_named(capsys):
    stemmap(capsys, "map", RUN, "--out", "x", "--presset", "forest").refused(
        2, "stemmap map does not know --presset", "Did you mean --preset?"
    )


def test_a_second_source_is_refused_with_what_to_do(capsys):
    stemmap(capsys, "info", RUN, "sim:stand").refused(
        2, "stemmap info takes one SOURCE, and sim:stand is one more", "Call it again for sim:stand."
    )
    told = stemmap(capsys, "merge", "a", "b", "c", "--out", "d")
    told.refused(2, "takes one DIR_A and one DIR_B, and c is one more")


def test_compilation_is_reported_once_and_then_its_progress(capsys, monkeypatch):
    monkeypatch.setattr("pipeline.jit.on_compiling", on_compiling)  # which tests/conftest.py replaces
    now, compiled = [0.0], [0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    monkeypatch.setattr("app.worker.numba_warmup.compiled_kernels", lambda: (compiled[0], 200))
    with flags.compilation_notice():
        for now[0], compiled[0] in ((0.0, 20), (9.0, 40), (10.0, 50), (15.0, 60), (20.0, 200)):
            others_compile()
    assert capsys.readouterr().err.splitlines() == [COMPILING, "25 % of the kernels are compiled"]


@pytest.mark.parametrize(("scans", "of"), [(406, " of 406"), (None, "")])
def test_progress_in_a_file_is_a_line_every_ten_seconds(capsys, monkeypatch, scans, of):
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    scan = Scan(0, np.zeros((0, 3), np.float32))
    records = (Notice(0, "") if k % 2 else scan for k in range(48))
    shown = flags.with_progress(records, scans, "simulating sim:stand")
    for now[0], _ in enumerate(shown):
        pass
    assert capsys.readouterr().err.splitlines() == [
        f"simulating sim:stand: scan {n}{of}" for n in (6, 11, 16, 21)
    ]


def test_a_request_to_stop_that_came_while_kernels_were_loaded_is_one(capsys, monkeypatch):
    def ended(_arguments):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as stop:
            raise SystemError("returned a result with an exception set") from stop

    monkeypatch.setattr("app.cli.params.run", ended)
    stemmap(capsys, "params").refused(1, "stopped")


@pytest.mark.parametrize("ask", [signal.SIGINT, signal.SIGTERM])
def test_a_request_to_stop_that_came_inside_of_the_compiler_is_not_lost(capsys, monkeypatch, ask):
    import llvmlite.binding as llvm

    written = []

    def compile_one(_arguments):
        def in_a_call_from_c(_module, _code):
            signal.raise_signal(ask)
            written.append("object")

        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        module = llvm.parse_assembly("define i32 @one() { ret i32 1 }")
        engine = llvm.create_mcjit_compiler(module, llvm.Target.from_default_triple().create_target_machine())
        engine.set_object_cache(in_a_call_from_c)
        engine.finalize_object()
        written.append("kernel")
        time.sleep(20.0)
        written.append("result")

    monkeypatch.setattr("app.cli.params.run", compile_one)
    inherited, begin = signal.signal(signal.SIGINT, signal.default_int_handler), time.monotonic()
    try:
        stemmap(capsys, "params").refused(1, "stopped")
    finally:
        signal.signal(signal.SIGINT, inherited)
    assert written[0] == "object"
    assert "result" not in written
    assert time.monotonic() - begin < 15.0, "a call that waits was not woken"


@pytest.mark.parametrize("step", ["problems", "_build_parser"])
def test_a_request_to_stop_before_the_command_runs_is_told_in_a_line(capsys, monkeypatch, step):
    def stopped(_=None):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"app.cli.{step}", stopped)
    stemmap(capsys, "params").refused(1, "stopped")


# --- help -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_has_help_that_a_person_can_follow(capsys, name):
    told = stemmap(capsys, name, "--help")
    assert told.code == 0
    assert told.out.startswith(f"usage: stemmap {name}")
    assert told.err == ""
    assert max(map(len, told.out.splitlines())) <= 130


def test_the_version_is_that_of_the_distribution(capsys):
    from importlib.metadata import version

    assert stemmap(capsys, "--version").out == f"stemmap {version('stemmap')}\n"


@pytest.mark.parametrize(
    "words",
    [["map", RUN], ["map", RUN, "--out", "x", "--seed", "-1"], ["evaluate"], ["serve", "--port", "70000"]],
    ids=" ".join,
)
def test_wrong_words_are_wrong_usage(capsys, words):
    stemmap(capsys, *words).refused(2, "--help")


# --- parameters -----------------------------------------------------------------------------------


def test_a_file_of_parameters_goes_in_as_it_came_out(capsys, tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(stemmap(capsys, "params", "--set", "clustering.eps=0.31", "--format", "toml").out)
    told = stemmap(capsys, "params", "--config", file, "--set", "slam.particles=7", "--format", "toml")
    assert from_toml(told.out, preset("paper"), "x").changes_from(preset("forest")) == {
        "clustering.eps": 0.31,
        "slam.particles": 7,
    }


def test_the_table_names_every_parameter_with_its_value(capsys):
    told = stemmap(capsys, "params", "--preset", "paper")
    for spec in field_specs():
        assert f"{spec.name} = {preset('paper').flat()[spec.name]}   [" in told.out
        assert spec.doc in told.out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--set", "clustering.eps=9"], ["clustering.eps = 9", "less than or equal to 5"]),
        (["--preset", "wood"], ["wood", "forest"]),
        (["--config", "none.toml"], ["none.toml"]),
    ],
    ids=str,
)
def test_a_parameter_that_does_not_fit_is_wrong_usage(capsys, tmp_path, monkeypatch, words, says):
    monkeypatch.chdir(tmp_path)
    stemmap(capsys, "map", RUN, "--out", tmp_path / "out", *words).refused(2, *says)
    assert not (tmp_path / "out").exists()


# --- sources --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "code", "says"),
    [
        ("sim:wood", 2, "sim:stand"),
        ("sim:paper?speed=3", 2, "speed"),
        ("none.mcap", 1, "no such file"),
        ("ftp://host/x", 2, "ftp"),
    ],
)
def test_a_source_that_is_none_fails_in_one_line(capsys, tmp_path, monkeypatch, source, code, says):
    monkeypatch.chdir(tmp_path)
    stemmap(capsys, "map", source, "--out", "out").refused(code, says)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["a.mcap", "a"])
@pytest.mark.parametrize("content", [b"", b"\0" * 5000, b"hello world\n" * 99])
def test_a_file_that_is_no_recording_fails_in_one_line(capsys, tmp_path, name, content):
    file = tmp_path / name
    file.write_bytes(content)
    stemmap(capsys, "map", file, "--out", tmp_path / "out").refused(1)
    assert not (tmp_path / "out").exists()


def test_a_table_of_truth_that_is_none_fails_before_the_mapping(capsys, tmp_path):
    file = tmp_path / "truth.csv"
    file.write_text("x,y\n1,abc\n")
    told = stemmap(capsys, "map", RUN, "--out", tmp_path / "out", "--truth", file)
    told.refused(1, "line 2", "abc", "truth.csv")
    stemmap(capsys, "map", RUN, "--out", tmp_path / "out", "--truth", tmp_path / "no.csv").refused(
        1, "no.csv"
    )
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_made_fails_in_one_line(capsys, tmp_path):
    (tmp_path / "file").write_text("x")
    stemmap(capsys, "map", RUN, "--out", tmp_path / "file").refused(1, "cannot read or write")
    stemmap(capsys, "map", RUN, "--out", tmp_path / "file" / "below").refused(1, "cannot read or write")


@pytest.mark.parametrize(("word", "meant"), [("mpa", "map")])
def test_a_mistyped_command_is_named(capsys, tmp_path, monkeypatch, word, meant):
    monkeypatch.chdir(tmp_path)
    stemmap(capsys, word, RUN, "--out", "out").refused(2, f"no command '{word}'", f"`stemmap {meant}`")
    stemmap(capsys, word).refused(2, f"`stemmap {meant}`")


def test_an_address_is_not_a_mistyped_command():
    _check_command(["serve", "sim:stand"])  # there is a command stand


@pytest.mark.parametrize("ask", ["SIGINT", "SIGTERM"])
def test_a_mapping_that_is_stopped_leaves_nothing_half_written(tmp_path, capsys, monkeypatch, ask):
    from pipeline.io.result_files import RunFiles

    add, scans = RunFiles.add, []

    def then_stop(self, frame, start_ns):
        add(self, frame, start_ns)
        scans.append(frame.index)
        if len(scans) == 3:
            os.kill(os.getpid(), getattr(signal, ask))

    monkeypatch.setattr(RunFiles, "add", then_stop)
    before = signal.getsignal(signal.SIGTERM)
    # A shell that starts the tests in the background has them ignore Ctrl-C.
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        stemmap(capsys, "map", RUN, "--out", tmp_path / "out").refused(1, "stopped")
    finally:
        signal.signal(signal.SIGINT, inherited)
    assert signal.getsignal(signal.SIGTERM) is before
    assert scans[:3] == [0, 1, 2]
    assert not (tmp_path / "out").exists()


def test_a_source_without_a_file_is_not_served(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stemmap(capsys, "serve", "none.mcap").refused(1, "none.mcap")
    stemmap(capsys, "none.mcap").refused(1, "none.mcap")


# --- map and evaluate -----------------------------------------------------------------------------

FILES = {
    "trees.csv", "path.csv", "trees.geojson", "detections.csv", "terrain.csv", "seen.csv", "run.json",
    "state.zip",
}  # fmt: skip


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of four seconds, mapped once."""
    folder = tmp_path_factory.mktemp("mapped") / "run"
    assert main(["map", "sim:paper?duration=4", "--out", str(folder)]) == 0
    return folder


@pytest.mark.parametrize("reach", ["2.5", "2.9"])
def test_a_short_run_without_ground_is_not_called_good(tmp_path, capsys, reach):
    """A second is too short for a fault that lasts. Within 2.5 m there is no return, within 2.9 m too few."""
    limits = ("--set", f"acquisition.range_max={reach}")
    told = stemmap(capsys, "map", "sim:stand?duration=1", *limits, "--out", tmp_path)
    assert told.code == 3
    assert "the map is doubtful in the whole run" in told.err + told.out


def test_mapping_twice_gives_the_same_bytes(mapped, tmp_path, capsys):
    told = stemmap(capsys, "map", "sim:paper?duration=4", "--out", tmp_path)
    assert told.code == 0
    assert {file.name for file in mapped.iterdir()} == FILES == {file.name for file in tmp_path.iterdir()}
    for name in FILES:
        assert (mapped / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_another_seed_gives_other_bytes(mapped, tmp_path, capsys):
    assert stemmap(capsys, "map", "sim:paper?duration=4", "--out", tmp_path, "--seed", "1").code == 0
    assert (mapped / "path.csv").read_bytes() != (tmp_path / "path.csv").read_bytes()


def test_the_record_holds_what_is_needed_to_map_again(mapped):
    record = json.loads((mapped / "run.json").read_text())
    assert record["source"]["uri"] == "sim:paper?duration=4"
    assert len(record["source"]["sha256"]) == 64
    assert record["seed"] == 0
    assert (record["preset"], record["changed"]) == ("forest", {})
    assert record["parameters"] == json.loads(json.dumps(preset("forest").model_dump()))
    assert record["scans"] == 40
    assert record["duration_s"] == 3.9
    points = record["points"]
    assert sum(points.values()) - points["without a value"] == 2 * points["returns"]
    rows = (mapped / "detections.csv").read_text().splitlines()[1:]
    assert sum(record["verdicts"].values()) == len(rows)
    assert record["trees"] == len((mapped / "trees.csv").read_text().splitlines()) - 1
    assert len((mapped / "path.csv").read_text().splitlines()) == 41


def test_what_differs_from_the_preset_is_said_and_recorded(tmp_path, capsys):
    (tmp_path / "mine.toml").write_text("[slam]\nparticles = 7\n")
    words = ["--config", tmp_path / "mine.toml", "--set", "clustering.eps=0.2", "--preset", "forest"]
    told = stemmap(capsys, "map", RUN, "--out", tmp_path / "out", *words)
    assert "preset forest with clustering.eps = 0.2, slam.particles = 7" in told.out.splitlines()
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["changed"] == {"clustering.eps": 0.2, "slam.particles": 7}
    assert stemmap(capsys, "params", *words).out.startswith("Preset forest with clustering.eps = 0.2, slam.")
    assert "preset forest" in stemmap(capsys, "map", RUN, "--out", tmp_path / "out").out.splitlines()


def test_evaluating_again_says_what_the_mapping_said(mapped, capsys):
    told = stemmap(capsys, "evaluate", mapped, "--json")
    assert json.loads(told.out) == json.loads((mapped / "run.json").read_text())["evaluation"]


def test_evaluating_by_a_table_and_by_other_distances(mapped, tmp_path, capsys):
    from pipeline.simulation.scenarios import SCENARIOS

    table = tmp_path / "truth.csv"
    rows = [f"{p.x},{p.y},{p.kind}" for p in SCENARIOS["paper"].placed]
    table.write_text("\n".join(["x_m,y_m,class", *rows]) + "\n")
    told = json.loads(stemmap(capsys, "evaluate", mapped, "--truth", table, "--json").out)
    own = json.loads(stemmap(capsys, "evaluate", mapped, "--json").out)
    assert told["TA"] == own["TA"]
    assert told["dbh_count"] == 0
    wide = json.loads(stemmap(capsys, "evaluate", mapped, "--reach", "200", "--json").out)
    assert wide["TA"]["of"] == 7
    stemmap(capsys, "evaluate", mapped, "--match-distance", "99").refused(2, "evaluation.match_distance")


@pytest.mark.parametrize("words", [(), ("--json",)])
def test_diameters_of_a_wrong_unit_end_with_3(mapped, tmp_path, capsys, words):
    run, table = shutil.copytree(mapped, tmp_path / "run"), tmp_path / "truth.csv"
    head, *rows = (mapped / "trees.csv").read_text().splitlines()
    cells = [[*row.split(",")[:5], "30.0", *row.split(",")[6:]] for row in rows]
    (run / "trees.csv").write_text("\n".join([head, *map(",".join, cells)]) + "\n")
    for unit, code in (("cm", 0), ("mm", 3)):
        lines = [f"x_m,y_m,dbh_{unit}", *(",".join((x, y, dbh)) for _, x, y, _, _, dbh, *_ in cells)]
        table.write_text("\n".join(lines) + "\n")
        told = stemmap(capsys, "evaluate", run, "--truth", table, *words)
        assert told.code == code
        doubt = "the diameters of the ground truth are about 1/10 of those of the map"
        assert (doubt in (told.err if words else told.out)) is (code == 3)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("", "no ground truth is within"),
        ("900,900\n", "no ground truth is"),
        ("1,0\n", "none of 1 true tree has"),
    ],
)
def test_truth_that_judges_nothing_ends_with_1(mapped, tmp_path, capsys, rows, words):
    table = tmp_path / "truth.csv"
    table.write_text(f"x_m,y_m\n{rows}")
    stemmap(capsys, "evaluate", mapped, "--truth", table).refused(1, words)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("trees.csv", None),
        ("run.json", '{"parameters": {"clustering": {"eps": 99}}}'),
        ("path.csv", "t_s,x_m,y_m,yaw_rad,sigma_xy_m\n1,2,3,4,five\n"),
    ],
)
def test_a_damaged_run_is_said_in_one_line(mapped, tmp_path, capsys, name, content):
    for file in mapped.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    if content is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_text(content, encoding="latin-1")
    stemmap(capsys, "evaluate", tmp_path).refused(1, str(tmp_path))


@pytest.mark.parametrize("part", ["source", "seed"])
def test_a_record_without_its_source_is_said_in_one_line(mapped, tmp_path, capsys, part):
    for file in mapped.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    record = json.loads((mapped / "run.json").read_text())
    del record[part]
    (tmp_path / "run.json").write_text(json.dumps(record))
    stemmap(capsys, "evaluate", tmp_path).refused(1, str(tmp_path))


def test_a_folder_without_a_run_is_said(tmp_path, capsys):
    stemmap(capsys, "evaluate", tmp_path).refused(1, "stemmap map")
    stemmap(capsys, "evaluate", tmp_path / "none").refused(1, "none")


def test_a_failed_mapping_leaves_the_old_files(mapped, tmp_path, capsys, monkeypatch):
    for file in mapped.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())

    def breaks(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pipeline.io.result_files.detection_rows", breaks)
    told = stemmap(capsys, "map", RUN, "--out", tmp_path, "--force")
    told.refused(1, "No space left")
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == {
        file.name: file.read_bytes() for file in mapped.iterdir()
    }


def test_the_map_of_another_source_is_overwritten_when_asked_alone(mapped, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(mapped, folder)
    stemmap(capsys, "map", RUN, "--out", folder).refused(1, "sim:paper?duration=4", "--force")
    assert (folder / "trees.csv").read_bytes() == (mapped / "trees.csv").read_bytes()
    told = stemmap(capsys, "map", "sim:paper?duration=4", "--out", folder, "--stop-after", "3")
    assert f"files in {folder} (replaced)" in told.out
    assert stemmap(capsys, "map", RUN, "--out", folder, "--force").code == 0
    assert json.loads((folder / "run.json").read_text())["source"]["uri"] == RUN
    (folder / "run.json").write_text("{")
    stemmap(capsys, "map", RUN, "--out", folder).refused(1, "run.json", "--force")


def test_files_of_that_name_that_are_of_no_run_are_kept(tmp_path, capsys):
    (tmp_path / "trees.csv").write_text("mine")
    stemmap(capsys, "map", RUN, "--out", tmp_path).refused(1, "trees.csv", "--force")
    assert (tmp_path / "trees.csv").read_text() == "mine"


def test_losses_are_said_and_told_by_the_exit_code(tmp_path, capsys, monkeypatch):
    from pipeline.io.readers.simulated import SimulatedSource

    whole = SimulatedSource.records

    def with_a_scan_twice(self):
        for record in whole(self):
            yield record
            yield record

    monkeypatch.setattr(SimulatedSource, "records", with_a_scan_twice)
    told = stemmap(capsys, "map", RUN, "--out", tmp_path)
    assert told.code == 3
    assert "left out: scans" in told.err
    assert json.loads((tmp_path / "run.json").read_text())["scans"] == 20


def test_a_short_run_without_a_return_in_range_is_doubtful(tmp_path, capsys, monkeypatch):
    """Two seconds are too short for a fault that lasts."""
    from pipeline.io.readers.simulated import SimulatedSource
    from pipeline.types.records import Scan

    whole = SimulatedSource.records

    def in_millimetres(self):
        for r in whole(self):
            yield replace(r, points=1000.0 * r.points) if isinstance(r, Scan) else r

    monkeypatch.setattr(SimulatedSource, "records", in_millimetres)
    told = stemmap(capsys, "map", RUN, "--out", tmp_path)
    assert told.code == 3
    assert "are the points in metres?" in told.err


def test_standing_still_is_warned_of(tmp_path, capsys):
    told = stemmap(capsys, "map", RUN, "--out", tmp_path, "--odometry", "static")
    assert told.code == 0
    assert "warning:" in told.err
    assert "without motion" in told.err
    assert json.loads((tmp_path / "run.json").read_text())["odometry"] == "static"


def test_presets_and_values_are_taken(tmp_path, capsys):
    told = stemmap(
        capsys, "map", RUN, "--out", tmp_path, "--preset", "paper", "--set", "slam.particles=5", "--seed", "3"
    )
    assert told.code == 0
    record = json.loads((tmp_path / "run.json").read_text())
    assert (record["preset"], record["seed"]) == ("paper", 3)
    assert record["parameters"]["slam"]["particles"] == 5
    assert record["parameters"]["clustering"]["eps"] == 0.25


@pytest.mark.parametrize("library", ["json", "zenoh"])
def test_the_program_ends_with_the_code_and_all_it_said(tmp_path, library):
    pytest.importorskip(library)
    code = f"import {library}; from app.cli import command; command()"
    words = [sys.executable, "-c", code, "info", str(tmp_path / "none.mcap")]
    refused = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "none.mcap" in refused.stderr
    words[3:] = ["--version"]
    told = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (told.returncode, told.stderr) == (0, "")
    assert told.stdout.startswith("stemmap")


@pytest.mark.parametrize("has_bytecode", [False, True], ids=["uv", "pip"])
def test_bytecode_is_kept_where_python_may_write_none_and_the_libraries_came_without(tmp_path, has_bytecode):
    module = tmp_path / "libraries" / "numpy" / "__init__.py"
    module.parent.mkdir(parents=True)
    module.touch()
    if has_bytecode:
        bytecode = module.parent / "__pycache__" / f"__init__.{sys.implementation.cache_tag}.pyc"
        py_compile.compile(str(module), cfile=str(bytecode))
    shown = "import os, sys; from app import cli; cli._keep_bytecode(); "
    shown += "print(sys.dont_write_bytecode, sys.pycache_prefix, os.environ.get('PYTHONPYCACHEPREFIX'))"
    settings = {name: value for name, value in os.environ.items() if name != "PYTHONPYCACHEPREFIX"} | {
        "PYTHONDONTWRITEBYTECODE": "1",
        "XDG_CACHE_HOME": str(tmp_path),
        "PYTHONPATH": str(module.parents[1]),
    }
    told = subprocess.run(
        [sys.executable, "-c", shown], env=settings, capture_output=True, text=True, check=True
    ).stdout.split()
    kept = str(tmp_path / "stemmap" / "bytecode")
    assert told == (["True", "None", "None"] if has_bytecode else ["False", kept, kept])


@pytest.mark.parametrize(("warning", "code"), [(f"{LOST} since 1.2 s: no scan fits", 3), ("of no harm", 0)])
def test_a_map_whose_odometry_got_lost_ends_with_exit_code_3(warning, code, tmp_path):
    assert map_command.print_result([], tmp_path, [warning], {}, replaces=False, wrong=(LOST,)) == code


@pytest.mark.slow
def test_a_file_of_repairs_is_applied_to_the_map(mapped, tmp_path, capsys):
    before = [line.split(",") for line in (mapped / "trees.csv").read_text().splitlines()[1:]]
    x, y = map(float, before[0][1:3])
    file = tmp_path / "repairs.json"
    gone, nowhere = {"kind": "delete", "places": [[x, y]]}, {"kind": "delete", "places": [[500, 0]]}
    file.write_text(json.dumps({"repairs": [gone, nowhere]}))
    told = stemmap(capsys, "map", "sim:paper?duration=4", "--out", tmp_path / "out", "--repairs", str(file))
    assert "repairs: 1 of 2 applied" in told.out
    assert "repair 2 (delete) does not apply: no tree is within 0.5 m of 500.00, 0.00" in told.err
    after = (tmp_path / "out" / "trees.csv").read_text().splitlines()[1:]
    assert [line.split(",") for line in after] == before[1:]
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["repairs"]["applied"] == {"delete": 1}
    assert record["repairs"]["not_applied"][0]["problem"].startswith("no tree is within")
    assert record["trees"] == len(before) - 1
    file.write_text("{}")
    stemmap(capsys, "map", RUN, "--out", tmp_path / "other", "--repairs", str(file)).refused(
        1, "these are no repairs of a map"
    )
