"""Events of the run, which the page shows on the timeline and in its log."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from app.sources.live_address import SILENT_S
from pipeline.config.model import Value
from pipeline.types.records import Float, Frame, Int, Zone
from pipeline.types.units import SECOND_NS

Kind = Literal[
    "tree", "warning", "change", "health", "annotation", "stop", "slow", "silence", "pause", "recording"
]

_OF_THE_SCANS = ("health", "stop", "slow")  # nothing is known of them in a gap
_GAPS = ("silence", "pause")
_OF_THE_READER = (*_GAPS, "recording")  # in a live run they last by the clock of this computer
_OF_THE_MAP = ("tree", "health")  # created again when the run is mapped with other parameters
_MOST = 400
#: Count at the end of a warning, such as "scans lost on the network (3)".
_COUNT = re.compile(r" \(\d+[^()]*\)$")
_LONGEST = 300
_SINCE = re.compile(r"^Nothing heard for \d+ s")


@dataclass(frozen=True, slots=True)
class Event:
    """One event on the timeline.

    Attributes:
        time_s: Time since the first scan of the run [s].
        kind: Tree mapped, warning, parameters changed, pose quality changed, annotation, obstacle in the stop
            or slow zone, robot without data, pause of a live run, or recording.
        text: Description for people.
        lasts: Whether it lasts until the next event of its kind; pose quality and obstacles also until the
            robot sends no data or the live run is paused.
        noted_s: Time by the clock of this computer at which it was noted, or a silence began [s since 1970];
            None if it was noted again later, by a map with other parameters, and for a silence in a
            recording.
    """

    time_s: float
    kind: Kind
    text: str
    lasts: bool = False
    noted_s: float | None = None


class Events:
    """Events of a run, at most 400. Beyond them the oldest obstacles in the slow zone are removed first, then
    trees, then warnings and edits, and stops, silences, pauses, recordings and the pose quality last.

    After a change of parameters, events later than the current scan remain, flagged as from before the
    change, until the run reaches them again.
    """

    def __init__(self) -> None:
        self._events: dict[str, Event] = {}
        self._before: dict[str, Event] = {}
        self._confirmed: set[int] = set()
        self._warnings: frozenset[str] = frozenset()
        self._health = "good"
        self._lasting: frozenset[Kind] = frozenset()
        self._obstacles: dict[Kind, tuple[str, float]] = {}  # key, least distance [m]
        self._silent_since = math.nan  # [s since the first scan]
        self._scans = 0  # number of the scans between which silences were searched for
        self._base: tuple[str, dict[str, Value]] | None = None
        self._edits = ("", 0)

    def forget(self) -> None:
        """Remove all events, since another run begins."""
        self._events.clear()
        self._before.clear()
        self._confirmed.clear()
        self._warnings, self._health, self._base = frozenset(), "good", None
        self._lasting = frozenset()
        self._obstacles.clear()
        self._silent_since, self._scans = math.nan, 0
        self._edits = ("", 0)

    def shown(
        self,
        frame: Frame,
        time_s: float,
        confirmed_s: Float | None = None,
        stamp_ns: Int | None = None,
        start_ns: int = 0,
    ) -> bool:
        """Add the events of a shown scan; return whether the list of events changed.

        A tree that is confirmed again after stepping back keeps the event of its first confirmation. Flagged
        events up to this time are removed. The pose quality has an event when its state changes; a run begins
        as "good". An obstacle in the stop or slow zone has an event when it comes and goes. A silence ends,
        except where the scan before it is shown again, for example after a change of parameters.

        Args:
            frame: Shown frame; while seeking, not every frame is shown.
            time_s: Time of the frame [s since the first scan].
            confirmed_s: Confirmation time of each tree of the frame, shape (T,) [s since the first scan], NaN
                if unknown; None if all are unknown. A tree without a known time gets the event at `time_s`.
            stamp_ns: Times of all scans up to the frame, shape (N,) [ns]. None in a live run, where `silent`
                is called instead.
            start_ns: Time of the first scan [ns].
        """
        known = dict(self._events)
        passed = {key for key, event in self._before.items() if event.time_s <= time_s}
        self._before = {key: event for key, event in self._before.items() if key not in passed}
        # Without existing marks: removed marks of many trees would otherwise reappear.
        confirmed = set(frame.trees.number[frame.trees.confirmed].tolist())
        at = {} if confirmed_s is None else self._times(frame, confirmed_s)
        for number in sorted(confirmed - self._confirmed):
            self._note(f"tree {number}", Event(at.get(number, time_s), "tree", f"Tree {number} mapped"))
        self._confirmed |= confirmed
        if stamp_ns is not None:
            self._note_silences(stamp_ns, start_ns)
        if not time_s <= self._silent_since:
            self._note_changes(frame, time_s)
        return self._events != known or bool(passed)

    def _note_changes(self, frame: Frame, time_s: float) -> None:
        """Add the events of the pose quality, of obstacles in the zones and of a silence that ends."""
        health = frame.health
        if health.state != self._health:
            self._health = health.state
            text = f"SLAM {health.state}: {health.reason}" if health.reason else f"SLAM {health.state}"
            self._note(f"health {frame.index}", Event(time_s, "health", text, health.state != "good"))
        ahead = frame.clearance
        if ahead is not None and ahead.zone != Zone.UNKNOWN:  # else nothing is known of the zones
            self._note_obstacle("stop", ahead.zone == Zone.STOP, time_s, ahead.ahead)
            # What is in the stop zone is in the slow zone as well.
            if ahead.zone != Zone.STOP or "slow" in self._lasting:
                self._note_obstacle("slow", ahead.zone != Zone.CLEAR, time_s, ahead.ahead)
        self._turn("silence", False, time_s, "Data again")

    def _note_obstacle(self, kind: Kind, is_there: bool, time_s: float, ahead_m: float) -> None:
        """Begin or end the event of an obstacle in a zone, and update its least distance, except at an
        earlier time, to which a person went back."""
        if self._turn(kind, is_there, time_s, f"No obstacle in the {kind} zone"):
            self._obstacles[kind] = (_key(kind, is_there, time_s), math.inf)
        if not is_there:
            return
        key, least_m = self._obstacles[kind]
        event = self._events.get(key)
        if event is not None and event.time_s <= time_s and ahead_m < least_m:
            self._obstacles[kind] = (key, ahead_m)
            text = f"Obstacle in the {kind} zone, {ahead_m:.2f} m ahead at its nearest"
            self._events[key] = replace(event, text=text)

    def _note_silences(self, stamp_ns: Int, start_ns: int) -> None:
        """Add the silences between the scans that came since the last call. They are longer than SILENT_S,
        and than twice the lower quartile of the times between scans, because some sensors scan every few
        seconds."""
        new_s = (stamp_ns[max(self._scans - 1, 0) :] - start_ns) / SECOND_NS
        self._scans = max(self._scans, len(stamp_ns))
        gaps_s = np.diff(new_s)
        if not (gaps_s > SILENT_S).any():
            return
        usual_s = np.percentile(np.diff(stamp_ns), 25, method="lower") / SECOND_NS
        for k in np.flatnonzero(gaps_s > max(SILENT_S, 2.0 * usual_s)).tolist():
            self.silent("No scans in the recording", float(new_s[k]))
            self._turn("silence", False, float(new_s[k + 1]), "Data again", None)
            self._silent_since = math.nan  # a person may go back before it

    def silent(self, why: str, time_s: float, ago_s: float | None = None) -> bool:
        """Add an event for a robot that sends no data, unless it has one; it ends with the next shown scan,
        or with `heard`. Return whether it was added. What lasts until then ends, since nothing is known of
        the time of a silence; if it is still there in the next shown scan, it begins again.

        Args:
            why: The reason.
            time_s: Time of the last scan [s since the first scan].
            ago_s: Time since it arrived [s]; None in a recording.
        """
        text = _SINCE.sub("Nothing heard", why)  # the event has its own duration
        return self._turn("silence", True, time_s, text[:_LONGEST], ago_s) and self._interrupt(time_s)

    def heard(self, time_s: float) -> bool:
        """End the event of a silence without a scan, as while the run is paused; return whether there was
        one.

        Args:
            time_s: Time of the last shown scan [s since the first scan].
        """
        return self._turn("silence", False, time_s, "Data again")

    def paused(self, is_paused: bool, time_s: float) -> bool:
        """Add an event when a live run is paused, which ends what lasts as a silence does, or when the pause
        ends; return whether it was added.

        Args:
            is_paused: Whether it is paused now.
            time_s: Time of the last scan [s since the first scan].
        """
        text = "Paused: obstacles are not reported" if is_paused else "The pause ended"
        return self._turn("pause", is_paused, time_s, text) and (not is_paused or self._interrupt(time_s))

    def _interrupt(self, time_s: float) -> bool:
        """End what the scans show, at the time of the last one; return True."""
        self._silent_since = time_s
        self._lasting -= {"stop", "slow"}
        self._health = "good" if self._health == "good" else "unknown"
        return True

    def recorded(self, recording: str, file: str, time_s: float) -> bool:
        """Add an event when the recording of a robot begins, ends or is refused; return whether it was added.

        Args:
            recording, file: `recording` and `recorded_file` of the status.
            time_s: Time of the last scan [s since the first scan].
        """
        is_on = recording.startswith(("recording", "finishing"))
        words = "Recording" if is_on else f"{recording[:1].upper()}{recording[1:]}" or "Recording ended"
        text = ": ".join(part for part in (words, file) if part)[:_LONGEST]
        key = f"recording {recording}"
        if not recording.startswith("not") or "recording" in self._lasting or key in self._events:
            return self._turn("recording", is_on, time_s, text)
        self._note(key, Event(time_s, "recording", text))
        return True

    def remapped(self, confirmed: list[tuple[int, float]], time_s: float, *, live: bool = False) -> None:
        """Replace the events of trees by those of `confirmed`, and remove those of the pose quality, after
        the run was mapped again. Old ones later than the current scan are flagged as from before the change.

        Args:
            confirmed: Number and confirmation time [s] of each tree.
            time_s: Time of the current scan [s].
            live: The run is live: its log keeps how good the pose was while the robot drove.
        """
        self._set_aside(lambda event: event.time_s > time_s)
        replaced = ("tree",) if live else _OF_THE_MAP
        self._events = {k: e for k, e in self._events.items() if e.kind not in replaced}
        self._confirmed = {number for number, _ in confirmed}
        if not live:
            self._health = "good"
        for number, at in confirmed:
            self._note(f"tree {number}", Event(at, "tree", f"Tree {number} mapped"), None)

    def warned(self, warnings: list[str], time_s: float) -> bool:
        """Add events for warnings that were not active in the last call, without the count at their end,
        which grows while they are active; return whether there are any.

        Args:
            warnings: All active warnings.
            time_s: Time of the current scan [s since the first scan].
        """
        active = frozenset(_COUNT.sub("", warning) for warning in warnings)
        new = sorted(active - self._warnings)
        self._warnings = active
        for warning in new:
            self._note(f"warning {time_s:.1f} {warning}", Event(time_s, "warning", warning[:_LONGEST]))
        return bool(new)

    def changed(self, before: dict[str, Value], after: dict[str, Value], time_s: float) -> None:
        """Add a change of parameters. Successive changes at one time (a slider drag) become one event, which
        disappears if the values are as before. It lists at most three parameters. Later events of the run are
        flagged as from before the change.

        Args:
            before, after: Dicts from the dotted name of each parameter to its value.
            time_s: Time of the current scan [s since the first scan].
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
        """Add edits of annotations; edits at one time share one event with their number.

        Args:
            who: Author of the last edit, empty if unknown.
            number: Number of added, changed or deleted annotations.
            time_s: Time of the current scan [s since the first scan].
        """
        key = f"annotation {time_s:.1f}"
        self._edits = (key, number + (self._edits[1] if self._edits[0] == key else 0))
        self._events.pop(key, None)
        edits = "an annotation" if self._edits[1] == 1 else f"{self._edits[1]} annotations"
        self._note(key, Event(time_s, "annotation", f"{who or 'Somebody'} edited {edits}"[:_LONGEST]))

    def as_plain(self) -> dict[str, Any]:
        """Return {"events": [...]}, a list of a dict for each event, ordered by time, with `t` [s since the
        first scan], `kind` and `text`. Events that last also have `for_s`, their duration [s], None while
        they last: of silences, pauses and recordings of a live run by the clock of this computer, because
        the scans that a slow link held back have the times of the robot. Events with a known `noted_s` have
        it; events from before a change of parameters `before`, True. The latter are included only up to a
        total of _MOST events."""
        room = _MOST - len(self._events)
        marks = [(event, False) for event in self._events.values()]
        marks += [(event, True) for event in list(self._before.values())[:room]]
        marks.sort(key=lambda mark: mark[0].time_s)
        ends: dict[str, Event] = {}  # by the kind, the following events
        plain: list[dict[str, Any]] = []
        for event, old in reversed(marks):
            each: dict[str, Any] = {"t": round(event.time_s, 2), "kind": event.kind, "text": event.text}
            if event.lasts:
                end = ends.get(event.kind)
                each["for_s"] = None if end is None else round(_between(event, end), 2)
            if event.noted_s is not None:
                each["noted_s"] = round(event.noted_s, 1)
            is_gap = event.kind in _GAPS and event.lasts
            ends |= dict.fromkeys((event.kind, *(_OF_THE_SCANS if is_gap else ())), event)
            plain.append({**each, "before": True} if old else each)
        return {"events": plain[::-1]}

    def _turn(self, kind: Kind, on: bool, time_s: float, text: str, ago_s: float | None = 0.0) -> bool:
        """Add an event if what lasts begins or ends with it, `ago_s` before now if that is known; return
        whether it does."""
        if on == (kind in self._lasting):
            return False
        self._lasting ^= {kind}
        key = _key(kind, on, time_s)
        if kind in _OF_THE_READER and ago_s is not None:
            key = f"{key} {time.time()}"  # there may be several after one scan
        self._note(key, Event(time_s, kind, text, on), ago_s)
        return True

    def _set_aside(self, which: Callable[[Event], bool]) -> set[str]:
        """Flag the events of kind "tree" or "health" for which `which` is True as from before a change;
        return their keys."""
        keys = {k for k, event in self._events.items() if event.kind in _OF_THE_MAP and which(event)}
        self._before |= {key: self._events.pop(key) for key in sorted(keys)}
        return keys

    @staticmethod
    def _times(frame: Frame, confirmed_s: Float) -> dict[int, float]:
        """Return a dict from the number of each confirmed tree with a known confirmation time to this time
        [s].

        Args:
            frame: The frame.
            confirmed_s: Confirmation time of each tree of the frame [s], shape (T,); NaN if unknown.
        """
        rows = np.flatnonzero(frame.trees.confirmed & np.isfinite(confirmed_s))
        return dict(zip(frame.trees.number[rows].tolist(), confirmed_s[rows].tolist(), strict=True))

    def _note(self, key: str, event: Event, ago_s: float | None = 0.0) -> None:
        """Add an event, which happened `ago_s` before now if that is known, unless one has its key; beyond
        _MOST, remove the oldest of those that go first."""
        noted_s = None if ago_s is None else time.time() - ago_s
        self._events.setdefault(key, replace(event, noted_s=noted_s))
        while len(self._events) > _MOST:
            del self._events[min(self._events, key=lambda known: _goes(self._events[known].kind))]


def _key(kind: Kind, on: bool, time_s: float) -> str:
    """Return the key of the begin or the end of what lasts."""
    return f"{kind} {on} {time_s:.2f}"


def _between(event: Event, end: Event) -> float:
    """Return the time from an event to its end [s], never negative."""
    if event.kind in _OF_THE_READER and event.noted_s is not None and end.noted_s is not None:
        return max(0.0, end.noted_s - event.noted_s)  # a clock may be set back
    return end.time_s - event.time_s


def _goes(kind: Kind) -> int:
    """Return the place of a kind in the order in which events are removed: what an operator is asked for
    afterwards goes last."""
    return {"slow": 0, "tree": 1, "warning": 2, "change": 2, "annotation": 2}.get(kind, 3)
