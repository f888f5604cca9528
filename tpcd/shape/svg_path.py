"""The path language of SVG: text to curves, curves to points.

A path becomes subpaths, each a list of Bezier segments: arrays (2, 2), (3, 2) or (4, 2) of
control points for lines, quadratic and cubic curves. Elliptical arcs become cubics. An affine
map of the control points maps the curve, so drawings are transformed before they are
flattened and the tolerance of `flatten` holds in the final unit. Source: W3C, Scalable Vector
Graphics 2, chapter 9 (path data) and appendix B.2 (elliptical arcs).
"""

from __future__ import annotations

import math
import re

import numpy as np

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
FLAG = re.compile(r"[01]")
SPACE = re.compile(r"[\s,]*")
ARGUMENTS = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7, "Z": 0}
LARGEST_ARC_PIECE = math.pi / 4
"""Arc per cubic [rad]; its error is then 4e-6 of the radius."""

Segments = list[np.ndarray]


def parse_path(text: str) -> list[Segments]:
    """Subpaths of path data, each closed by a line where it does not end at its start.

    Raises:
        ValueError: the data break the grammar; says where.
    """
    subpaths: list[Segments] = []
    segments: Segments = []
    start = here = np.zeros(2)
    before = ""
    for command, values in _commands(text):
        relative = command.islower()
        letter = command.upper()
        if letter == "M":
            subpaths.append(_closed(segments, start))
            segments = []
            start = here = np.array(values) + (here if relative else 0)
        elif letter == "Z":
            subpaths.append(_closed(segments, start))
            segments, here = [], start
        else:
            new = _segments(letter, values, relative, here, segments, before)
            segments.extend(new)
            here = new[-1][-1] if new else here
        before = letter
    subpaths.append(_closed(segments, start))
    return [subpath for subpath in subpaths if subpath]


def arc_segments(
    start: np.ndarray,
    radii: tuple[float, float],
    rotation: float,
    large: bool,
    sweep: bool,
    end: np.ndarray,
) -> Segments:
    """Cubics along an elliptical arc given by its ends (SVG 2, appendix B.2.4); rotation [rad]."""
    if np.array_equal(start, end):
        return []
    if radii[0] == 0 or radii[1] == 0:
        return [np.array([start, end])]
    axes = np.abs(np.array(radii))
    cosine, sine = math.cos(rotation), math.sin(rotation)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    # In the frame of the ellipse, scaled to a unit circle, the chord is all that counts.
    half = turn.T @ (start - end) / 2 / axes
    reach = float(half @ half)
    if reach > 1:
        axes = axes * math.sqrt(reach)
        half = half / math.sqrt(reach)
        reach = 1.0
    height = math.sqrt(max(0.0, 1 / reach - 1)) * (-1 if large == sweep else 1)
    centre = height * np.array([half[1], -half[0]])
    first, last = half - centre, -half - centre
    begin = math.atan2(first[1], first[0])
    angle = math.atan2(last[1], last[0]) - begin
    if sweep and angle < 0:
        angle += 2 * math.pi
    elif not sweep and angle > 0:
        angle -= 2 * math.pi
    middle = (start + end) / 2 + turn @ (axes * centre)
    cubics = [middle + (turn @ (axes * unit).T).T for unit in _circle_cubics(begin, angle)]
    cubics[0][0], cubics[-1][-1] = start, end
    return cubics


def ellipse_segments(centre: tuple[float, float], radii: tuple[float, float]) -> Segments:
    """Cubics around a full ellipse with axes along x and y."""
    return [np.array(centre) + np.array(radii) * unit for unit in _circle_cubics(0.0, 2 * math.pi)]


