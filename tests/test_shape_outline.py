"""Laws of outlines: what `make_outline` promises, distances, hull, support, resampling."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tpcd.errors import OutlineError
from tpcd.shape import outline as module
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.outline import (
    Outline,
    hull,
    make_outline,
    resample,
    signed_distance,
    support,
    turning_angles,
)

BUILTIN = builtin_outlines()
NAMES = sorted(BUILTIN)
SQUARE = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])


def star(radii: list[float]) -> np.ndarray:
    """A star-shaped polygon, counter-clockwise; simple whatever the radii."""
    angle = np.arange(len(radii)) * 2 * np.pi / len(radii)
    return np.array(radii)[:, None] * np.stack((np.cos(angle), np.sin(angle)), 1)


stars = st.lists(st.floats(0.02, 0.2), min_size=3, max_size=40).map(star)


def segment_distance(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Unsigned distance to a closed polygon by a plain loop over its edges."""
    best = np.full(len(points), np.inf)
    for start, end in zip(vertices, np.roll(vertices, -1, 0), strict=True):
        along = np.clip((points - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
        gap = np.linalg.norm(points - start - along[:, None] * (end - start), axis=1)
        best = np.minimum(best, gap)
    return best


@given(stars)
@settings(max_examples=60)
def test_the_area_centroid_is_the_origin_and_the_order_counter_clockwise(vertices):
    outline = make_outline("star", vertices)
    x, z = outline.vertices.T
    following_x, following_z = np.roll(outline.vertices, -1, 0).T
    cross = x * following_z - following_x * z
    assert cross.sum() > 0
    assert abs(((x + following_x) * cross).sum()) < 1e-12
    assert abs(((z + following_z) * cross).sum()) < 1e-12


@given(stars, st.integers(0, 39), st.booleans())
@settings(max_examples=60)
def test_where_the_vertex_list_starts_and_runs_changes_no_distance(vertices, shift, flip):
    other = np.roll(vertices, shift, axis=0)
    other = other[::-1] if flip else other
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 2))
    expected = signed_distance(make_outline("star", vertices), points)
    found = signed_distance(make_outline("star", other), points)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_distance_agrees_with_a_loop_over_edges_and_has_unit_gradient(name):
    outline = BUILTIN[name]
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.2, 0.2, (200, 2))
    distance = signed_distance(outline, points)
    np.testing.assert_allclose(
        np.abs(distance), segment_distance(points, outline.vertices), atol=1e-12
    )
    step = 1e-7
    gradient = np.stack(
        [
            (signed_distance(outline, points + d) - signed_distance(outline, points - d))
            / (2 * step)
            for d in step * np.eye(2)
        ],
        axis=1,
    )
    # The medial axis, where the gradient jumps, has no area: few points come near it.
    assert (np.abs(np.linalg.norm(gradient, axis=1) - 1) < 1e-4).mean() > 0.98


@pytest.mark.parametrize("name", NAMES)
def test_distance_is_negative_inside_and_positive_outside(name):
    outline = BUILTIN[name]
    edges = np.roll(outline.vertices, -1, 0) - outline.vertices
    normals = np.stack((edges[:, 1], -edges[:, 0]), 1) / np.linalg.norm(edges, axis=1)[:, None]
    middle = outline.vertices + edges / 2
    np.testing.assert_allclose(signed_distance(outline, middle + 1e-6 * normals), 1e-6, rtol=1e-6)
    np.testing.assert_allclose(signed_distance(outline, middle - 1e-6 * normals), -1e-6, rtol=1e-6)


@given(stars)
@settings(max_examples=60)
def test_support_is_the_largest_projection_of_any_vertex(vertices):
    outline = make_outline("star", vertices)
    angle = np.linspace(0, 2 * np.pi, 37)
    directions = np.stack((np.cos(angle), np.sin(angle)), 1)
    expected = [max(float(d @ p) for p in outline.vertices) for d in directions]
    np.testing.assert_allclose(support(outline, directions), expected, atol=1e-15)


@given(stars)
@settings(max_examples=60)
def test_the_hull_is_convex_and_made_of_vertices(vertices):
    outline = make_outline("star", vertices)
    corners = hull(outline)
    assert {tuple(p) for p in corners} <= {tuple(p) for p in outline.vertices}
    after = np.roll(corners, -1, 0) - corners
    before = np.roll(after, 1, axis=0)
    assert (before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] > 0).all()


@given(stars, st.integers(3, 200), st.floats(0, 1))
@settings(max_examples=60)
def test_resampled_points_lie_on_the_polygon_and_are_distinct(vertices, count, weight):
    outline = make_outline("star", vertices)
    points = resample(outline, count, weight)
    assert points.shape == (count, 2)
    assert segment_distance(points, outline.vertices).max() < 1e-12
    assert len(np.unique(points.round(12), axis=0)) == count


