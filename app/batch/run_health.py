"""The health of a whole run for run.json: how many scans were good, weak or lost, when, and why."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

from app.common.text import count
from pipeline.types.pose_health import Health, HealthState
from pipeline.types.records import Frame

MOST_SPANS = 200  # written; the rest is counted


@dataclass(slots=True)
class _Span:
    """Scans after one another in one state; the reason is that of the first."""

    state: HealthState
    reason: str
    first: int
    last: int
    start_ns: int
    end_ns: int


@dataclass(slots=True, eq=False)
class RunHealth:
    """Takes the health of each scan and sums it up."""

    _scans: Counter[str] = field(default_factory=Counter)
    _spans: list[_Span] = field(default_factory=list)
    _spans_left_out: int = 0
    _was: HealthState = "good"
    _worst: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of_both(cls, first: RunHealth, second: RunHealth, scans: int, shift_ns: int) -> RunHealth:
        """Of two runs after one another: the second comes after so many scans, later by `shift_ns`."""
        moved = [
            replace(
                span,
                first=span.first + scans,
                last=span.last + scans,
                start_ns=span.start_ns + shift_ns,
                end_ns=span.end_ns + shift_ns,
            )
            for span in second._spans
        ]
        spans = first._spans + moved
        left_out = first._spans_left_out + second._spans_left_out + max(len(spans) - MOST_SPANS, 0)
        worst = {
            name: (min if name in ("n_eff", "ancestors") else max)(
                run._worst[name] for run in (first, second) if name in run._worst
            )
            for name in {**first._worst, **second._worst}
        }
        return cls(first._scans + second._scans, spans[:MOST_SPANS], left_out, second._was, worst)

    def add(self, frame: Frame) -> None:
        """Take the next scan."""
        health = frame.health
        self._scans[health.state] += 1
        self._remember_worst(health)
        if health.state != "good":
            self._extend(frame, health)
        self._was = health.state

    def _extend(self, frame: Frame, health: Health) -> None:
        if health.state == self._was and (self._spans or self._spans_left_out):
            if not self._spans_left_out:
                self._spans[-1].last, self._spans[-1].end_ns = frame.index, frame.stamp_ns
        elif len(self._spans) < MOST_SPANS:
            at, stamp = frame.index, frame.stamp_ns
            self._spans.append(_Span(health.state, health.reason, at, at, stamp, stamp))
        else:
            self._spans_left_out += 1

    def _remember_worst(self, health: Health) -> None:
        found = {
            "sigma_xy_m": health.sigma_xy,
            "sigma_yaw_deg": math.degrees(health.sigma_yaw),
            "innovation": health.innovation,
            "odometry_sigmas": health.odometry,
            "ambiguous": health.ambiguous,
        }
        for name, value in found.items():
            if math.isfinite(value):
                self._worst[name] = max(value, self._worst.get(name, 0.0))
        for name, value in {"n_eff": health.n_eff, "ancestors": float(health.ancestors)}.items():
            self._worst[name] = min(value, self._worst.get(name, math.inf))

    def record(self, start_ns: int) -> dict[str, Any]:
        """As it stands in run.json; times are seconds after `start_ns`."""
        return {
            "scans": {state: self._scans[state] for state in ("good", "weak", "lost")},
            "worst": {name: round(value, 4) for name, value in sorted(self._worst.items())},
            "spans": [
                {
                    "state": span.state,
                    "reason": span.reason,
                    "scans": [span.first, span.last],
                    "time_s": [round((t - start_ns) * 1e-9, 3) for t in (span.start_ns, span.end_ns)],
                }
                for span in self._spans
            ],
            "spans_left_out": self._spans_left_out,
        }

    def summary(self) -> list[str]:
        """A line for people when not all was good."""
        weak, lost = self._scans["weak"], self._scans["lost"]
        if not weak and not lost:
            return []
        why = Counter(span.reason.partition(" by ")[0].partition(" for ")[0] for span in self._spans)
        return [f"health: {count(weak, 'scan')} weak, {lost} lost; most often: {why.most_common(1)[0][0]}"]
