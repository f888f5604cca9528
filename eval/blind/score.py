"""What each verdict is worth against the key, and how often over many.

A diagnosis is exact where the effects it names are those hidden, no more and no fewer, and it
claims that nothing else is missing; it may call them ambiguous. A diagnosis that failed is none of
that. Shares have exact (Clopper-Pearson) 90 % intervals, medians those of order statistics.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom, binomtest

from eval.blind.cases import null_value
from eval.blind.sealing import Seal, open_key
from eval.blind.suites import MEDIUM, PLACES
from eval.blind.trial import read_verdicts

NUMERICS = "numerics"
"""The one name that stands for no physics."""
LEVEL = 0.9
FAILED: dict[str, Any] = {
    "verdict": "failed",
    "effects": [],
    "alternatives": [],
    "theta_after": [],
    "share_closed": None,
}


@dataclass(frozen=True)
class Score:
    """One case, scored."""

    suite: str
    label: str
    run: int
    truth: tuple[str, ...]
    verdict: str
    names: tuple[str, ...]
    """What was named, without numerics."""
    is_exact: bool
    is_within: bool
    """Exact, or the truth is among the alternatives reported."""
    is_wrong: bool
    """Something else is named and the truth is not even among the alternatives."""
    is_below_limit: bool
    """Nothing is named, and the limits that are reported say that so small an effect could not be
    seen in these data (below the detection limit)."""
    size: float
    """Size of the one effect hidden, relative to the medium one; NaN for none, two, or others."""
    over_limit: float
    """The same relative to the detection limit that is reported: 0 where the report says that no
    size shows, NaN where it has no limit of the effect."""
    closed: float
    """Share of the excess over the noise floor that is gone on fresh data: 0 where an effect is
    hidden and none was named, NaN where there is no excess."""
    size_errors: tuple[float, ...]
    """Relative errors of the sizes of the effects, where exact."""
    size_inside: tuple[bool, ...]
    """Whether each 90 % interval of a parameter of an effect holds the truth, where exact."""
    size_scores: tuple[float, ...]
    """True values minus estimates of these parameters in posterior deviations."""
    theta_scores: dict[str, float]
    """Distances of theta's entries from the truth in posterior deviations, where exact."""
    seconds: float

    @property
    def found(self) -> str:
        """The column of the confusion matrix."""
        named = " + ".join(sorted(self.names))
        if self.verdict == "unknown_remains" and named:
            return f"{named} + unknown"
        return named or self.verdict


def score_verdicts(folder: Path, lines: Iterable[Mapping[str, Any]]) -> list[Score]:
    """Open the keys, after all verdicts; raises `RunError` where one is not the sealed one."""
    return [score_line(open_key(folder, seal_of(line)), line) for line in lines]


def read_scores(folders: Sequence[Path]) -> tuple[list[Score], list[dict[str, Any]]]:
    """The scores of all cases of some folders, and the lines of those that only failed.

    A case that several hold is that of the first with a verdict.
    """
    good: dict[str, tuple[Path, dict[str, Any]]] = {}
    bad: dict[str, tuple[Path, dict[str, Any]]] = {}
    count = 0
    for folder in folders:
        for lines, kept in zip(read_verdicts(folder), (good, bad), strict=True):
            count += len(lines)
            for line in lines:
                kept.setdefault(line["case"], (folder, line))
    bad = {case: found for case, found in bad.items() if case not in good}
    if count > len(good) + len(bad):
        twice = count - len(good) - len(bad)
        print(f"{twice} cases are in several folders and count once", file=sys.stderr)
    # Where the workflow itself failed, it has found nothing.
    sealed = [*good.values(), *(one for one in bad.values() if "key_sha256" in one[1])]
    scores = [one for folder, line in sealed for one in score_verdicts(folder, [line])]
    return scores, [line for _, line in bad.values()]


def seal_of(line: Mapping[str, Any]) -> Seal:
    """The seal in a line."""
    return Seal(line["case"], line["key_sha256"], line["episodes_sha256"])


def score_line(key: Mapping[str, Any], line: Mapping[str, Any]) -> Score:
    """One verdict against its key."""
    found = line.get("diagnosis", FAILED)
    truth, verdict = tuple(sorted(key["hidden"])), found["verdict"]
    names = _physical(effect["name"] for effect in found["effects"])
    stands = verdict in (("named", "ambiguous") if truth else ("nothing_missing", "named"))
    is_exact = stands and set(names) == set(truth)
    offered = [set(_physical(one["names"])) for one in found["alternatives"]]
    is_within = is_exact or (stands and set(truth) in offered)
    sizes = _sizes(key["hidden"], found["effects"]) if is_exact else ([], [], [])
    over = _over_limits(key["hidden"], found)
    return Score(
        suite=key["suite"],
        label=key["label"],
        run=key["run"],
        truth=truth,
        verdict=verdict,
        names=names,
        is_exact=is_exact,
        is_within=is_within,
        is_wrong=not is_within and not set(names) <= set(truth),
        is_below_limit=bool(truth) and not names and max(over) < 1,
        size=_relative_size(key["hidden"]),
        over_limit=over[0] if len(over) == 1 and math.isfinite(over[0]) else math.nan,
        closed=0.0 if truth and not names else _number(found["share_closed"]),
        size_errors=tuple(sizes[0]),
        size_inside=tuple(sizes[1]),
        size_scores=tuple(sizes[2]),
        theta_scores=_theta(key["theta"], found["theta_after"]) if is_exact else {},
        seconds=line["wall_s"] if "diagnosis" in line else math.nan,
    )


