"""The shipped priors keep what their cards promise, measured again on a subset."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import shapely
import torch

from tpcd.shape.checkpoint import load_prior
from tpcd.shape.deepsdf import DeepSDFShape
from tpcd.shape.levelset import decode, decodes_plausibly
from tpcd.shape.protocol import Shape
from tpcd.shape.ycb import load_ycb, ycb_folder
from training.evaluate import level_set_errors, outline_errors
from training.validity import decodes_well

PRIORS = ("ycb21-z2", "ycb-rich", "ycb-rich-holdout")


@functools.cache
def prior(name: str) -> DeepSDFShape:
    return load_prior(name)


def draws(name: str, count: int, seed: int = 0) -> torch.Tensor:
    return prior(name).sample_latent(count, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", PRIORS)
def test_a_shipped_prior_is_a_shape(name: str) -> None:
    shape = prior(name)
    assert isinstance(shape, Shape)
    assert 0 < shape.misfit.sd < 0.02
    assert shape.codes.shape == (len(shape.names), shape.latent_dim)
    assert (shape.codes.abs() <= 1).all()
    assert torch.equal(shape.code_of(shape.names[3]), shape.codes[3])
    with pytest.raises(KeyError, match="no training outline"):
        shape.code_of("nothing")


@pytest.mark.parametrize("name", PRIORS)
def test_the_misfit_is_between_that_of_training_and_of_unseen_outlines(name: str) -> None:
    shape = prior(name)
    unseen = np.log(list(shape.card["unseen"]["hull_rms_mm_by_outline"].values()))
    between = np.log(1000 * shape.misfit.sd * np.sqrt(1 + shape.misfit.grain**2))
    trained = 2 * between - unseen.mean()
    # In a different norm, and no logarithm: within a factor of two.
    support = shape.card["training_errors_mm"]["support"]["mean"]
    assert trained == pytest.approx(np.log(support), abs=np.log(2))
    assert shape.misfit.spread > 0.45 * (unseen.mean() - trained)


@pytest.mark.parametrize("name", PRIORS)
def test_draws_are_valid_and_decode_to_one_closed_outline(name: str) -> None:
    latents = draws(name, 200)
    shape = prior(name)
    assert shape.valid(latents).all()
    assert shape.log_density(latents).isfinite().all()
    bad = int((~decodes_plausibly(shape, latents)).sum())
    # 99.5 % of draws must decode: more than 6 failures in 200 has a chance below 1e-4.
    assert bad <= 6
    assert shape.card["valid_share"] >= 0.995
    assert shape.card["unchecked_valid_share"] >= 0.995
    assert shape.card["valid_draws"] >= 1000


@pytest.mark.parametrize("name", PRIORS)
def test_outlines_run_counter_clockwise_and_do_not_cross_themselves(name: str) -> None:
    shape, latents = prior(name), draws(name, 300, seed=1)
    points = shape.boundary_points(latents)
    after = points.roll(-1, -2)
    areas = points[..., 0] * after[..., 1] - points[..., 1] * after[..., 0]
    assert (areas.sum(-1) > 0).all()
    assert decodes_well(shape.network, latents).all()


@pytest.mark.parametrize("name", PRIORS)
def test_the_traced_level_set_is_the_outline(name: str) -> None:
    """What is left is what the grid cuts off at corners."""
    shape, latents = prior(name), draws(name, 6, seed=3)
    away, felt = level_set_errors(shape, latents)
    assert np.quantile(away, 0.95) < 0.05
    assert away.max() < 0.4
    assert np.nanquantile(felt, 0.5) < 0.3
    assert shape.card["level_set_to_outline_mm"]["p95"] < 0.05


@pytest.mark.parametrize("name", PRIORS)
def test_the_signed_distance_is_that_to_the_outline(name: str) -> None:
    shape, latents = prior(name), draws(name, 20, seed=6)
    outlines = shape.boundary_points(latents).double().numpy()
    points = np.random.default_rng(0).uniform(-0.15, 0.15, (20, 50, 2))
    found = shape.signed_distance(torch.tensor(points), latents).numpy()
    for one, outline, at in zip(found, outlines, points, strict=True):
        away = shapely.distance(shapely.LinearRing(outline), shapely.points(at))
        np.testing.assert_allclose(np.abs(one), away, atol=1e-7)


@pytest.mark.skipif(ycb_folder() is None, reason="the YCB outlines are not on this machine")
@pytest.mark.parametrize("name", PRIORS)
def test_training_outlines_come_back_as_the_card_says(name: str) -> None:
    shape, outlines = prior(name), load_ycb("all")
    known = [n for n in shape.names if n in outlines][::4][:6]
    assert len(known) >= 3
    for outline in known:
        found = outline_errors(shape, shape.code_of(outline), outlines[outline].vertices)
        promised = shape.card["training_errors_by_outline_mean_p95_max"][outline]["outline"]
        assert found["outline"].mean() == pytest.approx(promised[0], abs=0.02, rel=0.05)


def test_the_two_latent_prior_meets_its_targets() -> None:
    card = prior("ycb21-z2").card
    errors = card["training_errors_mm"]
    assert errors["outline"]["mean"] <= 0.5
    assert errors["outline"]["p95"] <= 2.0
    assert errors["eikonal"]["mean"] <= 0.05
    assert card["training_cpu_seconds"] <= 2 * 180


@pytest.mark.parametrize("name", PRIORS)
def test_the_gradient_norm_is_within_five_per_cent_of_one(name: str) -> None:
    assert prior(name).card["training_errors_mm"]["eikonal"]["mean"] <= 0.05


def test_the_rich_prior_fits_unseen_outlines() -> None:
    unseen = prior("ycb-rich").card["unseen"]
    assert unseen["best_fit_mm"]["mean"] <= 2.0
    seen = set(prior("ycb-rich-holdout").names)
    assert not seen & set(unseen["mean_mm_by_outline"])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_batch_axes_and_dtype_follow_the_latent(dtype: torch.dtype, batch: tuple) -> None:
    shape = prior("ycb21-z2")
    flat = draws("ycb21-z2", math.prod(batch)).to(dtype)
    latent = flat.reshape(*batch, 2)
    points = shape.boundary_points(latent)
    assert points.shape == (*batch, 128, 2)
    assert points.dtype == dtype
    distance = shape.signed_distance(points, latent)
    assert distance.shape == (*batch, 128)
    assert distance.dtype == dtype
    one = shape.boundary_points(flat[0])
    torch.testing.assert_close(points.reshape(-1, 128, 2)[0], one, atol=1e-6, rtol=0)


def test_gradients_of_points_and_distance_are_exact() -> None:
    shape = prior("ycb21-z2").to(torch.float64)
    latent = draws("ycb21-z2", 2, seed=4).requires_grad_()
    generator = torch.Generator().manual_seed(0)
    # Not on the outline's own points: distances have a kink there.
    away = 0.01 * torch.randn((2, 4, 2), generator=generator, dtype=torch.float64)
    points = (shape.boundary_points(latent).detach()[:, ::40] + away).requires_grad_()
    assert torch.autograd.gradcheck(lambda z: shape.boundary_points(z)[:, ::16], latent)
    assert torch.autograd.gradcheck(shape.signed_distance, (points, latent))


def test_decoding_finds_the_outline() -> None:
    shape = prior("ycb21-z2")
    latent = shape.code_of("011_banana")
    found = decode(shape, latent, spacing=0.001)
    assert found.plausible
    traced = shapely.LinearRing(found.closed[0])
    points = shapely.points(shape.boundary_points(latent).numpy())
    assert shapely.distance(traced, points).mean() < 0.0001
