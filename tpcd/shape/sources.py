"""Outlines from files: slices (`.npz`), polygons (`.csv`), drawings (`.svg`), meshes.

`load_outlines` looks at the file's ending. Whatever the file holds, what comes back has been
checked by `make_outline`: simple, counter-clockwise, centred, in metres.
"""

from __future__ import annotations

import csv
import re
import zipfile
from pathlib import Path

import numpy as np

from tpcd.errors import OutlineError
from tpcd.numerals import decimal_mark, is_number, marks_shown, odd_cell, read_number
from tpcd.shape.mesh import MESH_ENDINGS, load_mesh
from tpcd.shape.outline import METRES_PER_UNIT, Outline, make_outline
from tpcd.shape.section import CuttingPlane, cut_mesh
from tpcd.shape.svg import load_svg
from tpcd.text import encoding_of, lines_of, read_text

SEPARATOR = re.compile(r"[,;\t ]+")
WIDE_SEPARATOR = re.compile(r"[;\t ]+")
QUOTED = re.compile(r"""(["'])(.*?)\1""")
SPELLED = r"(?:milli|centi|deci|micro|nano)?met(?:re|er)s?|inch(?:es)?"
UNITS = rf"(m|cm|mm|in|dm|ft|foot|feet|yd|yards?|mils?|um|nm|\u00b5m|px|pt|{SPELLED})"
HEADER_UNIT = re.compile(
    rf"[\[(_/]\s*{UNITS}(?![a-z])|(?:^|[,;\t])\s*{UNITS}\s*(?=$|[,;\t])|\b(cm|mm|{SPELLED})\b"
)
"""A unit in brackets, after a line or a stroke, alone in its cell, or one that is no word."""
SPELLED_UNIT = {"m": "met", "cm": "centimet", "mm": "millimet", "in": "in"}
"""How the names of the units begin that are taken."""
COMMENT_UNIT = re.compile(rf"\bunits?\s*[:=]?\s*{UNITS}\b")


