"""What a round tried in vain, in place of an effect that the model has.

Effects that look alike differ by little, and a search that misses the mode of one by more names
the other. Beside that, the right one gains hardly anything, but the model with both has found where
it leads. From there, it is asked to do without each of the effects before (the exchange step of
stepwise selection, see Miller 2002, Subset Selection in Regression).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from tpcd.discrepancy.diagnosis import Candidate
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit
from tpcd.discrepancy.settings import AMBIGUOUS
from tpcd.discrepancy.workbench import Close, Round, Workbench, gave_way
from tpcd.effects.formula import FORMULA_NAMES
from tpcd.effects.protocol import Effect

Asked = set[tuple[str, frozenset[str]]]
"""Models that were taken, or asked about: under which question, with which effects."""


def exchanged(bench: Workbench, found: Round, close: Sequence[Close], asked: Asked) -> Round:
    """The model with the last effect of what a round tried in place of one of its own, where that
    explains the data better; `close` is what came close to the model before.

    Each set of effects is asked about once, which `asked` keeps. The round that is returned has the
    model before as its base, and as `close` what explains the data about as well as what is taken.
    """
    current, tried = found.base, found.tried
    asked.add(_model(bench, current.names))
    vain = tried is None or tried.log_evidence <= current.log_evidence
    if tried is None or vain or tried.names[-1] in FORMULA_NAMES:  # those are asked in `rivals`
        return Round(current, None, tuple(close))
    new, fits = tried.effects[-1], []
    for old in current.effects[bench.given :]:
        effects = (*(effect for effect in current.effects if effect is not old), new)
        model = _model(bench, (effect.name for effect in effects))
        if model in asked:
            continue
        asked.add(model)
        fit = bench.attempt(
            f"{new.name} in place of {old.name} failed",
            lambda e=effects: fit_model(bench.question, e, (0, 1), start=(tried, current)),
        )
        if fit is not None:
            fits.append((fit.log_evidence - bench.price((new,)) + bench.price((old,)), old, fit))
    best = max(fits, key=lambda one: one[0], default=(-math.inf, None, current))
    taken = best[2] if best[0] > current.log_evidence else None
    number = len(current.effects) - bench.given
    without = current.log_evidence - _gain(bench, number)
    for _, old, fit in fits:
        _note(bench, old, fit, number, fit.log_evidence - without, fit is taken)
    least = (taken or current).log_evidence - AMBIGUOUS
    near = [*close, *(Close(fit, fit.log_evidence - without) for _, _, fit in fits)]
    near += [Close(current, current.log_evidence - without)] if taken else []
    kept = (one for one in near if one.fit is not taken and one.fit.log_evidence > least)
    return Round(current, taken, tuple(kept))


def _model(bench: Workbench, names: Iterable[str]) -> tuple[str, frozenset[str]]:
    return bench.question.fingerprint, frozenset(names)


def _gain(bench: Workbench, number: int) -> float:
    """What was accepted in a round gained; the least that this can be, where it is not known."""
    own = (c for c in bench.candidates if c.round == number and c.outcome.startswith("accepted"))
    return max((c.gain for c in own), default=bench.settings.least_gain)


def _note(
    bench: Workbench, old: Effect, fit: Fit, number: int, gain: float, is_taken: bool
) -> None:
    """Put an exchange among the candidates of the last round, in place of what was found there.
    Where it is taken, what was asked beside the effect that goes will be asked anew."""
    name = fit.names[-1]
    outcome = f"{'accepted' if is_taken else 'rejected'} in place of {old.name}: gain {gain:.1f}"
    bench.tell(f"round {number}: {name} {outcome}")
    kept = [c for c in bench.candidates if (c.name, c.round) != (name, number)]
    if is_taken:
        kept = gave_way((c for c in kept if c.round <= number), (old.name,), name)
    bench.candidates[:] = [*kept, Candidate(name, number, gain, fit.by_seed, outcome)]
