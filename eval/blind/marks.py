"""The marks of the benchmark: what was asked for, what was found, and whether that will do.

A mark is reached where the share or the median itself is on the right side; its interval says
how sure that is. Marks without a run are not run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from eval.blind.score import Score, median_interval, rate, share_interval
from eval.blind.suites import CLEAN

SLOWEST = 180.0
"""Time of one diagnosis [s]."""
CLOSED = 0.7
"""A formula should close this share of the excess."""
THETA = 3.0
"""Posterior deviations within which theta should be."""
SCALE = "scale"
"""The entry of theta that has no true value for an outline that the prior does not hold."""


@dataclass(frozen=True)
class Finding:
    """A number with its 90 % interval."""

    value: float
    low: float
    high: float
    runs: int
    note: str = ""


@dataclass(frozen=True)
class Mark:
    """One line of the table of marks."""

    item: str
    low: float
    high: float
    found: Callable[[Sequence[Score]], Finding]
    kind: Literal["share", "seconds"] = "share"

    def row(self, scores: Sequence[Score]) -> dict[str, Any]:
        """The line for the table."""
        found = self.found(scores)
        if not found.runs or not math.isfinite(found.value):
            outcome = "not run"
        else:
            outcome = "reached" if self.low <= found.value <= self.high else "missed"
        return {
            "item": self.item,
            "mark": self._asked(),
            "found": self._shown(found.value) if outcome != "not run" else None,
            "90 %": f"{self._shown(found.low)} to {self._shown(found.high)}"
            if outcome != "not run"
            else None,
            "runs": found.runs,
            "outcome": outcome,
            "note": (found.note or None) if found.runs else None,
        }

    def _asked(self) -> str:
        if math.isfinite(self.low) and math.isfinite(self.high):
            return f"{self._shown(self.low)} to {self._shown(self.high)}"
        if math.isfinite(self.low):
            return f">= {self._shown(self.low)}"
        return f"<= {self._shown(self.high)}"

    def _shown(self, value: float) -> str:
        return f"{value:.0f} s" if self.kind == "seconds" else f"{value:.1%}"


def mark_table(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """All marks against all runs."""
    return [mark.row(scores) for mark in MARKS]


def is_falsely_named(score: Score) -> bool:
    """Whether something physical is named or put in a formula."""
    return bool(score.names)


def is_accepted(score: Score) -> bool:
    """Whether the verdict is that the effects of the catalogue it names are all there is."""
    return score.verdict in ("named", "ambiguous") and bool(score.names)


def _share(
    suite: str, what: Callable[[Score], bool], which: Callable[[Score], bool] = lambda s: True
) -> Callable[[Sequence[Score]], Finding]:
    def found(scores: Sequence[Score]) -> Finding:
        return _of(*rate([s for s in scores if s.suite == suite and which(s)], what))

    return found


def _of(count: int, runs: int, note: str = "") -> Finding:
    value = count / runs if runs else math.nan
    return Finding(value, *share_interval(count, runs), runs, note)


def _worst_effect(scores: Sequence[Score]) -> Finding:
    chosen = [s for s in scores if s.suite == "medium"]
    labels = dict.fromkeys(s.label for s in chosen)
    each = [
        _of(*rate([s for s in chosen if s.label == label], lambda s: s.is_exact), f"of {label}")
        for label in labels
    ]
    return min(each, key=lambda one: one.value, default=_of(0, 0))


def _median(
    suites: tuple[str, ...], values: Callable[[Score], Sequence[float]]
) -> Callable[[Sequence[Score]], Finding]:
    def found(scores: Sequence[Score]) -> Finding:
        chosen = [s for s in scores if s.suite in suites and any(map(math.isfinite, values(s)))]
        pooled = [value for score in chosen for value in values(score)]
        return Finding(*median_interval(pooled), len(chosen))

    return found


def _pooled(values: Callable[[Score], Sequence[bool]]) -> Callable[[Sequence[Score]], Finding]:
    """Share of all values of exact medium diagnoses."""

    def found(scores: Sequence[Score]) -> Finding:
        chosen = [s for s in scores if s.suite == "medium" and len(values(s))]
        pooled = [bool(value) for score in chosen for value in values(score)]
        finding = _of(sum(pooled), len(pooled), f"of {len(pooled)} numbers")
        return Finding(finding.value, finding.low, finding.high, len(chosen), finding.note)

    return found


def _theta_within(scores: Sequence[Score]) -> Finding:
    """Entries of theta near the truth, the outline's extents in the place of the scale.

    The scale multiplies an outline of the prior that has a size of its own, so for an object that
    the prior does not hold it has no true value; the note has it and the worst of the others."""
    chosen = [s for s in scores if s.suite == "medium" and s.theta_scores]
    names = dict.fromkeys(name for s in chosen for name in s.theta_scores)
    near = {name: [s.theta_scores[name] <= THETA for s in chosen] for name in names}
    scale = near.pop(SCALE, [])
    pooled = [value for values in near.values() for value in values]
    note = f"of {len(pooled)} numbers"
    if near:
        worst = min(near, key=lambda name: sum(near[name]))
        note += f"; worst {worst} {sum(near[worst]) / len(near[worst]):.0%}"
    if scale:
        note += f"; not counted: scale {sum(scale) / len(scale):.0%}"
    finding = _of(sum(pooled), len(pooled), note)
    return Finding(finding.value, finding.low, finding.high, len(chosen), note)


def _is_clean(score: Score) -> bool:
    return score.label == CLEAN


def _exact(score: Score) -> bool:
    return score.is_exact


def _is_unknown(score: Score) -> bool:
    return score.verdict == "unknown_remains"


def _is_closing_formula(score: Score) -> bool:
    return score.verdict == "formula" and score.closed >= CLOSED


_INF = math.inf
MARKS = (
    Mark("clean (200 runs): false name", -_INF, 0.02, _share("clean", is_falsely_named)),
    Mark("clean (200 runs): false 'unknown'", -_INF, 0.05, _share("clean", _is_unknown)),
    Mark("one medium effect: exact", 0.95, _INF, _share("medium", _exact)),
    Mark("one medium effect: exact, worst effect", 0.85, _INF, _worst_effect),
    Mark("one small effect: exact", 0.75, _INF, _share("small", _exact)),
    Mark("one small effect: wrong name", -_INF, 0.03, _share("small", lambda s: s.is_wrong)),
    Mark("30 steps: exact", 0.85, _INF, _share("short30", _exact)),
    Mark("15 steps: exact", 0.65, _INF, _share("short15", _exact)),
    Mark("3 x noise: exact", 0.85, _INF, _share("noise3", _exact)),
    Mark("press and slide: exact", 0.75, _INF, _share("press", _exact)),
    Mark("press and slide: within ambiguity", 0.92, _INF, _share("press", lambda s: s.is_within)),
    Mark("two effects: exact pair", 0.85, _INF, _share("pairs", _exact)),
    Mark("outside: accepted under a catalogue name", -_INF, 0.05, _share("outside", is_accepted)),
    Mark("outside: formula closes 70 %", 2 / 3, _INF, _share("outside", _is_closing_formula)),
    Mark("gap closed, medium, median", 0.9, _INF, _median(("medium",), lambda s: (s.closed,))),
    Mark("effect size: median error", -_INF, 0.1, _median(("medium",), lambda s: s.size_errors)),
    Mark("effect size: 90 % intervals cover", 0.85, 0.97, _pooled(lambda s: s.size_inside)),
    Mark("theta within 3 sd after the repair", 0.9, _INF, _theta_within),
    Mark("MuJoCo, clean: physical name", -_INF, 0.0, _share("mujoco", is_falsely_named, _is_clean)),
    Mark(
        "MuJoCo, injected effect: exact", 0.8, _INF,
        _share("mujoco", _exact, lambda s: not _is_clean(s)),
    ),
    Mark(
        "time of one diagnosis of 60 steps, median", -_INF, SLOWEST,
        _median(("medium",), lambda s: (s.seconds,)), "seconds",
    ),
)  # fmt: skip
"""In the order of the table in which they were set."""
