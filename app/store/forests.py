"""Random forests that were trained with annotations, stored in the data folder as JSON.

The name of a forest is the digest of its trees, so a map with `classification.forest = NAME` is the
same everywhere or refused.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.common.settings import data_folder
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import write_beside

# Other names are imported where they are used, because the web process starts without Numba.
if TYPE_CHECKING:
    from pipeline.classification.forest import Forest
    from pipeline.front_end import StageTimer
    from pipeline.io.readers import SourceDescription
    from pipeline.mapper import Mapper

FOLDER = "forests"
#: Name of the forest of the package, the default of the parameter.
PACKAGE = Parameters().classification.forest
_NAME = re.compile(r"[0-9a-f]{16}")


def name_of(data: dict[str, Any]) -> str:
    """Return the name of a random forest from its JSON: the first 16 hex digits of the SHA-256 of its classes
    and trees, without provenance."""
    from pipeline.classification.forest import ALL_AROUND, FREE_END, ONE_WAY

    decides = [data.get(key) for key in ("classes", ALL_AROUND, ONE_WAY)]
    decides += [data[FREE_END]] if FREE_END in data else []
    text = json.dumps(decides, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class Forests:
    """The random forests of a data folder, and the random forest of the package.

    Args:
        folder: The data folder; None where there is none.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = None if folder is None else folder / FOLDER
        self._known: dict[tuple[str, bool], Forest] = {}
        self._provenance: dict[str, dict[str, Any]] = {}

    def __call__(self, name: str, all_around: bool) -> Forest:
        """Return a forest by its name, for sensors that see all around or for sensors that look one way. The
        name PACKAGE is the forest of the package, others are files of the data folder, which contain both. A
        file is read once; later changes of it have no effect.

        Raises:
            StemmapError: There is no such forest, or its file is damaged.
        """
        if name == PACKAGE:
            from pipeline.classification.forest import standard_forest

            return standard_forest(all_around)
        if (name, all_around) not in self._known:
            _, (around, one_way) = self._read(name)
            self._known[name, True], self._known[name, False] = around, one_way
        return self._known[name, all_around]

    def check(self, parameters: Parameters) -> None:
        """Check that the random forest of the parameters exists and can be read. The forest of the package is
        not read.

        Raises:
            StemmapError: See `__call__`.
        """
        if parameters.classification.forest != PACKAGE:
            self(parameters.classification.forest, True)

    def read(self, name: str) -> dict[str, Any]:
        """Return the JSON of a learned random forest as a dict, with its provenance. It is read from the file
        each time.

        Raises:
            StemmapError: See `__call__`; also for the forest of the package.
        """
        return self._read(name)[0]

    def provenance(self, name: str) -> dict[str, Any] | None:
        """Return a dict with `name`, `date` (text), `things`, a dict from classes to numbers of objects, and
        `runs`, the number of runs, of a learned forest; None for the forest of the package and for files that
        are missing, damaged or without provenance. The dict is cached and must not be modified."""
        if name == PACKAGE:
            return None
        if name not in self._provenance:
            try:
                learned = self.read(name)["learned"]
                things = {str(kind): int(n) for kind, n in learned["things"].items()}
                provenance = {"date": str(learned["date"]), "things": things, "runs": len(learned["runs"])}
            except (StemmapError, AttributeError, KeyError, TypeError, ValueError):
                return None
            self._provenance[name] = {"name": name, **provenance}
        return self._provenance[name]

    def _read(self, name: str) -> tuple[dict[str, Any], list[Forest]]:
        """Return the JSON of a learned forest from its file as a dict, and a list of its two random forests,
        for sensors that see all around and for sensors that look one way.

        Raises:
            StemmapError: The name is invalid, the file does not exist, or it is damaged.
        """
        file = self._file(name)
        if file is None or not file.is_file():
            raise StemmapError(
                f"the random forest {name} is not in the data folder",
                where=str(file or ""),
                remedy=f"Copy its file there, or set classification.forest = {PACKAGE}",
            )
        from pipeline.classification.forest import ALL_AROUND, ONE_WAY, read_forests

        data, forests = read_forests(file, ALL_AROUND, ONE_WAY)
        if name_of(data) != name:
            raise StemmapError(
                "the random forest is damaged: its name does not fit its contents",
                where=str(file),
                remedy=f"Train it again, or set classification.forest = {PACKAGE}",
            )
        return data, forests

    def keep(self, data: dict[str, Any]) -> str:
        """Store a forest in the data folder under its name, and return the name; a file of that name is
        replaced.

        Args:
            data: JSON of a forest as `learn` returns it; it is not validated. Its name is computed from the
                classes and decision trees, see `name_of`.

        Raises:
            StemmapError: There is no data folder, or it cannot be written.
        """
        name = name_of(data)
        file = self._file(name)
        if file is None:
            raise StemmapError("there is no data folder for the random forest", remedy="Set STEMMAP_FOLDER")
        try:
            file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            write_forest(data, file)
        except OSError as error:
            raise StemmapError(f"cannot write: {error.strerror}", where=str(file)) from None
        return name

    def _file(self, name: str) -> Path | None:
        """Return the path of a forest, which may not exist; None without a data folder or for an invalid
        name."""
        return None if self._folder is None or not _NAME.fullmatch(name) else self._folder / f"{name}.json"


def write_forest(data: dict[str, Any], file: Path) -> None:
    """Write a forest as JSON, one line per split; raises StemmapError if the file cannot be written."""
    text = json.dumps(data, separators=(",", ":")).replace('{"figure"', '\n{"figure"')
    with write_beside(file) as beside:
        beside.write_text(text + "\n", encoding="utf-8")


def kept_forests() -> Forests:
    """Return the forests of the data folder that the environment names; the same object for the same
    folder."""
    return _of(data_folder(os.environ))


_of = cache(Forests)


def mapper_of(
    source: SourceDescription, parameters: Parameters, seed: int, timer: StageTimer | None = None
) -> Mapper:
    """Return a mapper before the first scan of a source, with the forests that are kept on this machine.

    Args:
        source: Description with the sensor and its extrinsics.
        parameters: Parameters of the mapper.
        seed: Random seed.
        timer: Measures the stages, see `Mapper`; None for no measurement.

    Raises:
        StemmapError: The forest that the parameters name does not exist, or its file is damaged.
    """
    from pipeline.front_end import no_timer
    from pipeline.mapper import Mapper

    return Mapper(
        parameters,
        sensor=source.sensor,
        T_base_lidar=source.T_base_lidar,
        seed=seed,
        timer=timer or no_timer,
        forests=kept_forests(),
    )
