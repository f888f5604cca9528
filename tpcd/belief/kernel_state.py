"""The state of one particle's filter in compiled loops: what is known of the misfit field and of
the last reading's error, before and after a transition.

The formulas of `filter`; `kernel_filter` brings in what a transition tells.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np

from tpcd.loops import inner


class Filter(NamedTuple):
    """The state of one particle's filter and what one transition needs; s = c + 3.

    `mean` (s), `covariance` (s, s); `design` (3, s) of the residual, `cross` (3, s) first its
    covariance with the state, then the gain; `factor` (3, 3) of the residual's covariance;
    `innovation` (3) whitened; `by_theta` (d, s) derivatives of the mean. `gap` (t) is what the
    field changes at the transition, as far as it is known; what ends in `before` is there to
    go back to.
    """

    mean: np.ndarray
    covariance: np.ndarray
    design: np.ndarray
    cross: np.ndarray
    factor: np.ndarray
    innovation: np.ndarray
    by_theta: np.ndarray
    gap: np.ndarray
    mean_before: np.ndarray
    covariance_before: np.ndarray
    gap_before: np.ndarray


@inner(_nrt=True)
@no_type_check
def new_filter(size, entries, terrains):
    """Room for a filter of so many coefficients over some terrains, with derivatives by so many
    entries of theta."""
    return Filter(
        np.zeros(size + 3),
        np.zeros((size + 3, size + 3)),
        np.zeros((3, size + 3)),
        np.zeros((3, size + 3)),
        np.zeros((3, 3)),
        np.zeros(3),
        np.zeros((entries, size + 3)),
        np.zeros(terrains),
        np.zeros(size + 3),
        np.zeros((size + 3, size + 3)),
        np.zeros(terrains),
    )


@inner
@no_type_check
def begin(state, measured, seen, sd):
    """The state before any transition."""
    width = state.mean.shape[0]
    state.by_theta[:] = 0.0
    for a in range(width):
        state.mean[a] = 0.0
        for b in range(width):
            state.covariance[a, b] = 0.0
        own = a - width + 3
        state.covariance[a, a] = sd * sd if own < 0 else measured.variance[seen, 0, own]


@inner
@no_type_check
def pass_over(state, measured, seen, k, size):
    """Pass over transition k: what is known of the next pose is its reading alone."""
    for a in range(3):
        state.mean[size + a] = 0.0
        for r in range(size + 3):
            state.covariance[size + a, r] = state.covariance[r, size + a] = 0.0
        state.covariance[size + a, size + a] = measured.variance[seen, k + 1, a]
    for e in range(state.by_theta.shape[0]):
        for a in range(3):
            state.by_theta[e, size + a] = 0.0


@inner
@no_type_check
def expect_gap(state, measured, k):
    """What the field is known to change of the gaps at transition k; returns by how much that is
    another gap than before."""
    bumps, furthest = measured.bumps.shape[1], 0.0
    for t in range(state.gap.shape[0]):
        before, state.gap[t] = state.gap[t], 0.0
        for j in range(bumps):
            state.gap[t] += measured.bumps[k, j] * state.mean[t * bumps + j]
        furthest = max(furthest, abs(state.gap[t] - before))
    return furthest


@inner
@no_type_check
def copy_state(mean, covariance, into_mean, into_covariance):
    """Keep a state, or go back to one."""
    for a in range(mean.shape[0]):
        into_mean[a] = mean[a]
        for b in range(mean.shape[0]):
            into_covariance[a, b] = covariance[a, b]


@inner
@no_type_check
def is_explained(state, measured):
    """Whether the last innovation lay within the limit."""
    each = state.innovation
    return each[0] ** 2 + each[1] ** 2 + each[2] ** 2 < measured.limit * (1.0 - 1e-9)
