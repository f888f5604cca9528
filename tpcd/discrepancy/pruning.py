"""Effects that a model no longer needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit
from tpcd.discrepancy.workbench import Workbench
from tpcd.effects.protocol import Effect

_NEARLY_ALIKE = 1e-9


def pruned(bench: Workbench, fit: Fit, asked: Sequence[Effect] | None = None) -> Fit:
    """The model without those of the `asked` effects that it no longer needs; without these all
    but the last are asked about, and the last where its size may be none."""
    own = fit.effects[bench.given :]
    if asked is None:
        asked = own[:-1] + tuple(e for e in needless(bench, fit) if e in own[-1:])
    for effect in asked:
        if effect not in fit.effects:
            continue
        less = tuple(e for e in fit.effects if e is not effect)
        other = bench.attempt(
            f"the model without {effect.name} failed",
            lambda less=less, fit=fit: fit_model(bench.question, less, (0, 1), start=(fit,)),
        )
        if other is None:
            continue
        if fit.log_evidence - other.log_evidence < bench.price((effect,)):
            bench.tell(f"{effect.name} is no longer needed")
            bench.candidates[:] = [
                replace(c, outcome=f"{c.outcome}; no longer needed")
                if c.name == effect.name and c.outcome.startswith("accepted")
                else c
                for c in bench.candidates
            ]
            fit = other
    return fit


def needless(bench: Workbench, fit: Fit) -> list[Effect]:
    """Effects of which the posterior does not say that they are there: what gains g nats has its
    null value sqrt(2 g) sd away at least. The scene has moved on since they were accepted, or the
    model without them had not been found."""
    found, first = [], fit.prior.scene_dimension
    values = fit.prior.to_vector(fit.cloud.positions[:, :-1])
    for number, effect in enumerate(fit.effects):
        count = len(effect.parameters)
        own, first = values[:, first : first + count], first + count
        if number < bench.given:
            continue
        null = torch.tensor([p.null for p in effect.parameters], dtype=torch.float64)
        mean = fit.cloud.weights @ own
        offset = (own - mean) * fit.cloud.weights[:, None].sqrt()
        # In a direction in which the draws do not differ, they say that it is there.
        scale = offset.norm(dim=0).clamp_min(1e-300)
        covariance = (offset / scale).T @ (offset / scale) + _NEARLY_ALIKE * torch.eye(count)
        away = (mean - null) / scale
        if float(away @ torch.linalg.solve(covariance, away)) < 2 * bench.price((effect,)):
            found.append(effect)
    return found
