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
    NUMBER,
    Segments,
    arc_segments,
    ellipse_segments,
    flatten,
    parse_path,
)

METRES_PER_PIXEL = 0.0254 / 96
"""CSS defines 96 pixels to the inch."""
PIXELS_PER_UNIT = {"": 1.0, "px": 1.0, "pt": 96 / 72, "pc": 16.0} | {
    unit: metres / METRES_PER_PIXEL for unit, metres in METRES_PER_UNIT.items() if unit != "m"
}
PHYSICAL_UNITS = ("mm", "cm", "in", "pt", "pc")
LENGTH = re.compile(rf"\s*({NUMBER.pattern})\s*([a-zA-Z%]*)\s*$")
TRANSFORM = re.compile(r"\s*,?\s*([a-zA-Z]+)\s*\(([^)]*)\)")
SHAPES = ("path", "polygon", "polyline", "rect", "circle", "ellipse")
NOT_DRAWN = ("defs", "clipPath", "mask", "symbol", "pattern", "marker", "metadata")


def load_svg(
    path: str | Path, *, unit: str | None = None, tolerance: float = 2e-5
) -> dict[str, Outline]:
    """Outlines of the closed shapes of an SVG drawing [m], named by their ids.

    Args:
        unit: length of one user unit of the drawing (m, cm, mm, in, px); None takes it from
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
    if _tag(root) != "svg":
        raise OutlineError(path, f"its root element is <{_tag(root)}>", "expected <svg>")
    try:
        matrix = _user_to_metres(root, unit)
        shapes = list(_shapes(root, matrix))
    except ValueError as error:
        raise OutlineError(path, *str(error).split("; ", 1)) from None
    if not shapes:
        raise OutlineError(path, "holds no shapes", f"expected one of {', '.join(SHAPES)}")
    outlines: dict[str, Outline] = {}
    for index, (name, subpaths) in enumerate(shapes):
        name = name or (path.stem if len(shapes) == 1 else f"{path.stem}-{index + 1}")
        if name in outlines:
            name = f"{name}-{index + 1}"
        points = _outer_loop(path, name, [flatten(loop, tolerance) for loop in subpaths])
        inside = len(subpaths) - 1
        loops = "1 loop" if inside == 1 else f"{inside} loops"
        notes = f"{loops} inside the outer one, taken for filled" if inside else ""
        outlines[name] = make_outline(name, points, path=path, source=path.name, notes=notes)
    return outlines


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
        known = METRES_PER_UNIT | {"px": METRES_PER_PIXEL}
        if unit not in known:
            raise ValueError(f"unit {unit!r} is unknown; expected one of {', '.join(known)}")
        return np.array([[known[unit], 0, 0], [0, -known[unit], 0]])
    sizes = [LENGTH.match(root.get(side, "")) for side in ("width", "height")]
    if not all(size and size[2] in PHYSICAL_UNITS for size in sizes):
        raise ValueError(
            "its width and height name no physical unit, so its size is unknown; "
            "give the unit of its coordinates (--unit mm)"
        )
    metres = [
        float(size[1]) * PIXELS_PER_UNIT[size[2]] * METRES_PER_PIXEL for size in sizes if size
    ]
    view = [float(value) for value in NUMBER.findall(root.get("viewBox", ""))]
    if not view:
        return np.array([[METRES_PER_PIXEL, 0, 0], [0, -METRES_PER_PIXEL, 0]])
    if len(view) != 4 or min(view[2:]) <= 0 or min(metres) <= 0:
        raise ValueError(
            f"its viewBox '{root.get('viewBox')}' has no size; "
            "expected four numbers 'x y width height'"
        )
    x_scale, y_scale = metres[0] / view[2], metres[1] / view[3]
    if root.get("preserveAspectRatio", "").strip() != "none":
        x_scale = y_scale = min(x_scale, y_scale)
    return np.array([[x_scale, 0, 0], [0, -y_scale, 0]])


def _shapes(
    element: ElementTree.Element, matrix: np.ndarray
) -> Iterator[tuple[str, list[Segments]]]:
    """Name and subpaths, mapped by `matrix`, of every shape at or below an element."""
    tag = _tag(element)
    if tag in NOT_DRAWN or "display:none" in element.get("style", "").replace(" ", ""):
        return
    if element.get("display") == "none":
        return
    if tag == "use":
        raise ValueError("it holds a <use> clone; turn clones into paths before exporting")
    matrix = _chain(matrix, _transform(element.get("transform", "")))
    if tag in SHAPES:
        try:
            subpaths = _subpaths(tag, element)
        except ValueError as error:
            raise ValueError(f"<{tag} id='{element.get('id', '')}'>: {error}") from None
        linear, shift = matrix[:, :2], matrix[:, 2]
        moved = [[control @ linear.T + shift for control in loop] for loop in subpaths]
        if moved:
            yield element.get("id", ""), moved
        return
    for child in element:
        yield from _shapes(child, matrix)


def _subpaths(tag: str, element: ElementTree.Element) -> list[Segments]:
    if tag == "path":
        return parse_path(element.get("d", ""))
    if tag in ("polygon", "polyline"):
        numbers = [float(value) for value in NUMBER.findall(element.get("points", ""))]
        if len(numbers) < 6 or len(numbers) % 2:
            raise ValueError(f"'points' holds {len(numbers)} numbers; expected pairs, 3 or more")
        corners = np.array(numbers).reshape(-1, 2)
        return [[np.array(pair) for pair in zip(corners, np.roll(corners, -1, 0), strict=True)]]
    if tag == "rect":
        return [_rectangle(element)]
    centre = (_length(element, "cx"), _length(element, "cy"))
    radii = ("r", "r") if tag == "circle" else ("rx", "ry")
    return [ellipse_segments(centre, (_length(element, radii[0]), _length(element, radii[1])))]


def _rectangle(element: ElementTree.Element) -> Segments:
    x, y, width, height = (_length(element, key) for key in ("x", "y", "width", "height"))
    rx = _length(element, "rx" if "rx" in element.attrib else "ry")
    ry = _length(element, "ry" if "ry" in element.attrib else "rx")
    rx, ry = min(rx, width / 2), min(ry, height / 2)
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


def _length(element: ElementTree.Element, key: str) -> float:
    text = element.get(key, "0")
    match = LENGTH.match(text)
    if not match or match[2] not in PIXELS_PER_UNIT:
        raise ValueError(f"{key}='{text}' is no length; expected a number")
    return float(match[1]) * PIXELS_PER_UNIT[match[2]]


def _transform(text: str) -> np.ndarray:
    """Affine map (2, 3) of a `transform` attribute."""
    matrix = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    position = 0
    while text[position:].strip():
        match = TRANSFORM.match(text, position)
        if not match:
            raise ValueError(f"transform '{text}' is malformed; expected 'name(numbers) ...'")
        values = [float(value) for value in NUMBER.findall(match[2])]
        matrix = _chain(matrix, _single_transform(match[1], values))
        position = match.end()
    return matrix


def _single_transform(name: str, values: list[float]) -> np.ndarray:
    count = len(values)
    if name == "matrix" and count == 6:
        return np.array(values).reshape(3, 2).T
    if name == "translate" and count in (1, 2):
        return np.array([[1, 0, values[0]], [0, 1, values[1] if count == 2 else 0]])
    if name == "scale" and count in (1, 2):
        return np.array([[values[0], 0, 0], [0, values[-1], 0]])
    if name == "rotate" and count in (1, 3):
        cosine, sine = math.cos(math.radians(values[0])), math.sin(math.radians(values[0]))
        turn = np.array([[cosine, -sine], [sine, cosine]])
        pivot = np.array(values[1:] or [0, 0])
        return np.column_stack((turn, pivot - turn @ pivot))
    if name == "skewX" and count == 1:
        return np.array([[1, math.tan(math.radians(values[0])), 0], [0, 1, 0]])
    if name == "skewY" and count == 1:
        return np.array([[1, 0, 0], [math.tan(math.radians(values[0])), 1, 0]])
    raise ValueError(f"transform '{name}' with {count} numbers is unknown; see SVG 2, 8.5")


def _chain(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """The map that applies `inner`, then `outer`."""
    linear = outer[:, :2] @ inner[:, :2]
    return np.column_stack((linear, outer[:, :2] @ inner[:, 2] + outer[:, 2]))


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rsplit("}", 1)[-1] if isinstance(element.tag, str) else ""
