"""What the page of a diagnosis shows besides the gap, as text for people."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from tpcd.discrepancy.coverage import Coverage
from tpcd.effects.excitations import MOTIONS, NEEDED, UNITS
from tpcd.figures.style import display_unit

TESTS: dict[str, tuple[str, str]] = {
    "parity": ("pose and wrench disagree, w = K (x - u)", "sensors, spring of the arm"),
    "free_space": ("poses in free space leave their commands", "payload, lag, friction of the arm"),
}
"""What the tests without theta measure, and what shows in them."""


def shown_evidence(log_evidence: float, by_seed: Sequence[float]) -> str:
    """Log evidence, and what each seed gave, as text: `12.1 (seeds: 12.3, 11.9)`."""
    seeds = ", ".join(f"{value:.1f}" for value in by_seed)
    return f"{log_evidence:.1f}" + (f" (seeds: {seeds})" if seeds else "")


def shown_tests(tests: Mapping[str, float]) -> list[dict[str, str]]:
    """The tests that need no theta, as how many times their noise things are off."""
    return [
        {
            "test": what,
            "times the noise": f"{math.sqrt(tests[name]):.2f}",
            "p under noise alone": f"{tests[f'{name}_p']:.2g}",
            "what shows in it": shows,
        }
        for name, (what, shows) in TESTS.items()
        if name in tests
    ]


def shown_coverage(counts: Mapping[str, float]) -> list[dict[str, str]]:
    """How much there is of each excitation, how much is asked for, and the motion that gives it."""
    lacking = Coverage(dict(counts)).missing(list(NEEDED))
    return [
        {
            "excitation": need,
            "there is": _amount(need, counts[need]),
            "asked for": _amount(need, float(NEEDED[need])),
            "": "too little" if need in lacking else "",
            "motion that gives it": MOTIONS[need],
        }
        for need in NEEDED
        if need in counts
    ]


def _amount(need: str, count: float) -> str:
    unit = UNITS[need]
    if unit == "rows":
        return f"{count:.0f} row{'s' if round(count) != 1 else ''}"
    if unit == "1":
        return f"ratio {count:.1f}"
    factor, shown = display_unit(unit)
    return f"{factor * count:.0f} {shown} apart"
