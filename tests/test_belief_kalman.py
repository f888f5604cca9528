"""The filter of misfit and reading errors against dense normal distributions."""

from __future__ import annotations

import math

import pytest
import torch
from filter_oracle import assimilate, first_state
from torch import Tensor
from torch.distributions import MultivariateNormal

from tpcd.belief.kernel_given import OUTLIER_SQUARE

STEPS, COEFFICIENTS = 4, 5


def normal(*shape: int, generator: torch.Generator) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def test_innovations_and_field_equal_those_of_one_dense_normal_distribution() -> None:
    """Residuals r_k = e_k - F_k e_{k-1} + H_k c + v_k, all at once and one by one."""
    generator = torch.Generator().manual_seed(0)
    m, n, c = 3, STEPS, COEFFICIENTS
    sd = torch.tensor([0.3, 0.7, 1.5], dtype=torch.float64)
    rows = normal(m, n, 3, c, generator=generator)
    from_start = normal(m, n, 3, 3, generator=generator)
    variance = 0.1 + normal(n + 1, 3, generator=generator) ** 2
    root = 0.3 * normal(m, n, 3, 3, generator=generator)
    uncovered = root @ root.mT
    residual = 0.5 * normal(m, n, 3, generator=generator)
    state, total = first_state(sd, c, variance[0]), torch.zeros(m, dtype=torch.float64)
    for k in range(n):
        # The model starts where the filter says, not where the reading was.
        moved = (from_start[:, k] @ state.mean[:, c:, None])[..., 0]
        state, found = assimilate(
            state,
            residual[:, k] + moved,
            rows[:, k],
            from_start[:, k],
            variance[k + 1],
            uncovered[:, k],
        )
        total = total + found.log_density
    for i in range(m):
        errors = torch.zeros(3 * n, 3 * (n + 1), dtype=torch.float64)
        for k in range(n):
            here = slice(3 * k, 3 * k + 3)
            errors[here, 3 * k : 3 * k + 3] = -from_start[i, k]
            errors[here, 3 * k + 3 : 3 * k + 6] = torch.eye(3)
        field = rows[i].reshape(-1, c)
        noise = errors @ torch.diag(variance.flatten()) @ errors.T
        dense = noise + torch.block_diag(*uncovered[i]) + sd[i] ** 2 * field @ field.T
        flat = residual[i].flatten()
        expected = MultivariateNormal(torch.zeros_like(flat), dense).log_prob(flat)
        torch.testing.assert_close(total[i], expected, atol=1e-9, rtol=1e-9)
        gain = sd[i] ** 2 * field.T @ torch.linalg.inv(dense)
        torch.testing.assert_close(state.mean[i, :c], gain @ flat, atol=1e-9, rtol=1e-9)
        conditional = sd[i] ** 2 * (torch.eye(c, dtype=torch.float64) - gain @ field)
        torch.testing.assert_close(state.covariance[i, :c, :c], conditional, atol=1e-9, rtol=1e-9)
        # The error of the last pose, which the next transition starts with.
        cross = torch.zeros(3, 3 * n, dtype=torch.float64)
        cross[:, -3:] = torch.diag(variance[-1])
        last = cross @ torch.linalg.solve(dense, flat)
        torch.testing.assert_close(state.mean[i, c:], last, atol=1e-9, rtol=1e-9)


def one_residual(distance: float, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Log density and field of a residual along x at a distance, unit noise, unit field."""
    state = first_state(torch.ones(1, dtype=torch.float64), rows.shape[-1], torch.ones(3).double())
    residual = torch.tensor([[distance, 0.0, 0.0]], dtype=torch.float64)
    zeros = torch.zeros(1, 3, 3, dtype=torch.float64)
    state, found = assimilate(
        state, residual, rows, zeros, torch.ones(3, dtype=torch.float64), zeros
    )
    return found.log_density, state.mean


def test_log_likelihood_of_an_outlier_falls_with_the_logarithm_of_its_distance() -> None:
    rows = torch.zeros(1, 3, 0, dtype=torch.float64)
    near, _ = one_residual(1e2, rows)
    far, _ = one_residual(1e4, rows)
    assert float(near - far) == pytest.approx(3 * math.log(1e2), rel=1e-6)


def test_an_outlier_bends_the_field_no_more_than_a_residual_at_the_border() -> None:
    rows = torch.ones(1, 3, 2, dtype=torch.float64)
    moved = []
    for distance in (10.0, 1e3, 1e5):
        _, mean = one_residual(distance, rows)
        moved.append(float(mean[0, :2].abs().max()))
    assert moved[0] > moved[1] > moved[2] > 0
    assert moved[0] < math.sqrt(OUTLIER_SQUARE)
