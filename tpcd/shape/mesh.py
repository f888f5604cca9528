"""Triangle meshes from files, each looked at before it is believed.

trimesh reads the faces. What it takes for another fault or for none is told here by its name:
files cut off, text that is not UTF-8, decimal commas, vertices that are not numbers, and
coordinates so far from the origin that single precision has lost the object.
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tpcd.errors import OutlineError
from tpcd.shape.outline import METRES_PER_UNIT
from tpcd.text import encoding_of, read_text

if TYPE_CHECKING:
    import trimesh

MESH_ENDINGS = (".ply", ".stl", ".obj")
STL_HEADER, STL_TRIANGLE = 84, 50
"""Bytes of a binary STL: what comes first, the number of triangles at its end, and a triangle."""
DECIMAL_COMMA = re.compile(r"^\s*(?:v|vertex)\s+[-+\d.]*\d,\d", re.MULTILINE)
ZERO_INDEX = re.compile(r"^f[ \t][^\n]*?[ \t]0(?=[/\s])", re.MULTILINE)
FINEST = 1e-3
"""Largest step between stored numbers, in sizes of the object."""
EXPORT = "export it again"


def load_mesh(path: str | Path, *, unit: str = "m") -> trimesh.Trimesh:
    """Read a `.ply`, `.stl` or `.obj` mesh, scaled to metres, equal vertices merged.

    Raises:
        OutlineError: missing, unreadable, cut off, without faces, or with vertices that are no
            numbers or too coarse.
        ValueError: an unknown unit.
    """
    import trimesh

    path = Path(path)
    if unit not in METRES_PER_UNIT:
        raise ValueError(f"unit must be one of {', '.join(METRES_PER_UNIT)}, got {unit!r}")
    ending = path.suffix.lower()
    if ending not in MESH_ENDINGS:
        raise OutlineError(path, "not a mesh file", f"expected {', '.join(MESH_ENDINGS)}")
    if not path.is_file():
        raise OutlineError(path, "not found", "give a mesh file")
    try:
        content = _content(path, ending)
        mesh = trimesh.load_mesh(
            io.BytesIO(content), file_type=ending[1:], process=False, skip_materials=True
        )
        faces = len(mesh.faces)
    except OutlineError:
        raise
    except IndexError:
        raise OutlineError(path, "a face names a vertex that is not there", EXPORT) from None
    except Exception as error:  # the readers of trimesh raise whatever they stumble over
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise OutlineError(path, f"not readable as a mesh ({reason})", EXPORT) from None
    if not faces:
        raise OutlineError(path, "has no faces", "give a triangle mesh")
    mesh.remove_unreferenced_vertices()
    _check_vertices(path, mesh)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if unit != "m":
        mesh.apply_scale(METRES_PER_UNIT[unit])
    return mesh


def _content(path: Path, ending: str) -> bytes:
    """The bytes of a mesh file with all text in UTF-8; `OutlineError` where it is cut off."""
    if ending == ".ply":
        header, end, body = path.read_bytes().partition(b"end_header")
        return header.decode("ascii", "replace").encode("ascii", "replace") + end + body
    try:
        text = read_text(path, encoding_of(path))
    except UnicodeDecodeError:
        text = ""
    if ending == ".stl" and ("\0" in text or "facet" not in text):
        return _binary_stl(path, path.read_bytes())
    if comma := DECIMAL_COMMA.search(text):
        line = text.count("\n", 0, comma.end()) + 1
        raise OutlineError(path, f"line {line} has a decimal comma", f"{EXPORT} with points")
    if ending == ".obj" and (zero := ZERO_INDEX.search(text)):
        line = text.count("\n", 0, zero.end()) + 1
        raise OutlineError(path, f"line {line} counts vertices from 0", "an OBJ counts from 1")
    if ending == ".stl" and text.count("endfacet") != text.count("facet") - text.count("endfacet"):
        raise OutlineError(path, "is cut off within a triangle", EXPORT)
    return text.encode()


def _binary_stl(path: Path, content: bytes) -> bytes:
    """A binary STL without what stands behind its triangles."""
    if len(content) < STL_HEADER:
        raise OutlineError(path, f"holds {len(content)} bytes, no STL", EXPORT)
    stated = int.from_bytes(content[STL_HEADER - 4 : STL_HEADER], "little")
    held = (len(content) - STL_HEADER) // STL_TRIANGLE
    if held < stated:
        raise OutlineError(
            path, f"is cut off: it holds {held} of the {stated} triangles that it states", EXPORT
        )
    return content[: STL_HEADER + STL_TRIANGLE * stated]


def _check_vertices(path: Path, mesh: trimesh.Trimesh) -> None:
    """Refuse vertices of faces that are no numbers, or stored too coarsely for the object."""
    vertices = np.asarray(mesh.vertices)
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        found = f"{bad.sum()} of the {len(bad)} vertices of its faces are no finite numbers"
        raise OutlineError(path, f"{found} ({vertices[bad.argmax()]})", EXPORT)
    farthest, size = np.abs(vertices).max(), np.ptp(vertices, axis=0).max()
    with np.errstate(over="ignore"):
        single = vertices.astype(np.float32)
    step = float(np.spacing(np.float32(farthest)))
    if (single == vertices).all() and step > FINEST * size:
        raise OutlineError(
            path,
            f"lies {farthest:.3g} units from its origin, where its numbers are {step:.2g} apart,"
            f" for an object of {size:.2g}",
            "move it to the origin before the export",
        )
