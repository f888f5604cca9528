"""Laws of the built-in outlines and their variants."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from tpcd.shape.builtin import builtin_outlines, random_outlines, vary
from tpcd.shape.household import ENTRIES
from tpcd.shape.outline import make_outline, turning_angles

BUILTIN = builtin_outlines()
SHARPEST_EDGE = 0.0009
"""Radius below which an edge counts as sharp [m]: 1 mm less the tolerance of drawing."""


def test_there_are_at_least_24_objects_each_with_a_source():
    assert len(BUILTIN) >= 24
    assert all(outline.source for outline in BUILTIN.values())


@pytest.mark.parametrize("name", sorted(BUILTIN))
def test_every_outline_passes_the_door_unchanged(name):
    outline = BUILTIN[name]
    again = make_outline(name, outline.vertices)
    np.testing.assert_allclose(again.vertices, outline.vertices, atol=1e-15)
    assert 0.03 < max(outline.size) < 0.4


@pytest.mark.parametrize("name", sorted(BUILTIN))
def test_edges_are_rounded(name):
    """No vertex turns sharply, and a disc of the least radius reaches into every corner."""
    outline = BUILTIN[name]
    assert np.abs(turning_angles(outline)).max() < np.radians(50)
    polygon = outline.polygon
    opened = polygon.buffer(-SHARPEST_EDGE, quad_segs=32).buffer(SHARPEST_EDGE, quad_segs=32)
    assert shapely.hausdorff_distance(polygon.exterior, opened.exterior) < 0.0003


def test_some_are_far_from_convex():
    filling = {name: o.area / o.polygon.convex_hull.area for name, o in BUILTIN.items()}
    assert sum(share < 0.8 for share in filling.values()) >= 8
    assert sum(share > 0.98 for share in filling.values()) >= 8


@pytest.mark.parametrize(
    ("name", "width", "height"),
    [
        ("soup_can", 0.0683, 0.1016),
        ("bank_card", 0.0856, 0.05398),
        ("battery", 0.0342, 0.0615),
        ("golf_ball", 0.04267, 0.04267),
        ("brick", 0.240, 0.071),
        ("hex_nut", 0.055 / np.cos(np.pi / 6), 0.055),
        ("wine_bottle", 0.076, 0.300),
        ("light_bulb", 0.060, 0.106),
        ("hammer", 0.118, 0.320),
    ],
)
def test_sizes_are_the_published_ones(name, width, height):
    # Rounding a sharp tip (the points of the nut) takes a little of the size.
    assert BUILTIN[name].size == pytest.approx((width, height), abs=0.0005)


def test_variants_follow_the_seed_and_differ_from_each_other():
    first = random_outlines(12, np.random.default_rng(5))
    second = random_outlines(12, np.random.default_rng(5))
    other = random_outlines(12, np.random.default_rng(6))
    assert [o.name for o in first] == [o.name for o in second]
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(first, second, strict=True))
    assert [o.name for o in first] != [o.name for o in other]
    assert len({o.name for o in first}) == 12


@pytest.mark.parametrize("spread", [0.1, 0.25, 0.5])
def test_variants_are_valid_and_of_plausible_size(spread):
    for outline in random_outlines(150, np.random.default_rng(7), spread):
        assert outline.polygon.is_valid
        assert 0.01 < max(outline.size) < 0.7


def test_every_entry_can_vary():
    rng = np.random.default_rng(8)
    for entry in ENTRIES.values():
        varied = vary(entry, rng, 0.25)
        factors = [varied.dimensions[key] / entry.dimensions[key] for key in entry.dimensions]
        assert min(factors) >= 0.75 and max(factors) <= 1.25
        assert len(set(factors)) == len(factors)


def test_no_spread_gives_the_entry_itself():
    variants = random_outlines(10, np.random.default_rng(9), spread=0.0)
    for outline in variants:
        original = BUILTIN[outline.name.split("~")[0]]
        np.testing.assert_allclose(outline.vertices, original.vertices, atol=1e-15)


@pytest.mark.parametrize("spread", [-0.1, 1.0, float("nan")])
def test_a_senseless_spread_is_refused(spread):
    with pytest.raises(ValueError, match="spread"):
        random_outlines(1, np.random.default_rng(0), spread)
