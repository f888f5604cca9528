"""Variance of what particles say about some quantities, now and as it is expected after a command.

A particle i says `values_i + T_i f` of v quantities, with j standard normal numbers f that it does
not know, and an outcome y tells of f what Kalman's formulas say: its mean moves to
S_i^T L_i^-1 (y - mean_i), with S_i = L_i^-1 field_i. So what particles say about the quantities
depends on the outcome twice, by their weights and by their fields. By the law of total variance
what is left is the variance between particles of what they then say, in the mean over outcomes,
and what the outcome leaves within each of them.

Axes: c commands, m particles, n outcomes that are looked at, k channels, v quantities, j numbers of
a field.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.information.gain import outcome_points, pair_log_likelihood, reweight, split_commands
from tpcd.information.outcomes import Outcomes


def present_variance(
    weights: Float[Tensor, "c m"],
    values: Float[Tensor, "m v"],
    field: Float[Tensor, "m v j"] | None = None,
) -> Float[Tensor, " c"]:
    """Mean over v quantities of their variance by the particles' weights, before any command."""
    centred = values - values.mean(0)
    variance = weights @ centred.square() - (weights @ centred).square()
    if field is not None:
        variance = variance + weights @ field.square().sum(-1)
    return variance.mean(-1)


def expected_variance(
    outcomes: Outcomes,
    values: Float[Tensor, "m v"],
    field: Float[Tensor, "m v j"] | None = None,
) -> Float[Tensor, " c"]:
    """Mean over v quantities of their variance expected after each command.

    `values` are what each particle says about the quantities, such as the predicted poses of
    a task in units of their tolerance, and `field` how they answer the same j numbers as
    `outcomes.field`. Without the latter nothing is learnt of them.
    """
    expected = []
    for part in split_commands(outcomes):
        statement, within = _after(part, values - values.mean(0), field)
        log_likelihood, share = pair_log_likelihood(part)
        posterior, _ = reweight(log_likelihood, part.weights)
        drawn, _ = outcome_points(part)
        # Statements are linear in the outcome: numbers that multiply 1 and its k channels.
        entries = torch.cat((torch.ones_like(drawn[..., :1]), drawn), -1)[..., : statement.shape[2]]
        mean = sum(
            entries[..., a, None] * (posterior @ statement[:, :, a])
            for a in range(statement.shape[2])
        )
        square = posterior @ (statement @ statement.mT).flatten(2)
        square = square.unflatten(-1, (statement.shape[2], -1))
        second = ((square @ entries[..., None])[..., 0] * entries).sum(-1)
        between = (second - mean.square().sum(-1)).clamp_min(0.0) / values.shape[1]
        expected.append((share * between).sum(-1) + (part.weights * within).sum(-1))
    return torch.cat(expected)


def _after(
    outcomes: Outcomes, values: Float[Tensor, "m v"], field: Float[Tensor, "m v j"] | None
) -> tuple[Float[Tensor, "c m a v"], Float[Tensor, "#c m"]]:
    """What each particle says after an outcome y, as factors of 1 and, where it learns of its
    field, of the k channels of y (a is 1 or 1 + k); and the mean variance that its field leaves."""
    present = values.new_zeros(1, len(values))
    if field is not None:
        present = field.square().sum(-1).mean(-1)[None]
    if field is None or outcomes.field is None:
        return values[:, None].expand(len(outcomes.mean), -1, -1, -1), present
    taught = outcomes.field_share @ field.mT
    slope = torch.linalg.solve_triangular(outcomes.factor.mT, taught, upper=True)
    _, mean = outcome_points(outcomes)
    at_zero = values - (mean[..., None] * slope).sum(-2)
    return torch.cat((at_zero[:, :, None], slope), 2), present - taught.square().sum(-2).mean(-1)
