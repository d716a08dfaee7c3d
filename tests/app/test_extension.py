"""How extensions are found, switched off, and left out when they are broken."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from app import extension
from app.cli import main

Install = Callable[[str, str, str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Installs a package with one module and one extension, as pip does: the module and its dist-info."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def made(package: str, code: str, name: str) -> None:
        (tmp_path / f"{package}.py").write_text(code)
        metadata = tmp_path / f"{package}-1.2.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
        (metadata / "entry_points.txt").write_text(f"[{extension.GROUP}]\n{name} = {package}:EXTENSION\n")
        extension._loaded.cache_clear()

    yield made
    extension._loaded.cache_clear()
    for path in tmp_path.glob("*.py"):
        sys.modules.pop(path.stem, None)


SAYS = """
from app.extension import Extension
EXTENSION = Extension(help="says hello", commands={"hello": __name__})
HELP = "say hello"
def configure(parser): parser.add_argument("--to", default="you")
def run(arguments): print("hello", arguments.to); return 0
"""


def listed(capsys: pytest.CaptureFixture[str]) -> dict[str, list[str]]:
    """The words of each line of `stemmap extensions` after the name."""
    assert main(["extensions"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    return {name: words for name, *words in rows}


def test_a_command_of_another_package_is_a_command_of_the_program(install, capsys):
    install("my_words", SAYS, "words")
    assert listed(capsys)["words"] == ["on", "says", "hello", "(my_words", "1.2)"]
    assert main(["hello", "--to", "us"]) == 0
    assert capsys.readouterr().out == "hello us\n"
    assert main(["--help"]) == 0
    assert "say hello" in capsys.readouterr().out


@pytest.mark.parametrize("wanted", ["", ",", "others"])
def test_an_extension_that_is_switched_off_adds_nothing(install, capsys, monkeypatch, wanted):
    install("my_words", SAYS, "words")
    monkeypatch.setenv(extension.VARIABLE, wanted)
    assert extension.extensions_on() == {}
    assert {words[0] for words in listed(capsys).values()} == {"off"}
    assert main(["helo", "--no-browser"]) == 1  # no command, and no file
    assert "there is no such file" in capsys.readouterr().err


def test_only_the_named_extensions_are_on(install, monkeypatch):
    install("my_words", SAYS, "words")
    monkeypatch.setenv(extension.VARIABLE, " words ,")
    assert list(extension.extensions_on()) == ["words"]


def test_a_name_without_extension_is_said(monkeypatch, capsys):
    monkeypatch.setenv(extension.VARIABLE, "wrods")
    assert main(["extensions"]) == 0
    assert "there is no extension 'wrods'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("import no_such_module_at_all", "no_such_module_at_all"),
        ("raise SystemExit(4)", "SystemExit: 4"),
        ("EXTENSION = 3", "no app.extension.Extension"),
        ("OTHER = 3", "EXTENSION"),
    ],
)
def test_a_broken_extension_is_said_and_left_out(install, capsys, code, words):
    install("my_fault", code, "faulty")
    assert "faulty" not in extension.extensions_on()
    assert main(["params", "--format", "toml"]) == 0
    said = capsys.readouterr().err
    assert said.startswith("stemmap: the extension faulty of my_fault 1.2 is left out: ")
    assert words in said
    assert listed(capsys)["faulty"][0] == "broken"


def test_a_broken_command_is_said_and_the_others_run(install, capsys):
    install("my_words", SAYS.replace("__name__", "'no_such_module'"), "words")
    assert main(["params", "--format", "toml"]) == 0
    assert "the command hello is left out" in capsys.readouterr().err


def test_a_command_of_the_program_is_not_replaced(install, capsys):
    install("my_words", SAYS.replace('"hello": ', '"params": '), "words")
    assert main(["params", "--format", "toml"]) == 0
    assert "[clustering]" in capsys.readouterr().out


def test_of_two_extensions_with_one_name_one_is_used(install, capsys):
    install("my_words", SAYS, "words")
    install("your_words", SAYS, "words")
    both = [each.extension is not None for each in extension.all_extensions() if each.name == "words"]
    assert both == [True, False]
    assert "words" in extension.extensions_on()
    assert "has an extension of the same name" in "".join(extension.problems())


def test_formats_of_an_extension_that_fails_are_left_out(install, tmp_path, caplog):
    install("my_words", SAYS.replace("commands={", "formats=lambda: 1 / 0, commands={"), "words")
    file = tmp_path / "notes.txt"
    file.write_text("no scan")
    assert main(["info", str(file)]) == 1
    assert "the formats of the extension words are left out" in caplog.text


@pytest.mark.parametrize("wanted", [None, "", "stand"])
def test_a_refusal_names_the_extensions_that_are_switched_off(tmp_path, capsys, monkeypatch, wanted):
    if wanted is not None:
        monkeypatch.setenv(extension.VARIABLE, wanted)
    (tmp_path / "run.laser").write_bytes(b"no recording")
    assert main(["map", str(tmp_path / "run.laser"), "--out", str(tmp_path / "out")]) != 0
    error = capsys.readouterr().err
    off = [each.name for each in extension.all_extensions() if not each.is_on]
    assert len(off) == {None: 0, "": 9, "stand": 8}[wanted]
    assert (extension.VARIABLE in error) == bool(off)
    assert all(name in error.splitlines()[-1] for name in off)
