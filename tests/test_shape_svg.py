"""SVG drawings: the path language against closed forms, units, transforms, refusals."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tpcd.errors import OutlineError
from tpcd.shape.svg import _shapes, _user_to_metres, load_svg
from tpcd.shape.svg_path import arc_segments, flatten, parse_path

MM = 'width="200mm" height="100mm" viewBox="0 0 200 100"'


def drawing(tmp_path, body: str, root: str = MM):
    path = tmp_path / "part.svg"
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {root}>{body}</svg>')
    return path


def single(tmp_path, body: str, root: str = MM, **options):
    (outline,) = load_svg(drawing(tmp_path, body, root), **options).values()
    return outline


def svg_shapes(path):
    root = ElementTree.parse(path).getroot()
    return list(_shapes(root, _user_to_metres(root, None)))


def refusal(path, **options) -> str:
    with pytest.raises(OutlineError) as caught:
        load_svg(path, **options)
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message
    return message


def ends(path_text: str) -> list[list[list[float]]]:
    """End points of all segments of all subpaths."""
    return [[s[-1].round(9).tolist() for s in loop] for loop in parse_path(path_text)]


@pytest.mark.parametrize(
    "text",
    [
        "M 10 20 L 30 20 L 30 50 Z",
        "M10,20 30,20 30,50z",
        "m10 20 20 0 0 30z",
        "M10 20H30V50Z",
        "m10 20h20v30z",
        "M1e1 2e+1L300e-1,20L.3e2.5e2z",
        "\n M10 20\tL30 20 30 50",
    ],
)
def test_the_same_triangle_in_every_spelling(text):
    assert ends(text) == [[[30, 20], [30, 50], [10, 20]]]


def test_numbers_and_flags_may_touch():
    spaced = parse_path("M10 10 A 5 5 0 0 1 20 10 L -1 -0.5 Z")
    packed = parse_path("M10 10A5 5 0 0120 10L-1-.5Z")
    assert len(spaced[0]) == len(packed[0])
    for first, second in zip(spaced[0], packed[0], strict=True):
        np.testing.assert_array_equal(first, second)


def test_smooth_curves_mirror_the_control_point_before():
    ((first, second, *_),) = parse_path("M0 0C0 10 10 10 10 0S20-10 20 0")
    np.testing.assert_allclose(second[1], 2 * first[3] - first[2])
    ((first, second, third, *_),) = parse_path("M0 0Q5 10 10 0T20 0T30 0")
    np.testing.assert_allclose(second[1], [15, -10])
    np.testing.assert_allclose(third[1], [25, 10])


def test_smooth_curves_after_another_kind_start_at_their_own_point():
    ((_, second, *_),) = parse_path("M0 0Q5 10 10 0S20-10 20 0")
    np.testing.assert_allclose(second[1], [10, 0])


def test_relative_commands_after_close_go_on_from_the_start_of_the_subpath():
    assert ends("m10 10 h5 v5 z m20 0 h5 v5 z")[1][0] == [35, 10]


@given(
    st.floats(1, 80),
    st.floats(1, 80),
    st.floats(0, 360),
    st.booleans(),
    st.booleans(),
    st.floats(-50, 50),
    st.floats(1, 50),
)
@settings(max_examples=100)
def test_arcs_lie_on_an_ellipse_of_the_given_shape(rx, ry, degrees, large, sweep, x, y):
    """Mapped to circles, all points keep one distance from one centre, the ends are met."""
    start, end = np.zeros(2), np.array([x, y])
    rotation = np.radians(degrees)
    points = np.vstack(
        (flatten(arc_segments(start, (rx, ry), rotation, large, sweep, end), 1e-6), end)
    )
    np.testing.assert_allclose(points[0], start)
    turn = np.array([[np.cos(rotation), np.sin(rotation)], [-np.sin(rotation), np.cos(rotation)]])
    circle = points @ turn.T / [rx, ry]
    system = np.column_stack((2 * circle, np.ones(len(circle))))
    centre = np.linalg.lstsq(system, (circle**2).sum(1), rcond=None)[0][:2]
    radius = np.linalg.norm(circle - centre, axis=1)
    assert np.ptp(radius) < 1e-3 * max(1.0, radius.mean())
    swept = np.unwrap(np.arctan2(*(circle - centre).T[::-1]))
    assert (swept[-1] > swept[0]) == sweep
    half_turn_reached = abs(swept[-1] - swept[0]) > np.pi - 1e-2
    if abs(abs(swept[-1] - swept[0]) - np.pi) > 1e-2:
        assert half_turn_reached == large


def test_flattened_curves_keep_the_tolerance():
    (curve,) = parse_path("M0 0C0 100 100 100 100 0")
    t = np.linspace(0, 1, 2001)[:, None]
    control = curve[0]
    weights = np.hstack([c * t**k * (1 - t) ** (3 - k) for k, c in enumerate((1, 3, 3, 1))])
    true = weights @ control
    for tolerance in (1.0, 0.1, 0.01):
        points = np.vstack((flatten(curve[:1], tolerance), control[-1:]))
        start, step = points[:-1], np.diff(points, axis=0)
        along = ((true[:, None] - start) * step).sum(-1) / (step**2).sum(-1)
        foot = start + np.clip(along, 0, 1)[..., None] * step
        assert np.linalg.norm(true[:, None] - foot, axis=2).min(1).max() <= tolerance


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("L 10 10", "has 'L' at character 1"),
        ("M 10 10 X 5", "has 'X' at character 9"),
        ("M 10", "lacks a number for 'M'"),
        ("M 0 0 C 1 2 3 4", "lacks a number for 'C'"),
        ("M 0 0 A 5 5 0 2 0 1 1", "lacks a number for 'A' at character 15"),
        ("M 0 0 L 1,,b", "lacks a number for 'L'"),
    ],
)
def test_bad_path_data_are_refused_with_their_place(text, expected):
    with pytest.raises(ValueError) as caught:
        parse_path(text)
    assert expected in str(caught.value)


def test_a_path_in_millimetres_becomes_metres_with_z_up(tmp_path):
    outline = single(tmp_path, '<path id="wedge" d="M10 10 H110 V60 Z"/>')
    assert outline.name == "wedge"
    assert outline.size == pytest.approx((0.1, 0.05))
    # The right angle is at the top right of the drawing, so it is right of the centroid, above.
    corner = outline.vertices[np.argmax(outline.vertices.sum(axis=1))]
    np.testing.assert_allclose(corner, [0.1 / 3, 0.05 / 3], atol=1e-12)


@pytest.mark.parametrize(
    ("body", "size", "area"),
    [
        ('<rect x="5" y="5" width="100" height="40"/>', (0.1, 0.04), 0.004),
        ('<rect width="100" height="40" rx="5"/>', (0.1, 0.04), 0.004 - (4 - np.pi) * 25e-6),
        ('<rect width="100" height="40" ry="500"/>', (0.1, 0.04), np.pi * 0.05 * 0.02),
        ('<circle cx="50" cy="50" r="30"/>', (0.06, 0.06), np.pi * 9e-4),
        ('<ellipse cx="50" cy="50" rx="40" ry="20"/>', (0.08, 0.04), np.pi * 8e-4),
        ('<ellipse cx="50" cy="50" rx="40"/>', (0.08, 0.08), np.pi * 16e-4),
        ('<ellipse cx="50" cy="50" ry="40" rx="auto"/>', (0.08, 0.08), np.pi * 16e-4),
        ('<switch><rect display="none"/><g><circle r="5"/></g></switch>', (0.01, 0.01), None),
        ('<polygon points="0,0 100,0 100,50"/>', (0.1, 0.05), 0.0025),
        ('<polyline points="0 0 100 0 100 50"/>', (0.1, 0.05), 0.0025),
        ('<path d="M20 50A30 30 0 1 1 80 50A30 30 0 1 1 20 50"/>', (0.06, 0.06), np.pi * 9e-4),
        ('<rect width="100" height="40" transform="rotate(90)"/>', (0.04, 0.1), 0.004),
        ('<rect width="100" height="40" transform="scale(.5 1) skewX(0)"/>', (0.05, 0.04), 2e-3),
        ('<rect width="40" height="40" transform="skewX(45)"/>', (0.08, 0.04), 0.0016),
        ('<rect width="40" height="40" transform="skewY(45)"/>', (0.04, 0.08), 0.0016),
        ('<rect width="40" height="40" transform="matrix(0 2 1 0 5 5)"/>', (0.04, 0.08), 0.0032),
        ('<g transform="scale(2)"><g transform="scale(2)"><circle r="5"/></g></g>', (0.04, 0.04),
         np.pi * 4e-4),
        ('<rect width="1cm" height="10px"/>', (0.0377953, 0.01), None),
    ],
)  # fmt: skip
def test_shapes_have_their_size_and_area(tmp_path, body, size, area):
    outline = single(tmp_path, body)
    assert outline.size == pytest.approx(size, rel=1e-3)
    if area is not None:
        assert outline.area == pytest.approx(area, rel=2e-3)


def test_rotation_about_a_point_turns_about_it(tmp_path):
    path = drawing(
        tmp_path,
        '<rect id="a" x="10" y="10" width="80" height="20"/>'
        '<rect id="b" x="10" y="10" width="80" height="20" transform="rotate(180 50 20)"/>',
    )
    found = load_svg(path)
    first, second = found["a"].vertices, found["b"].vertices
    assert {tuple(p.round(9) + 0.0) for p in first} == {tuple(p.round(9) + 0.0) for p in second}


def test_holes_are_left_out(tmp_path):
    body = '<path d="M20 10H40V30H20Z M0 0H100V50H0Z M60 10H80V30H60Z"/>'
    assert single(tmp_path, body).area == pytest.approx(0.005)


def test_several_shapes_get_their_ids_or_numbers(tmp_path):
    body = '<circle id="coin" r="12"/><circle r="13"/><circle id="coin" r="14"/>'
    assert list(load_svg(drawing(tmp_path, body))) == ["coin", "part-2", "coin-3"]


INNER = '<svg {} viewBox="0 0 4 6"><rect id="a" width="2" height="3"/></svg>'


@pytest.mark.parametrize(
    ("inner", "size", "corner"),
    [
        ('x="10" y="20" width="40" height="60"', (0.02, 0.03), (10, 20)),
        ('width="40" height="60"', (0.02, 0.03), (0, 0)),
        ('width="80" height="60"', (0.02, 0.03), (20, 0)),
        ('width="80" height="60" preserveAspectRatio="xMaxYMin"', (0.02, 0.03), (40, 0)),
        ('width="80" height="60" preserveAspectRatio="xMinYMid slice"', (0.04, 0.06), (0, -30)),
        ('width="80" height="60" preserveAspectRatio="none"', (0.04, 0.03), (0, 0)),
        ('x="5%" width="20%" height="60%"', (0.02, 0.03), (10, 0)),
        ("", (1 / 30, 0.05), (200 / 3, 0)),
    ],
)
def test_an_inner_drawing_is_scaled_and_placed_by_its_own_view_box(tmp_path, inner, size, corner):
    """Against SVG 2, 8.2, worked out by hand."""
    both = f'<svg><g>{INNER.format(inner)}</g></svg><rect id="b" width="200" height="100"/>'
    found = load_svg(drawing(tmp_path, both))
    assert found["a"].size == pytest.approx(size)
    path = drawing(tmp_path, INNER.format(inner))
    ((_, ((first, *_),)),) = svg_shapes(path)
    np.testing.assert_allclose(1e3 * first[0] * [1, -1], corner, atol=1e-9)


def test_inner_drawings_nest(tmp_path):
    body = (
        '<svg width="100" height="100" viewBox="0 0 10 10"><svg x="1" width="50%" height="5"'
        ' viewBox="0 0 50 50"><rect width="50" height="25"/></svg></svg>'
    )
    assert single(tmp_path, body).size == pytest.approx((0.05, 0.025))


def test_lines_beside_a_shape_are_left_out_and_told(tmp_path):
    body = '<path d="M0 0L50 50"/><path d="M0 0H9H20"/><rect id="plate" width="60" height="90"/>'
    found = load_svg(drawing(tmp_path, body))
    assert list(found) == ["plate"]
    assert "2 lines without an area left out" in found["plate"].notes


@pytest.mark.parametrize(
    "body",
    [
        "<style>.h{display:none}</style><rect width='60' height='90'/>",
        "<style>rect{width:60px}</style><rect width='6' height='9'/>",
        "<rect style='transform: scale(2)' width='60' height='90'/>",
        "<rect style='scale:.5' width='60' height='90'/>",
        "<path style='d:path(\"M0 0H60V90Z\")' d='M0 0H6V9Z'/>",
        "<style>.a{clip-path:url(#c)}</style><rect class='a' width='60' height='90'/>",
        "<defs><style>.a{transform:scale(.5)}</style></defs><rect width='60' height='90'/>",
    ],
)
def test_styles_that_change_shapes_are_refused(tmp_path, body):
    assert "a style hides, moves or sizes shapes" in refusal(drawing(tmp_path, body))


@pytest.mark.parametrize("attribute", ["clip-path", "mask"])
@pytest.mark.parametrize("given", ["{}='url(#c)'", "style='{}:url(#c)'"])
def test_what_is_clipped_is_refused(tmp_path, attribute, given):
    body = f"<rect {given.format(attribute)} width='60' height='90'/>"
    assert "clipped or masked" in refusal(drawing(tmp_path, body))
    assert single(tmp_path, f"<defs>{body}</defs><rect width='60' height='90'/>").area


@pytest.mark.parametrize(
    "body",
    [
        "<g visibility='hidden'><rect visibility='visible' width='60' height='90'/></g>",
        "<g style='visibility:hidden'><g style='visibility : visible'>"
        "<rect visibility='inherit' width='60' height='90'/></g><circle r='9'/></g>",
        "<rect display='none' style='display:inline' width='60' height='90'/>",
        "<rect display=' none ' width='9' height='9'/><rect width='60' height='90'/>",
        "<g transform='scale(1 .26458333)'>"
        "<rect style='width:60px;height:9cm !important' height='1'/></g>",
        "<rect width='30%' height='90%' x='10%'/>",
        "<style>/* width: of lines */.a{fill:red}</style><rect width='60' height='90'/>",
        "<rect width='60' height='90' rx='auto'/><line x2='9'/><polyline points='0 0 9 9'/>",
    ],
)
def test_a_style_goes_before_attributes_and_visibility_is_inherited(tmp_path, body):
    assert single(tmp_path, body).area == pytest.approx(0.0054)


@pytest.mark.parametrize(
    "root",
    [
        'style="width:200mm;height:100mm" viewBox="0 0 200 100"',
        'width="9mm" style="width: 20cm ;height:100mm !important" viewBox="0 0 200 100"',
        'width="200MM" height="10Cm" viewBox="0,0,200,100"',
        'width="800Q" height="400Q" viewBox="0 0 200 100"',
    ],
)
def test_the_size_of_a_drawing_is_read_in_every_spelling(tmp_path, root):
    assert single(tmp_path, '<rect width="60" height="90"/>', root).area == pytest.approx(0.0054)


def test_percent_of_a_radius_are_of_the_diagonal(tmp_path):
    outline = single(tmp_path, '<circle cx="50%" cy="50%" r="10%"/>')
    assert outline.size[0] == pytest.approx(0.2 * np.hypot(0.2, 0.1) / np.sqrt(2), rel=1e-3)
    assert single(tmp_path, '<ellipse rx="30"/>').size == pytest.approx((0.06, 0.06), rel=1e-3)


def test_pixels_of_other_programs_are_not_those_of_css(tmp_path):
    """170.079 pt are 60 mm; Illustrator and Inkscape before 0.92 wrote pixels of their own."""
    body = '<rect width="170.079" height="255.118"/>'
    path = drawing(tmp_path, "<!-- Generator: Adobe Illustrator 27 -->" + body, "")
    assert "its pixels are 1/72 inch; give --unit pt" in refusal(path, unit="px")
    (outline,) = load_svg(path, unit="pt").values()
    assert outline.area == pytest.approx(0.0054, rel=1e-5)
    space = 'xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape" inkscape:version='
    assert single(tmp_path, body, f'{space}"0.92.4"', unit="px").size[0] < 0.06
    assert "1/90 inch" in refusal(drawing(tmp_path, body, f'{space}"0.91 r1"'), unit="px")
    whole = f'{space}"0.91 r1" width="200mm" height="100mm" viewBox="0 0 566.929 283.465"'
    assert single(tmp_path, body, whole).area == pytest.approx(0.0054, rel=1e-5)


def test_a_radius_in_percent_that_stands_alone_counts_for_both(tmp_path):
    wide = 'width="200mm" height="100mm" viewBox="0 0 200 100"'
    for body in ('<ellipse rx="20%"/>', '<ellipse ry="40%"/>'):
        assert single(tmp_path, body, wide).size == pytest.approx((0.08, 0.08), rel=1e-3)


def test_lengths_with_units_keep_them_or_are_refused(tmp_path):
    path = drawing(tmp_path, '<rect width="60mm" height="9cm"/>', "")
    assert "width='60mm' has a unit of its own; give --unit px" in refusal(path, unit="mm")
    (outline,) = load_svg(path, unit="px").values()
    assert outline.size == pytest.approx((0.06, 0.09))


def test_styles_of_colour_change_nothing(tmp_path):
    body = "<style>.a{fill:#f00;stroke-width:2}</style><rect class='a' width='60' height='90'/>"
    assert single(tmp_path, body).area == pytest.approx(0.0054)


def test_what_is_not_drawn_is_left_out(tmp_path):
    body = (
        '<defs><circle id="no" r="5"/></defs><circle style="display: none" r="5"/>'
        '<g display="none"><circle r="5"/></g><circle visibility="hidden" r="5"/>'
        '<text>hello</text><!-- note --><circle r="12"/>'
    )
    assert list(load_svg(drawing(tmp_path, body))) == ["part"]


@pytest.mark.parametrize(
    ("root", "unit", "width"),
    [
        ('width="100mm" height="100mm" viewBox="0 0 100 100"', None, 0.05),
        ('width="10cm" height="10cm" viewBox="0 0 500 500"', None, 0.01),
        ('width="2in" height="2in"', None, 50 * 0.0254 / 96),
        ('width="200mm" height="100mm" viewBox="0 0 100 100"', None, 0.05),
        (
            'width="200mm" height="100mm" viewBox="0 0 100 100" preserveAspectRatio="none"',
            None,
            0.1,
        ),
        ('width="100" height="100"', "mm", 0.05),
        ("", "cm", 0.5),
        ('width="100mm" height="100mm" viewBox="0 0 1 1"', "px", 50 * 0.0254 / 96),
    ],
)
def test_the_unit_comes_from_the_caller_or_from_the_root(tmp_path, root, unit, width):
    outline = single(tmp_path, '<rect width="50" height="50"/>', root, unit=unit)
    assert outline.size[0] == pytest.approx(width)


@pytest.mark.parametrize(
    ("body", "root", "expected"),
    [
        ('<circle r="5"/>', 'width="100" height="100"', "no physical unit"),
        ('<circle r="5"/>', 'width="100px" height="100px"', "--unit mm"),
        ('<circle r="5"/>', "", "no physical unit"),
        ('<circle r="5"/>', 'width="9mm" height="9mm" viewBox="0 0 9"', "viewBox '0 0 9'"),
        ("<text>only words</text>", MM, "holds no shapes"),
        ('<path id="p" d="M0 0L5 X"/>', MM, "<path id='p'>: path data lacks a number"),
        ('<path d="M0 0H50V50Z M60 0H80V20Z"/>', MM, "several separate pieces"),
        ('<path d="M0 0L50 50H0L50 0Z"/>', MM, "crosses or touches itself"),
        ('<path d="M0 0L50 50"/><line x2="5"/>', MM, "2 lines without an area; join the lines"),
        ('<polygon points="0 0 1 1 2"/>', MM, "'points' holds 5 numbers"),
        ('<polygon points="0 0 60mm 0 5 5"/>', MM, "holds 'mm'; expected numbers alone"),
        ('<rect width="-60" height="9"/>', MM, "width='-60' is negative"),
        ('<circle r="5" transform="scale(200%)"/>', MM, "'200%' holds '%'"),
        ('<use href="#a"/>', MM, "clone"),
        (
            '<switch><circle r="5"/><g><rect width="9" height="9"/></g></switch>',
            MM,
            "a <switch> holds",
        ),
        ('<circle r="half"/>', MM, "r='half' is no length"),
        ('<circle r="5" transform="wobble(3)"/>', MM, "transform 'wobble'"),
        ('<circle r="5" transform="scale 3"/>', MM, "is malformed"),
        ('<circle r="0.5"/>', MM, "expected 0.005 to 1 m"),
    ],
)
def test_a_bad_drawing_is_refused_with_its_cause(tmp_path, body, root, expected):
    assert expected in refusal(drawing(tmp_path, body, root))


@pytest.mark.parametrize("text", ["", "not xml", "<svg><circle></svg>"])
def test_what_is_not_xml_is_refused(tmp_path, text):
    path = tmp_path / "bad.svg"
    path.write_text(text)
    assert "not readable as SVG" in refusal(path)


def test_xml_of_another_kind_is_refused(tmp_path):
    path = tmp_path / "page.svg"
    path.write_text("<html/>")
    assert "its root element is <html>" in refusal(path)


def test_an_unknown_unit_is_refused(tmp_path):
    assert "unit 'pound' is unknown" in refusal(drawing(tmp_path, '<circle r="5"/>'), unit="pound")
