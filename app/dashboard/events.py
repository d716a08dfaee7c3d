"""What happened in the run and when, for the marks on the timeline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pipeline.config.model import Value
from pipeline.types.records import Float, Frame

Kind = Literal["tree", "warning", "change", "health", "annotation"]

_OF_THE_MAP = ("tree", "health")  # come anew when the run is mapped with other parameters
_MOST = 400
_LONGEST = 300


@dataclass(frozen=True, slots=True)
class Event:
    """One mark.

    Attributes:
        time_s: Since the run's first scan.
        kind: A tree was confirmed, a warning came, parameters were changed, the pose became better or worse,
            somebody annotated.
        text: For people.
    """

    time_s: float
    kind: Kind
    text: str


class Events:
    """The events of a run, at most 400; of more the oldest are forgotten.

    What came later in the run than the scan at which parameters were changed stays as it was, told to be of
    before the change, until the run gets there again.
    """

    def __init__(self) -> None:
        self._events: dict[str, Event] = {}
        self._before: dict[str, Event] = {}
        self._confirmed: set[int] = set()
        self._warnings: frozenset[str] = frozenset()
        self._health = "good"
        self._base: tuple[str, dict[str, Value]] | None = None
        self._edits = ("", 0)

    def forget(self) -> None:
        """Another run begins."""
        self._events.clear()
        self._before.clear()
        self._confirmed.clear()
        self._warnings, self._health, self._base = frozenset(), "good", None
        self._edits = ("", 0)

    def shown(self, frame: Frame, time_s: float, confirmed_s: Float | None = None) -> bool:
        """Take a scan's results; returns whether anything happened. A tree that is confirmed again after the
        run went back has its mark where it was confirmed first.

        Args:
            frame: The picture; on the way to a sought scan not every one is shown.
            time_s: Of the picture.
            confirmed_s: When each of its trees was confirmed, NaN where that is not known; None knows none.
        """
        known = set(self._events)
        passed = {key for key, event in self._before.items() if event.time_s <= time_s}
        self._before = {key: event for key, event in self._before.items() if key not in passed}
        # Not those whose marks are there: of more trees than marks the forgotten ones would come again.
        confirmed = set(frame.trees.number[frame.trees.confirmed].tolist())
        at = {} if confirmed_s is None else self._times(frame, confirmed_s)
        for number in sorted(confirmed - self._confirmed):
            self._note(f"tree {number}", Event(at.get(number, time_s), "tree", f"Tree {number} confirmed"))
        self._confirmed |= confirmed
        health = frame.health
        if health.state != self._health:
            self._health = health.state
            text = f"SLAM {health.state}: {health.reason}" if health.reason else f"SLAM {health.state}"
            self._note(f"health {frame.index}", Event(time_s, "health", text))
        return self._events.keys() != known or bool(passed)

    def remapped(self, confirmed: list[tuple[int, float]], time_s: float) -> None:
        """The map is another one.

        Args:
            confirmed: Number of each tree that was confirmed on the way to it, and when [s].
            time_s: Of the standing scan, up to which it was mapped again.
        """
        self._set_aside(lambda event: event.time_s > time_s)
        self._events = {k: e for k, e in self._events.items() if e.kind not in _OF_THE_MAP}
        self._confirmed = {number for number, _ in confirmed}
        self._health = "good"
        for number, at in confirmed:
            self._note(f"tree {number}", Event(at, "tree", f"Tree {number} confirmed"))

    def warned(self, warnings: list[str], time_s: float) -> bool:
        """Take the warnings that stand; returns whether there is a new one."""
        new = [warning for warning in warnings if warning not in self._warnings]
        self._warnings = frozenset(warnings)
        for warning in new:
            self._note(f"warning {time_s:.1f} {warning}", Event(time_s, "warning", warning[:_LONGEST]))
        return bool(new)

    def changed(self, before: dict[str, Value], after: dict[str, Value], time_s: float) -> None:
        """Parameters were changed. What came after this time in the run came under other parameters, and
        will come anew. Of changes at one time (a slider that moves) what they make together is told.

        Args:
            before, after: All values by dotted name.
            time_s: Of the standing scan.
        """
        undone = self._set_aside(lambda event: event.time_s > time_s)
        self._confirmed = {number for number in self._confirmed if f"tree {number}" not in undone}
        key = f"change {time_s:.1f}"
        if self._base is None or self._base[0] != key:
            self._base = (key, before)
        old = self._base[1]
        texts = [f"{name}: {old[name]} → {value}" for name, value in after.items() if value != old[name]]
        self._events.pop(key, None)
        if texts:
            more = f" and {len(texts) - 3} more" if len(texts) > 3 else ""
            self._note(key, Event(time_s, "change", f"{', '.join(texts[:3])}{more}"[:_LONGEST]))

    def annotated(self, who: str, number: int, time_s: float) -> None:
        """Annotations were edited. Of edits at one time (of somebody who goes through the trees while the run
        stands) one mark tells how many they were.

        Args:
            who: Made the last of them; empty where that is not known.
            number: How many annotations were added, changed or deleted.
            time_s: Of the standing scan.
        """
        key = f"annotation {time_s:.1f}"
        self._edits = (key, number + (self._edits[1] if self._edits[0] == key else 0))
        self._events.pop(key, None)
        edits = "an annotation" if self._edits[1] == 1 else f"{self._edits[1]} annotations"
        self._note(key, Event(time_s, "annotation", f"{who or 'Somebody'} edited {edits}"[:_LONGEST]))

    def as_plain(self) -> dict[str, Any]:
        """For the browsers, in the order of time; `before` marks what is of before a change."""
        room = _MOST - len(self._events)
        marks = [(event, False) for event in self._events.values()]
        marks += [(event, True) for event in list(self._before.values())[:room]]
        marks.sort(key=lambda mark: mark[0].time_s)
        return {
            "events": [
                {"t": round(e.time_s, 2), "kind": e.kind, "text": e.text, **({"before": True} if old else {})}
                for e, old in marks
            ]
        }

    def _set_aside(self, which: Callable[[Event], bool]) -> set[str]:
        """Of what the map told, some events are of before a change from now on; gives their keys."""
        keys = {k for k, event in self._events.items() if event.kind in _OF_THE_MAP and which(event)}
        self._before |= {key: self._events.pop(key) for key in sorted(keys)}
        return keys

    @staticmethod
    def _times(frame: Frame, confirmed_s: Float) -> dict[int, float]:
        rows = np.flatnonzero(frame.trees.confirmed & np.isfinite(confirmed_s))
        return dict(zip(frame.trees.number[rows].tolist(), confirmed_s[rows].tolist(), strict=True))

    def _note(self, key: str, event: Event) -> None:
        self._events.setdefault(key, event)
        while len(self._events) > _MOST:
            del self._events[next(iter(self._events))]
