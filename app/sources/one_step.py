"""Sources that are mapped in one step, as a whole and without a robot: extensions open them and map them."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Protocol, TypeVar

from app.extension import all_extensions, switched_off
from pipeline.errors import SourceError
from pipeline.io.readers.base import FileSource, SourceOptions

if TYPE_CHECKING:
    from app.explain.records import ClusterStory, TreeStory
    from app.worker.protocol import RunCounts
    from pipeline.config import Parameters
    from pipeline.types.records import Float, Float32, Frame, Record

_log = logging.getLogger(__name__)
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class OneStep:
    """What is known of a source that is mapped in one step, before it is mapped.

    Attributes:
        offset: Offset x, y, z of the frame of the map in the coordinates of the file [m].
        crs: Coordinate reference system of the file, in metres; "" if unknown.
        points: Number of points of the file.
        parameters: Dotted names of the parameters that change the map.
        crs_unit: Metres per unit of the reference system in which positions are written, horizontal and
            vertical.
        unit, up: Unit of the coordinates of the file and its axis that points up, for people.
    """

    offset: tuple[float, float, float]
    crs: str
    points: int
    parameters: list[str]
    crs_unit: tuple[float, float] = (1.0, 1.0)
    unit: str = "metres"
    up: str = "z"


class OneStepMap(Protocol):
    """The map of such a source."""

    @property
    def frame(self) -> Frame:
        """The map as a frame that is not of a drive, with time 0 and trees numbered from 1."""

    @property
    def accumulated(self) -> Float32:
        """Points at the stems: x, y in the map and height above the ground, shape (N, 3) [m]."""

    def counts(self) -> RunCounts:
        """Return the counts of the map."""

    def tree_story(self, frame: Frame, row: int, parameters: Parameters) -> TreeStory:
        """Return the explanation of the tree in a row of `frame`, which has the trees with the numbers that
        are shown, mapped with these parameters."""

    def cluster_story(self, frame: Frame, row: int, parameters: Parameters) -> ClusterStory:
        """Return the explanation of the cluster in a row; arguments as in `tree_story`."""


class OneStepSource(FileSource):
    """A source that is mapped in one step. Its description has one scan at time 0.

    Attributes:
        about: What is known before it is mapped.
        is_cut_above: Whether the field of view of a sensor cuts the trees, as in the points of a drive.
    """

    about: OneStep
    is_cut_above: bool = False

    def records(self) -> Iterator[Record]:
        """Yield nothing: there are no scans."""
        yield from ()

    @abstractmethod
    def steps(self, parameters: Parameters) -> Generator[float, None, OneStepMap]:
        """Map the source; yield the share of the work that is done, from 0 to 1, at least every few tenths of
        a second, and return the map. The generator may be left before its end, and called again.

        Raises:
            StemmapError: The source cannot be mapped with these parameters.
        """

    @abstractmethod
    def points(self) -> Iterator[Float]:
        """Yield all points in parts, in the coordinates of the file, shape (N, 3) [m]. Raises SourceError."""


def finish(steps: Generator[float, None, T]) -> T:
    """Return the result of a generator after all of its steps; what they yield is discarded."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result


def open_one_step(uri: str, options: SourceOptions | None = None) -> OneStepSource | None:
    """Open a source that is mapped in one step; None for another source.

    Raises:
        SourceError: The source cannot be read, or its extension is switched off.
    """
    module = _module_of(uri, options)
    if module is None:
        return None
    source: OneStepSource = module.open_source(uri, options)
    return source


def check_one_step(uri: str, options: SourceOptions | None = None) -> bool:
    """Return whether a source is mapped in one step; if it is, check that it can be opened. Errors as in
    `open_one_step`."""
    module = _module_of(uri, options)
    if module is not None:
        module.check(uri, options)
    return module is not None


def is_one_step(uri: str, options: SourceOptions | None = None) -> bool:
    """Return whether a source is mapped in one step. Raises SourceError if its extension is switched off."""
    return _module_of(uri, options) is not None


def _module_of(uri: str, options: SourceOptions | None) -> ModuleType | None:
    """Return the module of the extension that maps a source in one step; None if none does. Raises
    SourceError if only an extension that is switched off does. One that is on and fails is logged and left
    out."""
    for each in sorted(all_extensions(), key=lambda each: not each.is_on):  # those that are on first
        if each.extension is None or not each.extension.sources:
            continue
        try:
            module = import_module(each.extension.sources)
            takes = module.takes(uri, options)
        except Exception:  # the code of others: other sources can be opened without it
            if each.is_on:
                _log.exception("the sources of the extension %s are left out", each.name)
            continue
        if takes and not each.is_on:
            raise SourceError(f"{module.WHAT} needs an extension", where=uri, remedy=switched_off(each.name))
        if takes:
            return module
    return None
