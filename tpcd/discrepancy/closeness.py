"""What explains the data about as well as the model that is taken, and is told beside it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit
from tpcd.discrepancy.settings import AMBIGUOUS
from tpcd.discrepancy.workbench import Close, Workbench


def still_close(bench: Workbench, close: Iterable[Close], taken: Fit) -> tuple[Close, ...]:
    """What explains the data about as well as the model that is taken, beyond what effects have to
    gain; every other set of effects once, fitted as well as it was."""

    def worth(fit: Fit) -> float:
        return fit.log_evidence - bench.price(fit.effects[bench.given :])

    best: dict[frozenset[str], Close] = {}
    for one in close:
        names = frozenset(one.fit.names)
        if names not in best or one.fit.log_evidence > best[names].fit.log_evidence:
            best[names] = one
    best.pop(frozenset(taken.names), None)
    least = worth(taken) - AMBIGUOUS
    return tuple(one for one in best.values() if worth(one.fit) > least)


def carried_on(bench: Workbench, close: Sequence[Close], best: Fit) -> list[Close]:
    """What came close to a model before its last effect was added, with that effect too, where it
    still comes close."""
    kept, added = [], best.effects[-1]
    for one in close:
        own = one.fit.effects
        if added.name in one.fit.names:
            continue
        fit = bench.attempt(
            f"{' and '.join(one.fit.names)} failed beside {added.name}",
            lambda own=own, one=one: fit_model(
                bench.question, (*own, added), (0, 1), start=(one.fit, best)
            ),
        )
        if fit is not None and fit.log_evidence > best.log_evidence - AMBIGUOUS:
            kept.append(Close(fit, fit.log_evidence - one.fit.log_evidence))
    return kept
