"""Look-ahead: what a command is worth together with the best one after it.

For each command some outcomes are drawn from the belief. Each gives new weights, tells something
of the outline's field, and a new pose, from which goals within reach are rated again; the best
of them is what the second step adds. One more step of the search is one factor of cost, so this
is an option and not the default.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.resampling import systematic_resample
from tpcd.information import Outcomes, belief_outcomes, expected_information_gain
from tpcd.information.gain import outcome_points, pair_log_likelihood, reweight
from tpcd.predict import ContactPredictor

Reach = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Lowest and highest command from a pose."""


def second_step_gain(
    predictor: ContactPredictor,
    outcomes: Outcomes,
    commands: Float[Tensor, "c 3"],
    sensor_std: Float[Tensor, " 6"],
    reach: Reach,
    generator: torch.Generator,
    draws: int = 6,
    goals: int = 24,
) -> Float[Tensor, " c"]:
    """Mean over drawn outcomes of the gain [nat] of the best command after each of c commands.

    `outcomes` are what the predictor expects of the commands.
    """
    seed = int(torch.randint(2**31, (), generator=generator))
    place = torch.quasirandom.SobolEngine(3, scramble=True, seed=seed).draw(goals).double()
    log_likelihood, _ = pair_log_likelihood(outcomes)
    posterior, _ = reweight(log_likelihood, outcomes.weights)
    noise = posterior.shape[1] // posterior.shape[2]
    centre = (outcomes.weights[..., None] * outcomes.mean).sum(1, keepdim=True)
    told = outcome_points(outcomes)[0] + centre
    values = []
    for c, command in enumerate(commands):
        best = []
        # One point of the noise for each particle that is drawn, in turn.
        for s, particle in enumerate(systematic_resample(outcomes.weights[c], draws, generator)):
            pose = outcomes.mean[c, particle]
            low, high = reach(pose)
            found, _ = belief_outcomes(
                predictor, pose, low + (high - low) * place, command, sensor_std
            )
            row = int(particle) * noise + s % noise
            weights = (found.weights > 0) * posterior[c, row]
            total = weights.sum(-1, keepdim=True)
            weights = torch.where(total > 0, weights / total, found.weights)
            found = replace(found, weights=weights).after(outcomes, c, told[c, row])
            best.append(expected_information_gain(found).max())
        values.append(torch.stack(best).mean())
    return torch.stack(values)