def test_resampling_by_arc_length_alone_is_even():
    points = resample(make_outline("square", SQUARE), 40, turning_weight=0.0)
    np.testing.assert_allclose(np.linalg.norm(np.diff(points, axis=0), axis=1), 0.01, atol=1e-12)


def test_resampling_by_turning_puts_a_quarter_of_the_points_at_each_corner_of_a_square():
    outline = make_outline("square", SQUARE)
    points = resample(outline, 80, turning_weight=1.0)
    distance = np.linalg.norm(points[:, None] - outline.vertices, axis=2)
    reach = module.LARGEST_CORNER_REACH * outline.perimeter
    counts = (distance < reach + 1e-12).sum(axis=0)
    np.testing.assert_allclose(counts, 20, atol=1)


@given(stars)
@settings(max_examples=30)
def test_turning_angles_sum_to_one_turn(vertices):
    assert turning_angles(make_outline("star", vertices)).sum() == pytest.approx(2 * np.pi)


def test_repeated_and_closing_vertices_are_dropped():
    doubled = np.repeat(np.vstack((SQUARE, SQUARE[:1])), 2, axis=0)
    assert len(make_outline("square", doubled).vertices) == 4


def test_without_recentring_the_coordinates_stay():
    outline = make_outline("square", SQUARE, recentre=False)
    assert {tuple(p) for p in outline.vertices} == {tuple(p) for p in SQUARE}


def test_size_area_and_perimeter_of_a_square():
    outline = make_outline("square", SQUARE)
    assert outline.size == pytest.approx((0.1, 0.1))
    assert outline.area == pytest.approx(0.01)
    assert outline.perimeter == pytest.approx(0.4)


def test_vertices_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        make_outline("square", SQUARE).vertices[0, 0] = 1.0


def refusal(vertices, **options) -> str:
    with pytest.raises(OutlineError) as caught:
        make_outline("thing", vertices, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_crossing_is_named_with_its_place():
    bow_tie = [[0.0, 0.0], [0.1, 0.1], [0.1, 0.0], [0.0, 0.1]]
    assert "crosses or touches itself at (0.05, 0.05) m" in refusal(bow_tie)


def test_a_curve_that_touches_itself_is_refused():
    pinched = [[0.0, 0.0], [0.1, 0.0], [0.05, 0.05], [0.1, 0.1], [0.0, 0.1], [0.05, 0.05]]
    assert "at (0.05, 0.05) m" in refusal(pinched)


@pytest.mark.parametrize(
    ("vertices", "expected"),
    [
        (SQUARE[:2], "2 distinct vertices"),
        (SQUARE[[0, 1, 0, 1]], "no area"),
        ([[0.0, 0.0], [0.05, 0.0], [0.1, 0.0]], "encloses no area"),
        (SQUARE * 1000, "looks like millimetres"),
        (SQUARE / 0.0254, "it would be 0.039 m in cm, 0.1 m in in: give metres, or the unit"),
        (SQUARE / 1000, "expected 0.005 to 1 m"),
        (SQUARE * 1e6, "expected 0.005 to 1 m"),
        ([[0.0, 0.0], [0.1, np.nan], [0.1, 0.1]], "vertex 1 is (0.1, nan)"),
        ([[0.0, 0.0], [0.1, np.inf], [0.1, 0.1]], "vertex 1 is (0.1, inf)"),
        (np.zeros((4, 3)), "shape (4, 3)"),
        (np.zeros(4), "shape (4,)"),
        (np.zeros((0, 2)), "0 distinct vertices"),
        ([["a", "b"]] * 4, "not a number"),
    ],
)
def test_what_is_no_outline_is_refused_with_its_cause(vertices, expected):
    assert expected in refusal(vertices)


@pytest.mark.parametrize("after", [SQUARE, SQUARE / 2 + 0.02, SQUARE[::-1] + 0.2])
def test_vertices_that_follow_a_closed_curve_are_refused(after):
    assert "is closed by vertex 4, and 4 follow" in refusal(
        [*SQUARE, SQUARE[0], *after[:3], [1, 0]]
    )


def test_the_file_to_blame_stands_first():
    assert refusal(SQUARE[:2], path="shapes.npz").startswith("shapes.npz: outline 'thing' ")


@pytest.mark.parametrize(("count", "weight"), [(2, 0.5), (10, -0.1), (10, 1.1)])
def test_resample_refuses_senseless_arguments(count, weight):
    with pytest.raises(ValueError, match="must"):
        resample(make_outline("square", SQUARE), count, weight)


def test_outlines_are_records_of_name_source_and_notes():
    outline = make_outline("square", SQUARE, source="a ruler", notes="none")
    assert isinstance(outline, Outline)
    assert (outline.name, outline.source, outline.notes) == ("square", "a ruler", "none")
