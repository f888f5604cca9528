"""What elements of an SVG say: properties, lengths, numbers and transforms.

Lengths are in user units, 96 of which are an inch. Affine maps are arrays (2, 3). Source: W3C,
Scalable Vector Graphics 2, chapter 8, and CSS for what a `style` says.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree

import numpy as np

from tpcd.shape.outline import METRES_PER_UNIT
from tpcd.shape.svg_path import NUMBER

METRES_PER_PIXEL = 0.0254 / 96
"""CSS defines 96 pixels to the inch."""
PIXELS_PER_UNIT = {"": 1.0, "px": 1.0, "pt": 96 / 72, "pc": 16.0, "q": 96 / 101.6} | {
    unit: metres / METRES_PER_PIXEL for unit, metres in METRES_PER_UNIT.items() if unit != "m"
}
LENGTH = re.compile(rf"\s*({NUMBER.pattern})\s*([a-zA-Z%]*)\s*$")
TRANSFORM = re.compile(r"\s*,?\s*([a-zA-Z]+)\s*\(([^)]*)\)")
SIZES = ("width", "height", "r", "rx", "ry")


def said(element: ElementTree.Element, key: str, default: str = "") -> str:
    """A property of an element: what its style says of it, else its attribute (CSS)."""
    for declaration in reversed(element.get("style", "").split(";")):
        name, _, value = declaration.partition(":")
        if name.strip().lower() == key:
            return value.replace("!important", "").strip()
    return element.get(key, default).strip()


def length_of(
    element: ElementTree.Element, key: str, whole: float = math.nan, default: str = "0"
) -> float:
    """A length in user units; percent are of `whole`, `auto` is the default."""
    text = said(element, key, default).lower().replace("auto", default)
    match = LENGTH.match(text)
    unit = match[2] if match else ""
    if not match or unit not in (*PIXELS_PER_UNIT, "%") or unit == "%" and math.isnan(whole):
        raise ValueError(f"{key}='{text}' is no length; expected a number")
    length = float(match[1]) * (whole / 100 if unit == "%" else PIXELS_PER_UNIT[unit])
    if length < 0 and key in SIZES:
        raise ValueError(f"{key}='{text}' is negative; expected a size")
    return length


def numbers_in(text: str) -> list[float]:
    """Numbers parted by blanks and commas, or by their signs, and nothing else."""
    rest = NUMBER.sub("", text).replace(",", "").strip()
    if rest:
        raise ValueError(f"'{text.strip()[:40]}' holds '{rest[:10]}'; expected numbers alone")
    return [float(value) for value in NUMBER.findall(text)]


def transform_in(text: str) -> np.ndarray:
    """Affine map (2, 3) of a `transform` attribute."""
    matrix = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    position = 0
    while text[position:].strip():
        match = TRANSFORM.match(text, position)
        if not match:
            raise ValueError(f"transform '{text}' is malformed; expected 'name(numbers) ...'")
        values = numbers_in(match[2])
        matrix = chain(matrix, _single_transform(match[1], values))
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


def chain(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """The map that applies `inner`, then `outer`."""
    linear = outer[:, :2] @ inner[:, :2]
    return np.column_stack((linear, outer[:, :2] @ inner[:, 2] + outer[:, 2]))


def tag_of(element: ElementTree.Element) -> str:
    return element.tag.rsplit("}", 1)[-1] if isinstance(element.tag, str) else ""
