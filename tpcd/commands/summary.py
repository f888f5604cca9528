"""What a belief says of theta in plain numbers, beside what was known before any datum."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tpcd.belief.belief import Belief

STILL_PRIOR = 0.85
"""A 90 % interval that covers more than this share of the prior's counts as nothing learnt."""


def summarise(belief: Belief) -> dict[str, Any]:
    """Mean, 90 % interval, unit and whether it is still the prior, for each parameter."""
    _, prior_low, prior_high = prior_summary(belief)
    low, high = belief.quantile(0.05), belief.quantile(0.95)
    mean, std = belief.mean(), belief.std()
    entries = {}
    for i, (name, unit) in enumerate(zip(belief.prior.names, belief.prior.units, strict=True)):
        within = min(high[i], prior_high[i]) - max(low[i], prior_low[i])
        covered = float(within) / float(prior_high[i] - prior_low[i])
        entries[name] = {
            "mean": float(mean[i]),
            "std": float(std[i]),
            "interval_90": [float(low[i]), float(high[i])],
            "unit": unit,
            "still_the_prior": covered > STILL_PRIOR,
        }
    return {
        "parameters": entries,
        "log_evidence": belief.log_evidence,
        "log_evidence_std": belief.log_evidence_std,
        "outline_misfit_sd": {
            "mean": float(belief.weights @ belief.misfit_sd),
            "interval_90": [
                float(belief.quantile_of(belief.misfit_sd, level)) for level in (0.05, 0.95)
            ],
            "unit": "m",
        },
        "particles": len(belief.weights),
    }


def parameter_rows(belief: Belief) -> list[dict[str, Any]]:
    """The table of theta that a command prints, one row for each parameter."""
    return [
        {
            "parameter": name,
            "mean": entry["mean"],
            "low 5 %": entry["interval_90"][0],
            "high 95 %": entry["interval_90"][1],
            "unit": entry["unit"],
            "learnt": "still the prior" if entry["still_the_prior"] else "yes",
        }
        for name, entry in summarise(belief)["parameters"].items()
    ]


def prior_summary(belief: Belief) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and ends of the 90 % interval of every entry of theta before any datum."""
    prior = belief.prior
    draws = prior.to_vector(prior.sample(4000, torch.Generator().manual_seed(0)))
    levels = torch.tensor([0.05, 0.95], dtype=torch.float64)
    low, high = torch.quantile(draws, levels, dim=0)
    return draws.mean(0), low, high
