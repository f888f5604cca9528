"""The verdict of a check in one sentence, and the exit code that says the same to a program."""

from __future__ import annotations

from tpcd.commands.check_file import LEAST_USABLE
from tpcd.commands.checked import Checked
from tpcd.quality.finding import Finding, Weight

USABLE, IN_PART, NOT_USABLE = 0, 4, 5
"""Exit codes; 1 and 2 are errors, as everywhere."""
MOST_NAMED = 3


def verdict(checked: Checked) -> tuple[int, str]:
    """Exit code and sentence on a recording that was checked."""
    serious = [f for f in checked.findings if f.weight is Weight.SERIOUS]
    doubts = [f for f in checked.findings if f.weight is Weight.DOUBT]
    left = [f for f in checked.findings if f.weight is Weight.LEFT_OUT]
    what = "rows" if checked.kind == "episode" else "samples"
    if serious:
        return NOT_USABLE, f"not usable as it is read: {_named(serious)}"
    if checked.left_out > 1.0 - LEAST_USABLE:
        told = f"not usable: {checked.left_out:.0%} of the {what} are left out ({_kinds(left)})"
        return NOT_USABLE, told
    if left:
        told = f"usable with {_share(checked.left_out)} of the {what} left out ({_kinds(left)})"
        if doubts:
            told += f", and in doubt: {_named(doubts)}"
        return IN_PART, told
    if doubts:
        return IN_PART, f"usable, but in doubt: {_named(doubts)}"
    if checked.untold:
        return (
            IN_PART,
            f"usable in part: {checked.untold}; nothing else is wrong with what is there",
        )
    return USABLE, f"usable: nothing is wrong with its {what}"


def _named(findings: list[Finding]) -> str:
    named = "; ".join(str(each) for each in findings[:MOST_NAMED])
    more = len(findings) - MOST_NAMED
    return named + (f"; and {more} more" if more > 0 else "")


def _kinds(findings: list[Finding]) -> str:
    """How often what was found: 2 frozen, 1 gap."""
    kinds = dict.fromkeys(each.kind for each in findings)
    counts = {kind: sum(each.kind == kind for each in findings) for kind in kinds}
    return ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in counts.items())


def _share(part: float) -> str:
    return f"{part:.1%}" if part >= 1e-3 else "less than 0.1%"