def rate(scores: Sequence[Score], what: Callable[[Score], bool]) -> tuple[int, int]:
    """How many of how many."""
    return sum(map(what, scores)), len(scores)


def share_interval(count: int, runs: int) -> tuple[float, float]:
    """Clopper-Pearson interval of a share; nothing is known without runs."""
    if not runs:
        return 0.0, 1.0
    found = binomtest(int(count), int(runs)).proportion_ci(LEVEL, "exact")
    return float(found.low), float(found.high)


def median_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Median and the interval of order statistics that holds it with 90 %; NaN without values."""
    kept = np.sort([value for value in values if math.isfinite(value)])
    if not len(kept):
        return math.nan, math.nan, math.nan
    first = int(binom.ppf((1 - LEVEL) / 2, len(kept), 0.5))
    below = max(first - 1, 0)
    return float(np.median(kept)), float(kept[below]), float(kept[len(kept) - 1 - below])


def confusion(scores: Sequence[Score]) -> tuple[list[str], list[str], list[list[int]]]:
    """Truths, findings and how often each truth was found as what; truths and equals first."""
    counts = Counter((" + ".join(score.truth) or score.label, score.found) for score in scores)
    truths = list(dict.fromkeys(truth for truth, _ in counts))
    found = {finding for _, finding in counts}
    columns = [truth for truth in truths if truth in found]
    columns += sorted(found - set(columns))
    return truths, columns, [[counts[truth, one] for one in columns] for truth in truths]


def _physical(names: Iterable[str]) -> tuple[str, ...]:
    return tuple(name for name in names if name != NUMERICS)


def _sizes(
    hidden: Mapping[str, Mapping[str, float]], effects: Iterable[Mapping[str, Any]]
) -> tuple[list[float], list[bool], list[float]]:
    """Relative errors, whether the intervals hold the truth, and deviations from it."""
    errors, inside, scores = [], [], []
    for effect in effects:
        if effect["name"] not in hidden:  # numerics
            continue
        for found in effect["parameters"]:
            place = effect["name"], found["name"]
            null = null_value(*place)[0]
            true = hidden[effect["name"]].get(found["name"], null)
            inside.append(_number(found["low"]) <= true <= _number(found["high"]))
            scores.append((true - _number(found["value"])) / max(_number(found["sd"]), 1e-12))
            if true != null and place not in PLACES:
                errors.append(abs(_number(found["value"]) - true) / abs(true - null))
    return errors, inside, scores


def _relative_size(hidden: Mapping[str, Mapping[str, float]]) -> float:
    """Size of the only effect relative to the medium one, the root mean square over parameters."""
    if len(hidden) != 1 or not set(hidden) <= set(MEDIUM):
        return math.nan
    ((effect, values),) = hidden.items()
    ratios = [
        (value - null_value(effect, name)[0]) / (MEDIUM[effect][name] - null_value(effect, name)[0])
        for name, value in values.items()
        if (effect, name) not in PLACES
    ]
    return math.hypot(*ratios) / math.sqrt(len(ratios))


def _over_limits(
    hidden: Mapping[str, Mapping[str, float]], found: Mapping[str, Any]
) -> list[float]:
    """How many times the limits that are reported each effect hidden is: its parameters together,
    each in parts of its limit, since their squares add up in what is gained. 0 where the report
    says that no size shows, infinite where it has no limit."""
    limits = {
        (one["name"], one["parameter"]): math.inf if one["size"] is None else one["size"]
        for one in found.get("detection_limits", ())
    }

    def part(effect: str, name: str, value: float) -> float:
        size = abs(value - null_value(effect, name)[0])
        limit = limits.get((effect, name), 0.0)
        return size / limit if limit > 0 else math.inf

    return [
        math.hypot(
            *(part(effect, *one) for one in values.items() if (effect, one[0]) not in PLACES)
        )
        for effect, values in hidden.items()
    ]


def _theta(true: Mapping[str, float], estimates: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    return {
        one["name"]: abs(one["value"] - true[one["name"]]) / max(_number(one["sd"]), 1e-12)
        for one in estimates
        if one["name"] in true
    }


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
