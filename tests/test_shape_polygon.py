"""Laws of `PolygonShape`: exact distances, unit gradients, exact contact points."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.outline import hull, make_outline, signed_distance
from tpcd.shape.polygon import PolygonShape

BUILTIN = builtin_outlines()
NAMES = sorted(BUILTIN)
EMPTY = torch.zeros(0, dtype=torch.float64)


@pytest.mark.parametrize("name", NAMES)
def test_distance_is_shapelys(name):
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.25, 0.25, (500, 2))
    points[:100] = BUILTIN[name].vertices[rng.integers(len(BUILTIN[name].vertices), size=100)]
    points[50:100] += rng.normal(0, 1e-4, (50, 2))
    found = PolygonShape(BUILTIN[name]).signed_distance(torch.tensor(points), EMPTY)
    np.testing.assert_allclose(found.numpy(), signed_distance(BUILTIN[name], points), atol=1e-13)


@pytest.mark.parametrize("name", NAMES)
def test_the_gradient_is_a_unit_vector_also_on_the_outline_and_at_its_corners(name):
    vertices = BUILTIN[name].vertices
    middle = (vertices + np.roll(vertices, -1, 0)) / 2
    rng = np.random.default_rng(3)
    points = torch.tensor(np.concatenate((vertices, middle, rng.uniform(-0.2, 0.2, (200, 2)))))
    points.requires_grad_(True)
    distance = PolygonShape(BUILTIN[name]).signed_distance(points, EMPTY)
    (gradient,) = torch.autograd.grad(distance.sum(), points)
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(len(points)).double())


def test_first_and_second_derivatives_pass_the_finite_difference_check():
    shape = PolygonShape(BUILTIN["hammer"])
    generator = torch.Generator().manual_seed(0)
    points = (0.3 * torch.rand((2, 3, 2), generator=generator, dtype=torch.float64) - 0.15).detach()
    points.requires_grad_(True)
    latent = torch.zeros(2, 0, dtype=torch.float64)

    def distance(p: torch.Tensor) -> torch.Tensor:
        return shape.signed_distance(p, latent)

    assert torch.autograd.gradcheck(distance, (points,), eps=1e-7, atol=1e-6)
    assert torch.autograd.gradgradcheck(distance, (points,), eps=1e-7, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("max_points", [8, 64, 1000])
def test_hull_vertices_are_among_the_boundary_points_bit_for_bit(name, max_points):
    shape = PolygonShape(BUILTIN[name], max_points=max_points)
    points = {tuple(p) for p in shape.boundary_points(EMPTY).tolist()}
    assert {tuple(p) for p in hull(BUILTIN[name]).tolist()} <= points


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("max_points", [24, 1000])
def test_boundary_points_lie_on_the_outline_counter_clockwise(name, max_points):
    points = PolygonShape(BUILTIN[name], max_points).boundary_points(EMPTY).numpy()
    assert np.abs(signed_distance(BUILTIN[name], points)).max() < 1e-12
    x, z = points.T
    area = (x * np.roll(z, -1) - np.roll(x, -1) * z).sum() / 2
    assert area > 0.5 * BUILTIN[name].area


def test_all_vertices_are_taken_where_they_are_few():
    outline = make_outline("square", [[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])
    points = PolygonShape(outline).boundary_points(EMPTY)
    np.testing.assert_array_equal(points.numpy(), outline.vertices)


@pytest.mark.parametrize("batch", [(), (1,), (4,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_answer_has_the_batch_and_dtype_of_the_latent(batch, dtype):
    shape = PolygonShape(BUILTIN["mug"], max_points=32)
    latent = torch.zeros((*batch, 0), dtype=dtype)
    points = torch.full((*batch, 5, 2), 0.5, dtype=dtype)
    boundary = shape.boundary_points(latent)
    assert boundary.shape[:-2] == batch and boundary.dtype == dtype
    distance = shape.signed_distance(points, latent)
    assert distance.shape == (*batch, 5) and distance.dtype == dtype
    assert shape.valid(latent).shape == batch and bool(shape.valid(latent).all())
    assert torch.equal(shape.log_density(latent), torch.zeros(batch, dtype=dtype))


def test_the_latent_has_size_zero_and_the_outline_no_misfit():
    shape = PolygonShape(BUILTIN["mug"])
    assert shape.latent_dim == 0
    assert shape.misfit.sd == 0.0
    assert shape.sample_latent(7, torch.Generator()).shape == (7, 0)


def test_a_batch_is_worth_its_elements_one_by_one():
    shape = PolygonShape(BUILTIN["pliers"])
    generator = torch.Generator().manual_seed(1)
    points = 0.2 * torch.randn((3, 4, 6, 2), generator=generator, dtype=torch.float64)
    together = shape.signed_distance(points, torch.zeros(3, 4, 0))
    alone = torch.stack([shape.signed_distance(p, EMPTY) for p in points.reshape(12, 6, 2)])
    assert torch.equal(together, alone.reshape(3, 4, 6))


def test_fewer_than_three_points_are_refused():
    with pytest.raises(ValueError, match="max_points"):
        PolygonShape(BUILTIN["mug"], max_points=2)