def load_outlines(
    path: str | Path, *, unit: str | None = None, plane: CuttingPlane | None = None
) -> dict[str, Outline]:
    """Outlines of a file by name [m]: `.npz`, `.csv`, `.svg`, or a `.ply`, `.stl`, `.obj` mesh.

    `unit` is the unit of the file's coordinates (m, cm, mm, in; also px for SVG); without it
    metres are assumed, or for SVG what the drawing says. `plane` cuts a mesh; without it a
    mesh is cut upright along its widest direction.

    Raises:
        OutlineError: the file is missing, of another kind, unreadable, or holds something that
            is not one simple closed curve of plausible size.
        ValueError: an unknown unit.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending == ".svg":
        return load_svg(path, unit=unit)
    if unit not in (None, *METRES_PER_UNIT):
        raise ValueError(f"unit must be one of {', '.join(METRES_PER_UNIT)}, got {unit!r}")
    if ending == ".csv":
        return {path.stem: load_polygon(path, unit=unit)}
    unit = unit or "m"
    if ending == ".npz":
        return load_slices(path, unit=unit)
    if ending in MESH_ENDINGS:
        return {path.stem: cut_mesh(load_mesh(path, unit=unit), path.stem, plane, path=path)}
    known = ", ".join((".npz", ".csv", ".svg", *MESH_ENDINGS))
    raise OutlineError(path, f"no outline file ('{ending}')", f"expected one of {known}")


def load_slices(path: str | Path, *, unit: str = "m") -> dict[str, Outline]:
    """Outlines of an `.npz` file: one array (n, 2) per outline, the key is its name.

    Nothing is unpickled.

    Raises:
        OutlineError: missing, not an `.npz` file, empty, or an array that is no outline.
    """
    path = Path(path)
    if not path.is_file():
        raise OutlineError(path, "not found", "give an .npz file of (n, 2) arrays")
    try:
        if not zipfile.is_zipfile(path):
            raise ValueError("no zip archive")
        with np.load(path, allow_pickle=False) as arrays:
            slices = {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise OutlineError(
            path, f"not a readable .npz file ({reason})", "expected (n, 2) float arrays by name"
        ) from None
    if not slices:
        raise OutlineError(path, "holds no arrays", "expected one (n, 2) array per outline")
    outlines = {}
    for name, points in slices.items():
        if points.dtype.kind not in "fiu":
            raise OutlineError(path, f"'{name}' holds {points.dtype}", "expected numbers")
        scaled = points * METRES_PER_UNIT[unit]
        outlines[name] = make_outline(name, scaled, path=path, source=path.name)
    return outlines


def load_polygon(path: str | Path, *, unit: str | None = None) -> Outline:
    """The polygon of a `.csv` file: one vertex `x, z` per row, named after the file.

    A first row without numbers is a header; rows that start with # are skipped. A header may name
    the unit, `x [mm], z [mm]`, in a row of its own too, and a comment, `# unit: mm`; without `unit`
    or that, metres are assumed. Numbers may have decimal commas where something else parts them
    (`0,03; 0,02`), and quotes.

    Raises:
        OutlineError: missing, a row that is not two numbers (with its line), or a
            polygon that is no outline.
    """
    path = Path(path)
    try:
        text = read_text(path, encoding_of(path))
        if "\0" in text:
            raise ValueError("its bytes are no text")
    except FileNotFoundError:
        raise OutlineError(path, "not found", "give a .csv file of x, z rows") from None
    except (OSError, ValueError) as error:
        raise OutlineError(path, f"not readable as text ({error})", "give x, z rows") from None
    rows: list[list[str]] = []
    places: list[int] = []
    header_seen, units, gaps = False, set[str](), dict[int, int]()
    for number, line in enumerate(lines_of(text), start=1):
        fields = _fields(line)
        if not fields:
            gaps.setdefault(len(rows), number)
            continue
        if fields[0].startswith("#"):
            units |= _units(COMMENT_UNIT, line)
            continue
        if not all(map(is_number, fields)):
            named = _units(HEADER_UNIT, QUOTED.sub(r"\2", line))
            broken = any(field.lstrip("+-\u2212.")[:1].isdigit() for field in fields)
            if rows or header_seen and not named or broken:
                raise OutlineError(
                    path, f"line {number} is '{line.strip()[:40]}'", "expected two numbers x, z"
                )
            header_seen = True
            units |= named
            if fields[0].lower()[:1] in ("z", "y"):
                told = f"line {number} begins with {fields[0]}"
                raise OutlineError(path, told, "expected x, z")
            continue
        if len(fields) != 2:
            expected = "expected x, z"
            if len(fields) == 4 and line.count(",") == 3:
                expected += "; with decimal commas, part x and z by a semicolon"
            raise OutlineError(path, f"line {number} has {len(fields)} numbers", expected)
        rows.append(fields)
        places.append(number)
    if not rows:
        raise OutlineError(path, "holds no vertices", "expected one x, z row for each")
    parting = [line for after, line in gaps.items() if 0 < after < len(rows)]
    if 0 < len(parting) < len(rows) - 1:
        told = f"line {parting[0]} is empty and parts the vertices"
        raise OutlineError(path, told, "expected one outline without gaps")
    if units - METRES_PER_UNIT.keys() or len(units) > 1 or units and unit not in (None, *units):
        told = f"its header is in {' and '.join(sorted(units))}"
        raise OutlineError(path, told, f"expected one unit, {unit or ', '.join(METRES_PER_UNIT)}")
    unit = unit or (units.pop() if units else "m")
    scaled = _numbers(path, rows, places) * METRES_PER_UNIT[unit]
    return make_outline(path.stem, scaled, path=path, source=path.name)


def _numbers(path: Path, rows: list[list[str]], places: list[int]) -> np.ndarray:
    """Coordinates, in each column with the decimal mark that it shows, or else the whole file."""
    usual = decimal_mark(*marks_shown(cell for row in rows for cell in row))
    columns = []
    for name, cells in zip("xz", zip(*rows, strict=True), strict=True):
        if odd := odd_cell(cells, usual):
            row, more, remedy = odd
            raise OutlineError(path, f"line {places[row]}: {name} is {cells[row]!r}{more}", remedy)
        mark = decimal_mark(*marks_shown(cells), usual)
        columns.append([read_number(cell, mark) for cell in cells])
    return np.array(columns).T


def _fields(line: str) -> list[str]:
    """What stands between separators, out of its quotes: semicolons, tabs or blanks, else
    commas."""
    line = line.strip().replace("'", '"')
    parts = [part.rstrip(",").strip('"') for part in WIDE_SEPARATOR.split(line) if part]
    if len(parts) == 2 and all(is_number(part) and part[0] != "," for part in parts):
        return parts
    if '"' in line:
        return [cell for cell in next(csv.reader([line], skipinitialspace=True)) if cell]
    return [field for field in SEPARATOR.split(line) if field]


def _units(pattern: re.Pattern[str], text: str) -> set[str]:
    """The units that a text names."""
    names = {name for found in pattern.finditer(text.lower()) for name in found.groups() if name}
    short = {
        name: u for name in names for u, start in SPELLED_UNIT.items() if name.startswith(start)
    }
    return {short.get(name, name) for name in names}
