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
ALIGNED = {"Min": 0.0, "Mid": 0.5, "Max": 1.0}
"""Share of the room that is left before a viewBox, by preserveAspectRatio."""
PHYSICAL_UNITS = ("mm", "cm", "in", "pt", "pc")
LENGTH = re.compile(rf"\s*({NUMBER.pattern})\s*([a-zA-Z%]*)\s*$")
TRANSFORM = re.compile(r"\s*,?\s*([a-zA-Z]+)\s*\(([^)]*)\)")
SHAPES = ("path", "polygon", "polyline", "rect", "circle", "ellipse")
HIDDEN = re.compile(r"display\s*:\s*none|visibility\s*:\s*(hidden|collapse)")
STYLED = re.compile(
    r"(?<![\w-])(transform|scale|rotate|translate|width|height|r|rx|ry|x|y|cx|cy|d)\s*:", re.I
)
"""What a style sheet says that would change which shapes there are, or where."""
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
        _check_styles(root, unit)
        matrix = _user_to_metres(root, unit)
        shapes = list(_shapes(root, matrix))
    except ValueError as error:
        raise OutlineError(path, *str(error).split("; ", 1)) from None
    if not shapes:
        raise OutlineError(path, "holds no shapes", f"expected one of {', '.join(SHAPES)}")
    drawn = [(name, [flatten(loop, tolerance) for loop in loops]) for name, loops in shapes]
    solid = [(name, loops) for name, loops in drawn if any(map(_has_area, loops))]
    lines = len(drawn) - len(solid)
    outlines: dict[str, Outline] = {}
    for index, (name, loops) in enumerate(solid or drawn):
        name = name or (path.stem if len(solid) == 1 else f"{path.stem}-{index + 1}")
        if name in outlines:
            name = f"{name}-{index + 1}"
        points = _outer_loop(path, name, loops)
        notes = [f"{_counted(len(loops) - 1, 'loop')} inside the outer one, taken for filled"]
        notes = notes if len(loops) > 1 else []
        if lines and not outlines:
            notes.append(f"{_counted(lines, 'line')} without an area left out")
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
    """Refuse what would make other shapes of those that are read: styles, clips and masks, and
    lengths with a unit of their own beside a `unit` of the drawing."""
    for element in root.iter():
        style = element.get("style", "")
        sheet = (element.text or "") if _tag(element) == "style" else ""
        if STYLED.search(HIDDEN.sub("", style)) or STYLED.search(sheet) or HIDDEN.search(sheet):
            raise ValueError(
                "a style hides, moves or sizes shapes; export it as plain SVG (presentation"
                " attributes)"
            )
        if element.get("clip-path", "none") != "none" or element.get("mask", "none") != "none":
            raise ValueError("a shape is clipped or masked; apply that before exporting")
        sized = unit not in (None, "px") and _tag(element) in SHAPES
        for key in ("x", "y", "width", "height", "r", "rx", "ry", "cx", "cy") if sized else ():
            length = LENGTH.match(element.get(key, ""))
            if length and length[2] not in ("", "px"):
                told = f"{key}='{element.get(key)}' has a unit of its own"
                raise ValueError(f"{told}; give --unit px, which keeps it")


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
    if not root.get("viewBox"):
        return np.array([[METRES_PER_PIXEL, 0, 0], [0, -METRES_PER_PIXEL, 0]])
    if min(metres) <= 0:
        raise ValueError("its width and height are not positive; give its size")
    return _chain(np.array([[1.0, 0, 0], [0, -1.0, 0]]), _viewport(root, metres[0], metres[1]))


def _viewport(element: ElementTree.Element, width: float, height: float) -> np.ndarray:
    """Affine map (2, 3) from the coordinates of a viewBox to a viewport of some size (SVG 2, 8.2);
    the identity without a viewBox."""
    text = element.get("viewBox")
    if not text:
        return np.array([[1.0, 0, 0], [0, 1.0, 0]])
    view = np.array([float(value) for value in NUMBER.findall(text)])
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
        _length(element, key, whole, default)
        for key, whole, default in zip(
            ("x", "y", "width", "height"), around * 2, ("0", "0", "100%", "100%"), strict=True
        )
    )
    if min(width, height) <= 0:
        raise ValueError("an inner <svg> has no width or height; expected a size")
    view = _viewport(element, width, height)
    size = (width / view[0, 0], height / view[1, 1])
    return _chain(np.array([[1.0, 0, x], [0, 1.0, y]]), view), size


def _shapes(
    element: ElementTree.Element, matrix: np.ndarray, around: tuple[float, float] | None = None
) -> Iterator[tuple[str, list[Segments]]]:
    """Name and subpaths, mapped by `matrix`, of every shape at or below an element."""
    tag, style = _tag(element), element.get("style", "").replace(" ", "")
    if tag in NOT_DRAWN or HIDDEN.search(style) or element.get("display") == "none":
        return
    if element.get("visibility") in ("hidden", "collapse"):
        return
    if tag == "use":
        raise ValueError("it holds a <use> clone; turn clones into paths before exporting")
    if around is None:  # the root
        view = [float(value) for value in NUMBER.findall(element.get("viewBox", ""))]
        around = (view[2], view[3]) if len(view) == 4 else (math.nan, math.nan)
    elif tag == "svg":
        inner, around = _nested(element, around)
        matrix = _chain(matrix, inner)
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
        yield from _shapes(child, matrix, around)


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


def _length(
    element: ElementTree.Element, key: str, whole: float = math.nan, default: str = "0"
) -> float:
    """A length in user units; percent are of `whole`."""
    text = element.get(key, default)
    match = LENGTH.match(text)
    if match and match[2] == "%" and math.isfinite(whole):
        return float(match[1]) / 100 * whole
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
