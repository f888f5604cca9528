"""What a round tried in vain, in place of an effect that the model has.

Effects that look alike differ by little, and a search that misses the mode of one by more names
the other. Beside that, the right one gains hardly anything, but the model with both has found where
it leads. From there, it is asked to do without each of the effects before, one by one (the
sequential replacement of Miller 1984, for the choice of regressors).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from tpcd.discrepancy.closeness import still_close
from tpcd.discrepancy.diagnosis import Candidate
from tpcd.discrepancy.fit import Fit
from tpcd.discrepancy.workbench import (
    Close,
    Round,
    Workbench,
    fit_well,
    gave_way,
    takes_the_place,
)
from tpcd.effects.formula import FORMULA_NAMES
from tpcd.effects.protocol import Effect


@dataclass
class Exchanges:
    """Which models were taken or asked about, so that each is asked about once."""

    models: set[tuple[str, frozenset[str]]] = field(default_factory=set)
    """The question's fingerprint, and the names of effects."""

    def is_new(self, bench: Workbench, names: Iterable[str]) -> bool:
        """Whether this model is seen for the first time."""
        model = bench.question.fingerprint, frozenset(names)
        was_seen = model in self.models
        self.models.add(model)
        return not was_seen


@dataclass(frozen=True)
class _Exchange:
    """A model with a new effect in place of an old one."""

    old: Effect
    fit: Fit
    price: float
    """What it has to gain over the model with the old one."""

    @property
    def worth(self) -> float:
        """Log evidence beyond the price."""
        return self.fit.log_evidence - self.price


def exchanged(
    bench: Workbench,
    current: Fit,
    both: Fit | None,
    without: Fit,
    close: Sequence[Close],
    done: Exchanges,
    explained: bool,
) -> Round:
    """The current model with the last effect of `both`, which a round tried beside it, in place of
    one of its own, where that explains the data better.

    Gains are told over the model `without` its last effect. `close` is what came close to the
    current model, and `explained` says whether it leaves nothing, which what takes its place may
    not either. The base of the round that is returned is the current model, and its `close` what
    explains the data about as well as what is taken.
    """
    number = len(current.effects) - bench.given
    done.is_new(bench, current.names)
    tried = [] if both is None else _tried(bench, current, both, done)
    if any(one.old is current.effects[-1] for one in tried):
        # The same effects were asked about in the round in which the last one was added.
        row = tried[0].fit.names[-1], number
        bench.candidates[:] = [c for c in bench.candidates if (c.name, c.round) != row]
    best = max(tried, key=lambda one: one.worth, default=None)
    taken = None
    for one in sorted(tried, key=lambda one: one.worth):  # the best comes last
        gain = one.fit.log_evidence - current.log_evidence
        stands, reason = False, f"gain {gain:.1f}"
        if one is best:
            stands, reason = takes_the_place(bench, one.fit, current, one.price, number, explained)
            taken = one.fit if stands else None
        _note(bench, one, one.fit.log_evidence - without.log_evidence, number, stands, reason)
    models = (current, *(one.fit for one in tried))
    near = [Close(fit, fit.log_evidence - without.log_evidence) for fit in models if number]
    return Round(current, taken, still_close(bench, (*close, *near), taken or current))


def _tried(bench: Workbench, current: Fit, both: Fit, done: Exchanges) -> list[_Exchange]:
    """Every exchange that is asked about for the first time, where both together gain something.
    Formulas take the place of effects in `rivals`."""
    new = both.effects[-1]
    if not both.log_evidence > current.log_evidence or new.name in FORMULA_NAMES:
        return []
    found = []
    for old in current.effects[bench.given :]:
        effects = (*(effect for effect in current.effects if effect is not old), new)
        if not done.is_new(bench, (effect.name for effect in effects)):
            continue
        fit = bench.attempt(
            f"{new.name} in place of {old.name} failed",
            lambda effects=effects: fit_well(bench, effects, start=(both, current)),
        )
        if fit is not None and math.isfinite(fit.log_evidence):
            found.append(_Exchange(old, fit, bench.price((new,)) - bench.price((old,))))
    return found


def _note(
    bench: Workbench, one: _Exchange, gain: float, number: int, taken: bool, reason: str
) -> None:
    """Put an exchange among the candidates of the last round. Where it is taken, what was asked
    beside the effect that goes will be asked anew, and goes."""
    new, old = one.fit.names[-1], one.old.name
    outcome = f"{'accepted' if taken else 'rejected'} in place of {old}: {reason}"
    bench.tell(f"round {number}: {new} {outcome}")
    kept = bench.candidates
    if taken:
        kept = gave_way((c for c in kept if c.round <= number), (old,), new)
    bench.candidates[:] = [*kept, Candidate(new, number, gain, one.fit.by_seed, outcome)]