def flatten(segments: Segments, tolerance: float) -> np.ndarray:
    """Points (n, 2) along connected Bezier segments, off the curve by at most `tolerance`.

    A curve of degree d cut evenly into n pieces is off by at most
    `d (d - 1) / 8 max |second difference of its control points| / n^2` (G. Wang, 1984).
    """
    points = []
    for control in segments:
        degree = len(control) - 1
        if degree == 1:
            points.append(control[:1])
            continue
        bend = np.linalg.norm(np.diff(control, n=2, axis=0), axis=1).max()
        pieces = math.sqrt(degree * (degree - 1) / 8 * bend / tolerance)
        t = np.linspace(0, 1, max(1, math.ceil(pieces)), endpoint=False)[:, None]
        points.append(
            sum(
                math.comb(degree, k) * t**k * (1 - t) ** (degree - k) * control[k]
                for k in range(degree + 1)
            )
        )
    return np.concatenate(points)


def _circle_cubics(begin: float, angle: float) -> Segments:
    """Cubics along the unit circle; the usual handle length 4/3 tan(angle / 4)."""
    pieces = max(1, math.ceil(abs(angle) / LARGEST_ARC_PIECE - 1e-9))
    handle = 4 / 3 * math.tan(angle / pieces / 4)
    cubics = []
    for k in range(pieces):
        a, b = begin + angle * k / pieces, begin + angle * (k + 1) / pieces
        p = np.array([math.cos(a), math.sin(a)])
        q = np.array([math.cos(b), math.sin(b)])
        away = handle * np.array([-p[1], p[0]])
        back = handle * np.array([q[1], -q[0]])
        cubics.append(np.array([p, p + away, q + back, q]))
    return cubics


def _commands(text: str) -> list[tuple[str, list[float]]]:
    """Command letters with the right number of arguments each, repeats spelled out."""
    position = _skip(text, 0)
    found: list[tuple[str, list[float]]] = []
    while position < len(text):
        letter: str = text[position]
        if letter.upper() not in ARGUMENTS or (not found and letter not in "Mm"):
            raise ValueError(f"path data has {letter!r} at character {position + 1}")
        position = _skip(text, position + 1)
        count = ARGUMENTS[letter.upper()]
        while True:
            values = []
            for index in range(count):
                pattern = FLAG if letter in "Aa" and index in (3, 4) else NUMBER
                match = pattern.match(text, position)
                if not match:
                    raise ValueError(
                        f"path data lacks a number for {letter!r} at character {position + 1}"
                    )
                values.append(float(match.group()))
                position = _skip(text, match.end())
            found.append((letter, values))
            # Pairs that follow a move are lines (SVG 2, 9.3.3).
            letter = "L" if letter == "M" else "l" if letter == "m" else letter
            if count == 0 or not NUMBER.match(text, position):
                break
    return found


def _segments(
    letter: str,
    values: list[float],
    relative: bool,
    here: np.ndarray,
    segments: Segments,
    before: str,
) -> Segments:
    """Segments that one drawing command adds."""
    origin = here if relative else np.zeros(2)
    if letter == "H":
        return [np.array([here, [origin[0] + values[0], here[1]]])]
    if letter == "V":
        return [np.array([here, [here[0], origin[1] + values[0]]])]
    if letter == "A":
        end = origin + values[5:]
        radii = (values[0], values[1])
        rotation = math.radians(values[2])
        return arc_segments(here, radii, rotation, values[3] == 1, values[4] == 1, end)
    points = np.array(values).reshape(-1, 2) + origin
    if letter in "ST":
        # The first control point mirrors the last one of a curve of the same kind.
        same_kind = before in ("CS" if letter == "S" else "QT")
        mirrored = 2 * here - segments[-1][-2] if same_kind and segments else here
        points = np.vstack((mirrored, points))
    return [np.vstack((here, points))]


def _closed(segments: Segments, start: np.ndarray) -> Segments:
    if segments and not np.array_equal(segments[-1][-1], start):
        return [*segments, np.array([segments[-1][-1], start])]
    return segments


def _skip(text: str, position: int) -> int:
    match = SPACE.match(text, position)
    return match.end() if match else position
