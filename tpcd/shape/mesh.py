"""Triangle meshes from files, each looked at before it is believed.

trimesh reads PLY and STL. What it takes for another fault or for none is told here by its name:
files cut off or of another kind, text that is not UTF-8, decimal commas, fewer faces than the file
states, faces of vertices that are not there, vertices that are not numbers, polygons that do not
fall into triangles, and coordinates so far from the origin that single precision has lost the
object. Of an OBJ only vertices and faces count; they are read here, because trimesh counts negative
indices from the end of the file and not back from their line.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from tpcd.errors import OutlineError
from tpcd.shape.outline import METRES_PER_UNIT
from tpcd.text import encoding_of, lines_of, read_text

if TYPE_CHECKING:
    import trimesh

MESH_ENDINGS = (".ply", ".stl", ".obj")
STL_HEADER, STL_TRIANGLE = 84, 50
"""Bytes of a binary STL: what comes first, the number of triangles at its end, and a triangle."""
STL_NAME = re.compile(r"^(\s*(?:end)?solid)\b.*", re.MULTILINE | re.IGNORECASE)
STL_WORD = re.compile(r"^\s*(facet|endfacet|vertex|endsolid)\b", re.MULTILINE | re.IGNORECASE)
DECIMAL_COMMA = re.compile(r"^\s*(?:v\s|vertex\s)?\s*[-+\d.]*\d,\d", re.MULTILINE | re.IGNORECASE)
FINEST = 1e-3
"""Largest step between stored numbers, in sizes of the object."""
EXPORT = "export it again"
TRIANGLES = "export it with triangles alone"


def load_mesh(path: str | Path, *, unit: str = "m") -> trimesh.Trimesh:
    """Read a `.ply`, `.stl` or `.obj` mesh, scaled to metres, equal vertices merged.

    Raises:
        OutlineError: missing, unreadable, cut off, without faces, with faces that are not what
            the file states, or with vertices that are no numbers or too coarse.
        ValueError: an unknown unit.
    """
    path = Path(path)
    if unit not in METRES_PER_UNIT:
        raise ValueError(f"unit must be one of {', '.join(METRES_PER_UNIT)}, got {unit!r}")
    ending = path.suffix.lower()
    if ending not in MESH_ENDINGS:
        raise OutlineError(path, "not a mesh file", f"expected {', '.join(MESH_ENDINGS)}")
    if not path.is_file():
        raise OutlineError(path, "not found", "give a mesh file")
    try:
        mesh, stated = {".ply": _ply, ".stl": _stl, ".obj": _obj}[ending](path)
    except OutlineError:
        raise
    except Exception as error:  # the readers of trimesh raise whatever they stumble over
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise OutlineError(path, f"not readable as a mesh ({reason})", EXPORT) from None
    if not stated:
        raise OutlineError(path, "has no faces", "give a triangle mesh")
    _check_faces(path, mesh, stated)
    mesh.remove_unreferenced_vertices()
    _check_vertices(path, mesh)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if unit != "m":
        mesh.apply_scale(METRES_PER_UNIT[unit])
    return mesh


def _ply(path: Path) -> tuple[trimesh.Trimesh, int]:
    """The mesh of a PLY, and how many faces it states."""
    import trimesh

    header, end, body = path.read_bytes().partition(b"end_header")
    if header[:3].lower() != b"ply":
        raise OutlineError(path, "does not begin with 'ply'", "give a PLY file, or its own ending")
    if not end:
        raise OutlineError(path, "is cut off within its header", EXPORT)
    header = header.decode("ascii", "replace").encode("ascii", "replace")
    stated = {name: int(count) for name, count in re.findall(rb"\nelement\s+(\w+)\s+(\d+)", header)}
    if re.search(rb"\nformat\s+ascii", header):
        rows = [row for row in body.splitlines()[1:] if row.strip()]
        total = sum(stated.values())
        if len(rows) != total:
            told = "is cut off: " if len(rows) < total else ""
            raise OutlineError(path, f"{told}states {total} rows and holds {len(rows)}", EXPORT)
        body = b"\n" + b"\n".join(rows)
        _check_commas(path, (header + end + body).decode("ascii", "replace"))
    faces = stated.get(b"face", 0)
    try:
        mesh = _loaded(header + end + body, "ply")
    except ValueError as error:
        if "unexpected length" not in str(error):
            raise
        told = "is cut off, or has faces of different numbers of corners"
        raise OutlineError(path, told, TRIANGLES) from None
    if len(mesh.faces) > faces:  # polygons, of which trimesh makes fans
        raw = mesh.metadata["_ply_raw"]
        points = np.column_stack([raw["vertex"]["data"][axis] for axis in "xyz"])
        data = raw["face"]["data"]
        key = next(name for name in raw["face"]["properties"] if name.startswith("vertex_ind"))
        polygons = data[key] if isinstance(data, dict) else data[key]["f1"]
        mesh = trimesh.Trimesh(points, _triangles(path, points, list(polygons)), process=False)
    return mesh, faces


def _stl(path: Path) -> tuple[trimesh.Trimesh, int]:
    """The mesh of an STL, in text or binary, and how many triangles it states."""
    text = _text(path)
    if "\0" in text or not text:
        content, stated = _binary_stl(path, path.read_bytes())
        return _loaded(content, "stl"), stated
    words = [word.lower() for word in STL_WORD.findall(text)]
    facets = words.count("facet")
    if not facets:
        raise OutlineError(path, "is text without a line that begins with 'facet'", EXPORT)
    _check_commas(path, text)
    if facets != words.count("endfacet"):
        raise OutlineError(path, "is cut off within a triangle", EXPORT)
    if words[-1] != "endsolid":
        raise OutlineError(path, "is cut off: no 'endsolid' ends it", EXPORT)
    if words.count("vertex") != 3 * facets:
        raise OutlineError(path, "has facets of other than 3 vertices", TRIANGLES)
    return _loaded(STL_NAME.sub(r"\1", text).encode(), "stl"), facets


def _binary_stl(path: Path, content: bytes) -> tuple[bytes, int]:
    """A binary STL without what stands behind its triangles, and their number."""
    if len(content) < STL_HEADER:
        raise OutlineError(path, f"holds {len(content)} bytes, no STL", EXPORT)
    stated = int.from_bytes(content[STL_HEADER - 4 : STL_HEADER], "little")
    held, rest = divmod(len(content) - STL_HEADER, STL_TRIANGLE)
    if held < stated:
        raise OutlineError(
            path, f"is cut off: it holds {held} of the {stated} triangles that it states", EXPORT
        )
    if held > stated and not rest:
        raise OutlineError(path, f"states {stated} triangles and holds {held}", EXPORT)
    return content[: STL_HEADER + STL_TRIANGLE * stated], stated


def _obj(path: Path) -> tuple[trimesh.Trimesh, int]:
    """The mesh of an OBJ, whatever its groups, objects and materials, and how many faces it has."""
    import trimesh

    text = _text(path)
    _check_commas(path, text)
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for number, line in enumerate(lines_of(text.replace("\\\n", " ")), start=1):
        kind, *words = line.split() or [""]
        try:
            if kind == "v":
                x, y, z = map(float, words[:3])
                vertices.append([x, y, z])
            elif kind == "f":
                corners = [int(word.split("/")[0]) for word in words]
                if 0 in corners:
                    told = f"line {number} counts vertices from 0"
                    raise OutlineError(path, told, "an OBJ counts from 1")
                if len(corners) < 3:
                    raise ValueError
                faces.append([k - 1 if k > 0 else len(vertices) + k for k in corners])
        except ValueError:
            told = f"line {number} is '{line.strip()[:40]}'"
            raise OutlineError(path, told, "expected 'v x y z' or 'f a b c'") from None
    points = np.array(vertices).reshape(-1, 3)
    return trimesh.Trimesh(points, _triangles(path, points, faces), process=False), len(faces)


def _triangles(
    path: Path, vertices: np.ndarray, polygons: Sequence[Sequence[int] | np.ndarray]
) -> np.ndarray:
    """Polygons in triangles: fans around their first corner where these do not fold.

    trimesh makes fans of all, which leave a polygon that is not convex.
    """
    found = [np.zeros((0, 3), dtype=np.int64)]
    lengths = np.array([len(polygon) for polygon in polygons])
    for length in np.unique(lengths):
        group = np.array([polygons[index] for index in np.flatnonzero(lengths == length)])
        fans = np.stack([group[:, [0, k, k + 1]] for k in range(1, length - 1)], axis=1)
        if length > 3 and group.min() >= 0 and group.max() < len(vertices):
            spans = vertices[fans[..., 1:]] - vertices[fans[..., :1]]
            areas = np.cross(spans[..., 0, :], spans[..., 1, :])
            folded = (np.einsum("gtx,gux->gtu", areas, areas) < 0).any(axis=(1, 2))
            for polygon, normal in zip(group[folded], areas.sum(axis=1)[folded], strict=True):
                found.append(_within(path, vertices, polygon, normal))
            fans = fans[~folded]
        found.append(fans.reshape(-1, 3))
    return np.concatenate(found)


def _within(
    path: Path, vertices: np.ndarray, polygon: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """Triangles inside of a polygon that is not convex."""
    corners = vertices[polygon] - vertices[polygon[0]]
    across = corners[np.abs(corners).sum(axis=1).argmax()]
    flat = corners @ np.stack((across, np.cross(normal, across)), axis=1)
    sizes = np.abs(flat).max(axis=0)
    shape = shapely.Polygon(flat / np.where(sizes > 0, sizes, 1))
    if not shape.is_valid:
        place = ", ".join(f"{value:.4g}" for value in vertices[polygon[0]])
        told = f"has a face of {len(polygon)} corners that crosses itself, at ({place})"
        raise OutlineError(path, told, TRIANGLES)
    index = dict(zip(map(tuple, shapely.get_coordinates(shape)[:-1]), polygon, strict=True))
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(shape))
    rings = [shapely.get_coordinates(shapely.normalize(part))[2::-1] for part in parts]
    return np.array([[index[tuple(corner)] for corner in ring] for ring in rings])


def _loaded(content: bytes, kind: str) -> trimesh.Trimesh:
    import trimesh

    return trimesh.load_mesh(io.BytesIO(content), file_type=kind, process=False)


def _text(path: Path) -> str:
    """The text of a file; empty where it is none."""
    try:
        return read_text(path, encoding_of(path))
    except UnicodeDecodeError:
        return ""


def _check_commas(path: Path, text: str) -> None:
    if comma := DECIMAL_COMMA.search(text):
        line = text.count("\n", 0, comma.end()) + 1
        raise OutlineError(path, f"line {line} has a decimal comma", f"{EXPORT} with points")


def _check_faces(path: Path, mesh: trimesh.Trimesh, stated: int) -> None:
    """Refuse fewer faces than stated, and faces of vertices that are not there."""
    faces, count = np.asarray(mesh.faces), len(mesh.vertices)
    if len(faces) < stated:
        told = f"states {stated} faces, of which {len(faces)} are whole"
        raise OutlineError(path, told, EXPORT)
    outside = faces[(faces < 0) | (faces >= count)]
    if len(outside):
        told = f"a face names a vertex that is not there (index {outside[0]} from 0, of {count})"
        raise OutlineError(path, told, EXPORT)


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
