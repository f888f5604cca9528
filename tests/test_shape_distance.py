"""Distances to polygons in batches: shapely's, also for crossing and degenerate polygons."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tpcd.shape import distance as module
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.distance import polygon_distance

BUILTIN = builtin_outlines()


def star(rng: np.random.Generator, corners: int) -> np.ndarray:
    """A random polygon that does not cross itself, counter-clockwise."""
    angle = (np.arange(corners) + rng.uniform(0, 0.9, corners)) * 2 * np.pi / corners
    return rng.uniform(0.2, 1.0, (corners, 1)) * np.stack((np.cos(angle), np.sin(angle)), axis=1)


def expected(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    away = shapely.distance(shapely.LinearRing(polygon), shapely.points(points))
    inside = shapely.contains_xy(shapely.Polygon(polygon), points[:, 0], points[:, 1])
    return np.where(inside, -away, away)


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), corners=st.integers(3, 40))
def test_distance_is_shapelys_for_each_element(seed: int, corners: int) -> None:
    rng = np.random.default_rng(seed)
    polygons = np.stack([star(rng, corners) for _ in range(3)])
    points = rng.uniform(-1.3, 1.3, (3, 50, 2))
    points[:, :10] = polygons[:, rng.integers(corners, size=10)] + rng.normal(0, 1e-3, (3, 10, 2))
    found = polygon_distance(torch.tensor(points), torch.tensor(polygons)).numpy()
    for one, polygon, at in zip(found, polygons, points, strict=True):
        np.testing.assert_allclose(one, expected(polygon, at), atol=1e-12)


def test_chunks_do_not_change_anything(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    polygons = torch.tensor(np.stack([star(rng, 17) for _ in range(7)]))
    points = torch.tensor(rng.uniform(-1.2, 1.2, (7, 33, 2)))
    whole = polygon_distance(points, polygons)
    for size in (1, 100, 17 * 33 * 2, 17 * 33 * 3 + 5):
        monkeypatch.setattr(module, "CHUNK", size)
        assert torch.equal(polygon_distance(points, polygons), whole)


def test_loops_of_a_crossing_polygon_count_as_one() -> None:
    """A pentagram: its winding number is two in the middle and one in its tips."""
    angle = 2 * np.pi * np.arange(5) * 2 / 5 + 0.1
    polygon = np.stack((np.cos(angle), np.sin(angle)), axis=1)
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.1, 1.1, (2000, 2))
    found = polygon_distance(torch.tensor(points)[None], torch.tensor(polygon)[None])[0].numpy()
    rim = shapely.LinearRing(polygon)
    star_shape = shapely.make_valid(shapely.Polygon(polygon)).union(
        shapely.Polygon(polygon).convex_hull.intersection(shapely.Point(0, 0).buffer(0.38))
    )
    clear = shapely.distance(rim, shapely.points(points)) > 1e-3
    inside = shapely.contains_xy(star_shape, points[:, 0], points[:, 1])
    np.testing.assert_array_equal((found < 0)[clear], inside[clear])
    away = shapely.distance(rim, shapely.points(points))
    np.testing.assert_allclose(np.abs(found), away, atol=1e-12)


def test_repeated_vertices_change_nothing() -> None:
    outline = BUILTIN["mug"].vertices
    doubled = np.repeat(outline, 2, axis=0)
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (500, 2))
    found = polygon_distance(torch.tensor(points)[None], torch.tensor(doubled)[None])[0]
    np.testing.assert_allclose(found.numpy(), expected(outline, points), atol=1e-13)


def test_gradients_by_points_and_vertices_are_exact() -> None:
    rng = np.random.default_rng(2)
    polygons = torch.tensor(np.stack([star(rng, 9) for _ in range(2)]), requires_grad=True)
    points = torch.tensor(rng.uniform(-1, 1, (2, 12, 2)), requires_grad=True)
    assert torch.autograd.gradcheck(polygon_distance, (points, polygons), eps=1e-7, atol=1e-6)
    (slope,) = torch.autograd.grad(polygon_distance(points, polygons).sum(), points)
    torch.testing.assert_close(slope.norm(dim=-1), torch.ones(2, 12).double())


@pytest.mark.parametrize(("n", "s"), [(0, 5), (3, 0), (1, 1)])
def test_empty_batches(n: int, s: int) -> None:
    square = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]]).expand(n, 4, 2)
    assert polygon_distance(torch.full((n, s, 2), 0.5), square).shape == (n, s)
