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
from training.data import simple_morphs, with_as_many_vertices
from training.layout import make_layout
from training.module import Targets
from training.polygons import outward_normals, sample_around, support

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


def test_samples_lie_around_the_outlines_with_their_distance(aligned: np.ndarray) -> None:
    polygons = torch.from_numpy(aligned).float()
    generator = torch.Generator().manual_seed(0)
    samples = sample_around(polygons, polygons, 400, (0.001, 0.01), generator)
    assert samples.points.shape == (len(NAMES), 400, 2)
    near, far = samples.distance[:, :280].abs(), samples.distance[:, 280:].abs()
    assert near.mean() < 0.001 < 0.004 < far.mean() < 0.01
    for vertices, points, distance in zip(aligned, samples.points, samples.distance, strict=True):
        ring, at = shapely.LinearRing(vertices), shapely.points(points.double().numpy())
        away = shapely.distance(ring, at)
        np.testing.assert_allclose(distance.abs().numpy(), away, atol=1e-6)
        inside = shapely.contains(shapely.Polygon(vertices), at)
        clear = away > 1e-5
        np.testing.assert_array_equal((distance < 0).numpy()[clear], inside[clear])


def test_support_and_normals_of_a_circle() -> None:
    angles = torch.arange(256) / 256 * 2 * torch.pi
    circle = 0.05 * torch.stack((angles.cos(), angles.sin()), dim=-1)[None] + 0.01
    found = support(circle, angles)
    expected = 0.05 + 0.01 * (angles.cos() + angles.sin())
    torch.testing.assert_close(found[0], expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(outward_normals(circle), (circle - 0.01) / 0.05, atol=1e-5, rtol=0)


def test_errors_across_count_more_than_errors_along(aligned: np.ndarray) -> None:
    targets = Targets.of(torch.from_numpy(aligned[:2]).float() * 10)
    which = torch.arange(2)
    assert float(targets.error(targets.points, which)) == 0.0
    along = torch.stack((-targets.normals[..., 1], targets.normals[..., 0]), dim=-1)
    shifted = targets.error(targets.points + 0.01 * targets.normals[:1, :1], which)
    inflated = targets.error(targets.points + 0.01 * targets.normals, which)
    slid = targets.error(targets.points + 0.01 * along, which)
    # A shift leaves edges alone and lies partly across; both others turn or stretch edges.
    assert shifted < inflated
    assert slid < inflated
    assert float(inflated) > 1e-4


def test_no_morph_crosses_itself_and_few_are_changed(aligned: np.ndarray) -> None:
    rng = np.random.default_rng(1)
    # Beyond the outlines as well, where morphs do cross.
    weights = 1.5 * rng.dirichlet(np.full(len(aligned), 0.3), 400) - 0.5 / len(aligned)
    plain = np.einsum("mn,npc->mpc", weights, aligned)
    morphs = simple_morphs(weights, aligned)
    fine = shapely.is_valid(shapely.polygons(plain))
    assert 0.3 < fine.mean() < 1
    np.testing.assert_allclose(morphs[fine], plain[fine], atol=1e-15)
    assert shapely.is_valid(shapely.polygons(morphs)).all()


def test_added_vertices_change_no_polygon(outlines: list[np.ndarray]) -> None:
    filled = with_as_many_vertices(outlines)
    assert filled.shape[1] == max(len(vertices) for vertices in outlines)
    for vertices, more in zip(outlines, filled, strict=True):
        np.testing.assert_array_equal(more[: len(vertices)], vertices)
        apart = shapely.Polygon(vertices).symmetric_difference(shapely.Polygon(more))
        assert apart.area < 1e-12
        assert (np.linalg.norm(np.roll(more, -1, 0) - more, axis=1) > 0).all()


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
