"""Correspondence, layouts and polygon distances that the training of priors rests on."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tpcd.shape.builtin import builtin_outlines
from training.config import LayoutConfig
from training.correspondence import correspond, measure, round_corners
from training.layout import make_layout
from training.polygons import sample_around, signed_distance

NAMES = ("mug", "banana", "drink_can", "juice_carton", "pear", "bowl", "wrench", "brick")


@pytest.fixture(scope="module")
def outlines() -> list[np.ndarray]:
    known = builtin_outlines()
    return [known[name].vertices for name in NAMES]


@pytest.fixture(scope="module")
def aligned(outlines: list[np.ndarray]) -> np.ndarray:
    return correspond(outlines, 128, 0.001, 0.5)


def test_resampled_outlines_stay_on_the_originals(
    outlines: list[np.ndarray], aligned: np.ndarray
) -> None:
    for true, points in zip(outlines, aligned, strict=True):
        distance = shapely.distance(shapely.LinearRing(true), shapely.points(points))
        # A corner of 1 mm radius is cut by at most (sqrt 2 - 1) mm, a sharp tip by more.
        assert distance.mean() < 0.0003
        assert distance.max() < 0.0025
        assert shapely.Polygon(points).is_valid
        assert shapely.is_ccw(shapely.LinearRing(points))


def test_half_of_the_points_of_a_box_sit_at_its_corners() -> None:
    box = np.array([(-0.1, -0.05), (0.1, -0.05), (0.1, 0.05), (-0.1, 0.05)])
    curve = measure(round_corners(box, 0.001), 0.5)
    points = curve.at(np.arange(400) / 400)
    to_corner = np.linalg.norm(points[:, None] - box[None], axis=-1).min(axis=1)
    assert (to_corner < 0.008).mean() == pytest.approx(0.5 + 0.5 * 0.064 / 0.6, abs=0.05)


@settings(max_examples=4)
@given(shift=st.integers(0, 299))
def test_where_an_outline_starts_does_not_matter(shift: int) -> None:
    known = builtin_outlines()
    first, second = known["mug"].vertices, known["pear"].vertices
    plain = correspond([first, second], 64, 0.001, 0.5)
    rolled = correspond([first, np.roll(second, shift % len(second), axis=0)], 64, 0.001, 0.5)
    assert np.abs(plain - rolled).max() < 0.002


def test_polygon_distance_agrees_with_shapely(outlines: list[np.ndarray]) -> None:
    rng = np.random.default_rng(0)
    for vertices in outlines:
        points = rng.uniform(-0.15, 0.15, (300, 2))
        found, gradient = signed_distance(
            torch.from_numpy(points)[None], torch.from_numpy(vertices.copy())[None]
        )
        polygon = shapely.Polygon(vertices)
        away = shapely.distance(polygon.exterior, shapely.points(points))
        inside = shapely.contains_xy(polygon, points[:, 0], points[:, 1])
        np.testing.assert_allclose(found[0].numpy(), np.where(inside, -away, away), atol=1e-12)
        np.testing.assert_allclose(gradient[0].norm(dim=-1).numpy(), 1.0, atol=1e-9)
        # Walking back along the gradient by the distance ends on the outline.
        landed = points - (found[0, :, None] * gradient[0]).numpy()
        assert shapely.distance(polygon.exterior, shapely.points(landed)).max() < 1e-9


def test_samples_lie_around_the_outlines(aligned: np.ndarray) -> None:
    polygons = torch.from_numpy(aligned).float()
    generator = torch.Generator().manual_seed(0)
    samples = sample_around(polygons, polygons, 400, (0.001, 0.01), 0.2, generator)
    assert samples.points.shape == (len(NAMES), 400, 2)
    near = samples.distance[:, :200].abs()
    assert near.mean() < 0.001
    assert (samples.points.abs() <= 0.26).all()


@pytest.mark.parametrize("latent_dim", [2, 3])
def test_latents_in_between_have_closed_outlines(aligned: np.ndarray, latent_dim: int) -> None:
    config = LayoutConfig(between=400, components=3, attempts=2, neighbours=4)
    layout = make_layout(aligned, latent_dim, config, np.random.default_rng(0))
    assert (np.abs(layout.codes) <= 1).all()
    apart = np.linalg.norm(layout.codes[:, None] - layout.codes[None], axis=-1)
    assert apart[~np.eye(len(apart), dtype=bool)].min() > 0.02
    latents = layout.weights @ layout.codes + layout.offsets
    assert latents.shape == (400, latent_dim)
    assert (np.abs(latents) <= 1 + 1e-9).all()
    np.testing.assert_allclose(layout.outline_weights.sum(axis=1), 1.0, atol=1e-9)
    morphs = np.einsum("mn,npc->mpc", layout.outline_weights, aligned)
    assert shapely.is_valid(shapely.polygons(morphs)).mean() > 0.85
    assert (layout.mixture is None) == (latent_dim == 2)


def test_a_code_on_the_square_has_its_own_outline(aligned: np.ndarray) -> None:
    config = LayoutConfig(between=4000, attempts=2)
    layout = make_layout(aligned, 2, config, np.random.default_rng(0))
    latents = layout.weights @ layout.codes + layout.offsets
    for index, code in enumerate(layout.codes):
        nearest = np.linalg.norm(latents - code, axis=1).argmin()
        # The nearest of 4000 latents lies about 0.02 away, a few per cent of a neighbour.
        assert layout.outline_weights[nearest, index] > 0.8
