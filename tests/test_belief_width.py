"""The closing draws against draws from the prior alone, where those still find the posterior."""

from __future__ import annotations

import torch

from eval.drawn import draw_episode
from tpcd.belief.belief import target_of
from tpcd.belief.history import history_of
from tpcd.belief.prior import make_prior
from tpcd.belief.resampling import effective_sample_size, normalise_log_weights
from tpcd.belief.settings import EstimatorSettings
from tpcd.exploration import Estimator
from tpcd.shape.checkpoint import load_prior

SEEDS = (92007, 92008, 92013)
"""The first ones from 92000 on where more than 250 draws from the prior count."""
DRAWS, AT_ONCE = 200_000, 20_000
SETTINGS = EstimatorSettings(misfit_sd=1e-4, misfit_spread=0.0)


def widths(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Log of the ratio of the deviations of theta, and the shift of its mean in deviations."""
    shape = load_prior("ycb21-z2")
    prior, generator = make_prior(shape), torch.Generator().manual_seed(seed)
    _, episode = draw_episode(prior, SETTINGS, 2, generator)
    belief = Estimator(shape, settings=SETTINGS).learn(episode, generator).belief
    target = target_of(episode, shape, SETTINGS).given(history_of(episode))
    scores, found = [], []
    for _ in range(DRAWS // AT_ONCE):
        scores.append(target.sample(AT_ONCE, generator))
        found.append(target.log_likelihood(scores[-1], None))
    weights = normalise_log_weights(torch.cat(found))
    assert effective_sample_size(weights) > 150
    vectors = prior.to_vector(torch.cat(scores)[:, :-1])
    mean = weights @ vectors
    std = (weights @ (vectors - mean) ** 2).sqrt()
    return (belief.std() / std).log(), (belief.mean() - mean) / std


def test_after_two_moves_the_belief_is_as_wide_as_the_posterior() -> None:
    """Components that end before the posterior does make a belief that is too sure: by 8 % on 12
    such episodes, when places were chosen by the weights themselves, for 12,000 draws."""
    ratios, shifts = zip(*(widths(seed) for seed in SEEDS), strict=True)
    assert 0.94 < float(torch.stack(ratios).mean().exp()) < 1.05
    assert float(torch.stack(shifts).square().mean().sqrt()) < 0.25
