"""Outlines from SVG drawings: paths, polygons, rectangles, circles and ellipses.

Every closed shape of the drawing becomes one outline in metres, z up (an SVG's y axis points
down and is flipped). The unit comes from the caller or from a root element whose width and
height are given in mm, cm or in; pixels alone say nothing about size and are refused. Groups
and `transform` are followed; strokes, text and images are not shapes and are left out.
Source: W3C, Scalable Vector Graphics 2, chapters 8 to 10.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import shapely

from tpcd.errors import OutlineError
from tpcd.shape.outline import METRES_PER_UNIT, Outline, make_outline
from tpcd.shape.svg_path import (
    Segments,
    arc_segments,
    ellipse_segments,
    flatten,
    parse_path,
)
from tpcd.shape.svg_values import (
    LENGTH,
    METRES_PER_PIXEL,
    PIXELS_PER_UNIT,
    SIZES,
    chain,
    length_of,
    numbers_in,
    said,
    tag_of,
    transform_in,
)

ALIGNED = {"Min": 0.0, "Mid": 0.5, "Max": 1.0}
"""Share of the room that is left before a viewBox, by preserveAspectRatio."""
PHYSICAL_UNITS = ("mm", "cm", "in", "pt", "pc", "q")
SHAPES = ("path", "polygon", "polyline", "rect", "circle", "ellipse", "line")
MOVING = ("transform", "scale", "rotate", "translate", "d")
"""Properties that move or make a shape where a style has them."""
SHEET = re.compile(
    r"display\s*:\s*none|visibility\s*:\s*(hidden|collapse)|(clip-path|mask)\s*:\s*url|(?<![\w-])"
    rf"({'|'.join(MOVING)}|width|height|r|rx|ry|x|y|cx|cy)\s*:",
    re.IGNORECASE,
)
"""What a style sheet says that would change which shapes there are, or where."""
PIXEL_WRITERS = (
    (re.compile(rb"Adobe Illustrator|ns\.adobe\.com/AdobeIll"), "1/72 inch; give --unit pt"),
    (re.compile(rb"inkscape:version=.0\.([34]|91)"), "1/90 inch; save it by Inkscape 1 first"),
)
"""Programs whose pixel is not that of CSS, and what to do."""
STYLED = "a style hides, moves or sizes shapes; export it as plain SVG (presentation attributes)"
CSS_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
LENGTHS = ("x", "y", "cx", "cy", "x1", "y1", "x2", "y2", *SIZES)
NOT_DRAWN = ("defs", "clipPath", "mask", "symbol", "pattern", "marker", "metadata")


def load_svg(
    path: str | Path, *, unit: str | None = None, tolerance: float = 2e-5
) -> dict[str, Outline]:
    """Outlines of the closed shapes of an SVG drawing [m], named by their ids.

    Args:
        unit: length of one user unit of the drawing (m, cm, mm, in, pt, px); None takes it from
            the root's width, height and viewBox.
        tolerance: largest distance between a curve and its polygon [m].

    Raises:
        OutlineError: unreadable, no shapes, no physical size, bad path data, separate pieces
            in one path, or a shape that is no outline.
    """
    path = Path(path)
    try:
        root = ElementTree.parse(path).getroot()
    except FileNotFoundError:
        raise OutlineError(path, "not found", "give an .svg file") from None
    except (ElementTree.ParseError, OSError, ValueError) as error:
        raise OutlineError(path, f"not readable as SVG ({error})", "export it again") from None
    if tag_of(root) != "svg":
        raise OutlineError(path, f"its root element is <{tag_of(root)}>", "expected <svg>")
    try:
        _check_styles(root, unit)
        _check_pixels(path, root, unit)
        matrix = _user_to_metres(root, unit)
        shapes = list(_shapes(root, matrix))
    except ValueError as error:
        raise OutlineError(path, *str(error).split("; ", 1)) from None
    if not shapes:
        raise OutlineError(path, "holds no shapes", f"expected one of {', '.join(SHAPES)}")
    drawn = [(name, [flatten(loop, tolerance) for loop in loops]) for name, loops in shapes]
    solid = [(name, loops) for name, loops in drawn if any(map(_has_area, loops))]
    lines = _counted(len(drawn) - len(solid), "line")
    if not solid:
        raise OutlineError(path, f"{lines} without an area", "join the lines to one closed path")
    outlines: dict[str, Outline] = {}
    for index, (name, loops) in enumerate(solid):
        name = name or (path.stem if len(solid) == 1 else f"{path.stem}-{index + 1}")
        if name in outlines:
            name = f"{name}-{index + 1}"
        points = _outer_loop(path, name, loops)
        notes = [f"{_counted(len(loops) - 1, 'loop')} inside the outer one, taken for filled"]
        notes = notes if len(loops) > 1 else []
        if len(drawn) > len(solid) and not outlines:
            notes.append(f"{lines} without an area left out")
        outlines[name] = make_outline(
            name, points, path=path, source=path.name, notes="; ".join(notes)
        )
    return outlines


def _has_area(loop: np.ndarray) -> bool:
    """Whether the points of a loop do not lie on a line; guides and axes do."""
    spans = np.linalg.svd(loop - loop.mean(0), compute_uv=False) if len(loop) > 2 else (0.0, 0.0)
    return bool(spans[1] > 1e-6 * spans[0])


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("" if count == 1 else "s")


def _check_styles(root: ElementTree.Element, unit: str | None) -> None:
    """Refuse style sheets that make other shapes of those that are read, and lengths with a unit of
    their own beside a `unit` of the drawing."""
    for element in root.iter():
        if tag_of(element) == "style" and SHEET.search(CSS_COMMENT.sub("", element.text or "")):
            raise ValueError(STYLED)
        sized = unit not in (None, "px") and tag_of(element) in SHAPES
        for key in LENGTHS if sized else ():
            length = LENGTH.match(said(element, key))
            if length and length[2].lower() not in ("", "px", "%"):
                told = f"{key}='{said(element, key)}' has a unit of its own"
                raise ValueError(f"{told}; give --unit px, which keeps it")


def _check_pixels(path: Path, root: ElementTree.Element, unit: str | None) -> None:
    """Refuse pixels, where they count, of programs that mean another length by them."""
    if unit != "px" and (unit or root.get("viewBox")):
        return
    for pattern, told in PIXEL_WRITERS:
        if pattern.search(path.read_bytes()):
            raise ValueError(f"its pixels are {told}")


def _outer_loop(path: Path, name: str, loops: list[np.ndarray]) -> np.ndarray:
    """The loop that holds all others, which are its holes."""
    if len(loops) == 1:
        return loops[0]
    polygons = [shapely.Polygon(loop) for loop in loops if len(loop) >= 3]
    if not polygons:
        return loops[0]
    largest = max(polygons, key=lambda polygon: polygon.area)
    reach = largest.buffer(1e-9)
    for other in polygons:
        if other is not largest and not reach.covers(
            shapely.MultiPoint(list(other.exterior.coords))
        ):
            raise OutlineError(
                path, f"'{name}' has several separate pieces", "draw each as a path of its own"
            )
    return np.asarray(largest.exterior.coords)[:-1]


def _user_to_metres(root: ElementTree.Element, unit: str | None) -> np.ndarray:
    """Affine map (2, 3) from user units, y down, to metres, z up."""
    if unit is not None:
        points = {name: METRES_PER_PIXEL * PIXELS_PER_UNIT[name] for name in ("pt", "px")}
        known = METRES_PER_UNIT | points
        if unit not in known:
            raise ValueError(f"unit {unit!r} is unknown; expected one of {', '.join(known)}")
        return np.array([[known[unit], 0, 0], [0, -known[unit], 0]])
    sizes = [LENGTH.match(said(root, side)) for side in ("width", "height")]
    if not all(size and size[2].lower() in PHYSICAL_UNITS for size in sizes):
        raise ValueError(
            "its width and height name no physical unit, so its size is unknown; "
            "give the unit of its coordinates (--unit mm; --unit pt for Illustrator)"
        )
    metres = [
        float(size[1]) * PIXELS_PER_UNIT[size[2].lower()] * METRES_PER_PIXEL
        for size in sizes
        if size
    ]
    if not root.get("viewBox"):
        return np.array([[METRES_PER_PIXEL, 0, 0], [0, -METRES_PER_PIXEL, 0]])
    if min(metres) <= 0:
        raise ValueError("its width and height are not positive; give its size")
    return chain(np.array([[1.0, 0, 0], [0, -1.0, 0]]), _viewport(root, metres[0], metres[1]))


def _viewport(element: ElementTree.Element, width: float, height: float) -> np.ndarray:
    """Affine map (2, 3) from the coordinates of a viewBox to a viewport of some size (SVG 2, 8.2);
    the identity without a viewBox."""
    text = element.get("viewBox")
    if not text:
        return np.array([[1.0, 0, 0], [0, 1.0, 0]])
    view = np.array(numbers_in(text))
    if len(view) != 4 or min(view[2:]) <= 0:
        raise ValueError(
            f"its viewBox '{text}' has no size; expected four numbers 'x y width height'"
        )
    scale = np.array([width, height]) / view[2:]
    align, _, meet = (element.get("preserveAspectRatio") or "xMidYMid").strip().partition(" ")
    shift = np.zeros(2)
    if align != "none":
        scale[:] = scale.max() if meet.strip() == "slice" else scale.min()
        if align[1:4] not in ALIGNED or align[5:] not in ALIGNED:
            raise ValueError(f"preserveAspectRatio '{align}' is unknown; see SVG 2, 8.6")
        part = np.array([ALIGNED[align[1:4]], ALIGNED[align[5:]]])
        shift = part * (np.array([width, height]) - scale * view[2:])
    return np.column_stack((np.diag(scale), shift - scale * view[:2]))


def _nested(element: ElementTree.Element, around: tuple[float, float]) -> tuple[np.ndarray, tuple]:
    """Map from the user units in an inner <svg> to those around it, and the size of its viewport in
    the new units; `around` is the size of the viewport that it stands in."""
    x, y, width, height = (
        length_of(element, key, whole, default)
        for key, whole, default in zip(
            ("x", "y", "width", "height"), around * 2, ("0", "0", "100%", "100%"), strict=True
        )
    )
    if min(width, height) <= 0:
        raise ValueError("an inner <svg> has no width or height; expected a size")
    view = _viewport(element, width, height)
    size = (width / view[0, 0], height / view[1, 1])
    return chain(np.array([[1.0, 0, x], [0, 1.0, y]]), view), size


def _shapes(
    element: ElementTree.Element,
    matrix: np.ndarray,
    around: tuple[float, float] | None = None,
    visibility: str = "visible",
) -> Iterator[tuple[str, list[Segments]]]:
    """Name and subpaths, mapped by `matrix`, of every shape at or below an element; `around` is the
    size of the viewport that it stands in, `visibility` that of its parent."""
    tag = tag_of(element)
    if tag in NOT_DRAWN or said(element, "display") == "none":
        return
    visibility = said(element, "visibility", visibility).replace("inherit", visibility)
    if tag == "use":
        raise ValueError("it holds a <use> clone; turn clones into paths before exporting")
    if any(said(element, key, "none") != "none" for key in ("clip-path", "mask")):
        raise ValueError("a shape is clipped or masked; apply that before exporting")
    for key in MOVING:
        if said(element, key, "none") not in ("none", element.get(key, "none").strip()):
            raise ValueError(STYLED)
    if around is None:  # the root
        view = numbers_in(element.get("viewBox", ""))
        view = view or [0, 0, *(length_of(element, side, math.nan) for side in ("width", "height"))]
        around = (view[2], view[3])
    elif tag == "svg":
        inner, around = _nested(element, around)
        matrix = chain(matrix, inner)
    matrix = chain(matrix, transform_in(element.get("transform", "")))
    if tag in SHAPES:
        if visibility in ("hidden", "collapse"):
            return
        try:
            subpaths = _subpaths(tag, element, around)
        except ValueError as error:
            raise ValueError(f"<{tag} id='{element.get('id', '')}'>: {error}") from None
        linear, shift = matrix[:, :2], matrix[:, 2]
        moved = [[control @ linear.T + shift for control in loop] for loop in subpaths]
        if moved:
            yield element.get("id", ""), moved
        return
    drawn = [list(_shapes(child, matrix, around, visibility)) for child in element]
    if tag == "switch" and sum(map(bool, drawn)) > 1:
        raise ValueError("a <switch> holds shapes to choose from; leave those that are meant")
    for shapes in drawn:
        yield from shapes


def _subpaths(
    tag: str, element: ElementTree.Element, around: tuple[float, float]
) -> list[Segments]:
    if tag == "path":
        return parse_path(element.get("d", ""))
    if tag in ("polygon", "polyline"):
        numbers = numbers_in(element.get("points", ""))
        if len(numbers) % 2:
            raise ValueError(f"'points' holds {len(numbers)} numbers; expected pairs")
        corners = np.array(numbers).reshape(-1, 2)
        sides = [np.array(pair) for pair in zip(corners, np.roll(corners, -1, 0), strict=True)]
        return [sides] if sides else []
    width, height = around
    diagonal = math.hypot(width, height) / math.sqrt(2)
    if tag == "line":
        x1, x2 = (length_of(element, key, width) for key in ("x1", "x2"))
        y1, y2 = (length_of(element, key, height) for key in ("y1", "y2"))
        return [[np.array([[x1, y1], [x2, y2]])]]
    if tag == "circle":
        radius = length_of(element, "r", diagonal)
        radii = (radius, radius)
    else:
        rx, ry = (
            None if said(element, key, "auto") == "auto" else length_of(element, key, whole)
            for key, whole in (("rx", width), ("ry", height))
        )
        # One alone counts for both, once it is in user units.
        radii = ((ry or 0.0) if rx is None else rx, (rx or 0.0) if ry is None else ry)
    if tag == "rect":
        place = (length_of(element, "x", width), length_of(element, "y", height))
        size = (length_of(element, "width", width), length_of(element, "height", height))
        return [_rectangle(place, size, radii)]
    centre = (length_of(element, "cx", width), length_of(element, "cy", height))
    return [ellipse_segments(centre, radii)]


def _rectangle(
    place: tuple[float, float], size: tuple[float, float], radii: tuple[float, float]
) -> Segments:
    """A rectangle from its upper left corner on, with rounded corners."""
    (x, y), (width, height) = place, size
    rx, ry = min(radii[0], width / 2), min(radii[1], height / 2)
    right, bottom = x + width, y + height
    stops = np.array(
        [
            [x + rx, y], [right - rx, y], [right, y + ry], [right, bottom - ry],
            [right - rx, bottom], [x + rx, bottom], [x, bottom - ry], [x, y + ry],
        ]
    )  # fmt: skip
    segments: Segments = []
    for index in range(0, 8, 2):
        start, end, corner = stops[index], stops[index + 1], stops[(index + 2) % 8]
        segments.append(np.array([start, end]))
        segments.extend(arc_segments(end, (rx, ry), 0.0, False, True, corner))
    return segments
