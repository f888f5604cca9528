"""Half-planes as terrain."""

from __future__ import annotations

import torch

from tpcd.terrain import HalfPlane, floor, wall

POINTS = torch.tensor([[0.0, 0.0], [0.2, -0.1], [-0.3, 0.4]], dtype=torch.float64)


def scalar(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


def test_floor_and_wall_measure_height_and_distance_to_the_left():
    torch.testing.assert_close(floor(scalar(0.05)).signed_distance(POINTS), POINTS[:, 1] - 0.05)
    torch.testing.assert_close(wall(scalar(0.1)).signed_distance(POINTS), 0.1 - POINTS[:, 0])


def test_the_normal_is_the_gradient_of_the_distance():
    slope = HalfPlane(torch.tensor([-0.6, 0.8], dtype=torch.float64), scalar(0.02))
    points = POINTS.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(slope.signed_distance(points).sum(), points)
    torch.testing.assert_close(gradient, slope.direction.expand(3, 2))


def test_a_batch_has_one_terrain_for_each_element():
    heights = torch.tensor([[0.0, 0.1], [0.2, 0.3]], dtype=torch.float64)
    body = floor(heights)
    gaps = body.signed_distance(POINTS.expand(2, 2, 3, 2))
    torch.testing.assert_close(gaps, POINTS[:, 1] - heights[..., None])
    assert torch.equal(body.gather(torch.tensor([3, 0])).offset, heights.flatten()[[3, 0]])


def test_double_widens_what_is_narrow():
    assert floor(torch.tensor(0.1)).double().offset.dtype == torch.float64
