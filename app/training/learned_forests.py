"""Decision trees that were learned from annotations, kept in the data folder as JSON.

The name of a forest is the digest of what decides in it, so a map with `classification.forest = NAME` is the
same everywhere, or it is refused.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from functools import cache
from pathlib import Path
from typing import Any

from app.common.settings import data_folder
from pipeline.classification.forest import (
    ALL_AROUND,
    FREE_END,
    ONE_WAY,
    PACKAGE,
    Forest,
    read_forests,
    standard_forest,
)
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import write_beside

FOLDER = "forests"
# What the name is the digest of, with FREE_END where it is there; the rest tells where it came from.
DECIDES = ("classes", ALL_AROUND, ONE_WAY)
_NAME = re.compile(r"[0-9a-f]{16}")


def name_of(data: dict[str, Any]) -> str:
    """The name of a forest out of what its JSON holds."""
    decides = [data.get(key) for key in DECIDES] + ([data[FREE_END]] if FREE_END in data else [])
    text = json.dumps(decides, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class Forests:
    """The forests of a data folder, and that of the package.

    Args:
        folder: The data folder, None where there is none.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = None if folder is None else folder / FOLDER
        self._known: dict[tuple[str, bool], Forest] = {}
        self._told: dict[str, dict[str, Any]] = {}

    def __call__(self, name: str, all_around: bool) -> Forest:
        """A forest by its name, for sensors that see all around or for those that look one way.

        Raises:
            StemmapError: There is none of this name, or its file is damaged.
        """
        if name == PACKAGE:
            return standard_forest(all_around)
        if (name, all_around) not in self._known:
            _, (around, one_way) = self._read(name)
            self._known[name, True], self._known[name, False] = around, one_way
        return self._known[name, all_around]

    def check(self, parameters: Parameters) -> None:
        """Whether the forest that parameters name is here.

        Raises:
            StemmapError: See `__call__`.
        """
        self(parameters.classification.forest, True)

    def read(self, name: str) -> dict[str, Any]:
        """The JSON of a learned forest, with where it came from.

        Raises:
            StemmapError: See `__call__`.
        """
        return self._read(name)[0]

    def told_of(self, name: str) -> dict[str, Any] | None:
        """When a learned forest was grown, from how many things by class and how many runs; None for that of
        the package, and where the file is not here or does not tell.
        """
        if name == PACKAGE:
            return None
        if name not in self._told:
            try:
                learned = self.read(name)["learned"]
                things = {str(kind): int(n) for kind, n in learned["things"].items()}
                told = {"date": str(learned["date"]), "things": things, "runs": len(learned["runs"])}
            except (StemmapError, AttributeError, KeyError, TypeError, ValueError):
                return None
            self._told[name] = {"name": name, **told}
        return self._told[name]

    def _read(self, name: str) -> tuple[dict[str, Any], list[Forest]]:
        file = self._file(name)
        if file is None or not file.is_file():
            raise StemmapError(
                f"the decision trees {name} are not in the data folder",
                where=str(file or ""),
                remedy=f"Put their file there, or choose classification.forest = {PACKAGE}",
            )
        data, forests = read_forests(file, ALL_AROUND, ONE_WAY)
        if name_of(data) != name:
            raise StemmapError(
                "the decision trees are damaged: they are not those that the name tells",
                where=str(file),
                remedy=f"Learn them anew, or choose classification.forest = {PACKAGE}",
            )
        return data, forests

    def keep(self, data: dict[str, Any]) -> str:
        """Write a forest into the data folder; returns its name.

        Raises:
            StemmapError: There is no data folder, or it cannot be written.
        """
        name = name_of(data)
        file = self._file(name)
        if file is None:
            raise StemmapError(
                "there is no data folder for the decision trees", remedy="Name one with STEMMAP_FOLDER"
            )
        try:
            file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            write_forest(data, file)
        except OSError as error:
            raise StemmapError(f"cannot write: {error.strerror}", where=str(file)) from None
        return name

    def _file(self, name: str) -> Path | None:
        return None if self._folder is None or not _NAME.fullmatch(name) else self._folder / f"{name}.json"


def write_forest(data: dict[str, Any], file: Path) -> None:
    """Write a forest as JSON, a line for each question."""
    text = json.dumps(data, separators=(",", ":")).replace('{"figure"', '\n{"figure"')
    with write_beside(file) as beside:
        beside.write_text(text + "\n", encoding="utf-8")


def kept_forests() -> Forests:
    """Those of this process's data folder."""
    return _of(data_folder(os.environ))


@cache
def _of(folder: Path | None) -> Forests:
    return Forests(folder)
