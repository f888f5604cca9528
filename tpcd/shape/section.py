"""Outlines from triangle meshes: a plane cut, or the silhouette in one direction.

A `CuttingPlane` carries the frame of the outline: its x axis is horizontal in the picture, its
z axis is `up`. Of a cut, the largest loop is kept and its holes are filled. Mesh coordinates
are metres unless a unit is given. Only closed meshes are cut: an open one has no inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import shapely
from jaxtyping import Float

from tpcd.errors import OutlineError
from tpcd.shape.outline import METRES_PER_UNIT, Outline, make_outline

if TYPE_CHECKING:
    import trimesh

MESH_ENDINGS = (".ply", ".stl", ".obj")
GRID = 1e-9
"""Ends of neighbouring pieces of a cut are matched on this grid [m]."""
SMALLEST_TRIANGLE = 1e-14
"""Projected triangles below this area are seen edge on [m^2]."""
NUDGES = (0.0, 1e-6, -1e-6, 3e-6, -3e-6)
"""Shifts of the plane in mesh sizes, tried in turn: a plane that holds a face or an edge of
the mesh cuts it in no clean loop, one beside it does."""
NOTED_PIECE = 0.05
"""Other pieces of a cut are mentioned from this share of the largest one's area."""


@dataclass(frozen=True, eq=False)
class CuttingPlane:
    """A plane through a mesh and the axes of the outline in it."""

    origin: Float[np.ndarray, "3"]
    """Any point of the plane [m, mesh frame]."""
    normal: Float[np.ndarray, "3"]
    """Direction towards the viewer; any length."""
    up: Float[np.ndarray, "3"]
    """Direction that becomes z of the outline; its part in the plane counts."""

    def __post_init__(self) -> None:
        for name in ("origin", "normal", "up"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, value)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ValueError(f"{name} must be three finite numbers, got {value}")
        if np.linalg.norm(np.cross(self.normal, self.up)) < 1e-9:
            raise ValueError("normal and up must be two different directions")

    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit vectors x and z of the outline and the unit normal, `x = up cross normal`."""
        normal = self.normal / np.linalg.norm(self.normal)
        across = np.cross(self.up, normal)
        across /= np.linalg.norm(across)
        return across, np.cross(normal, across), normal


def load_mesh(path: str | Path, *, unit: str = "m") -> trimesh.Trimesh:
    """Read a `.ply`, `.stl` or `.obj` mesh, scaled to metres, equal vertices merged.

    Raises:
        OutlineError: missing, unreadable, or without faces.
    """
    import trimesh

    path = Path(path)
    if unit not in METRES_PER_UNIT:
        raise ValueError(f"unit must be one of {', '.join(METRES_PER_UNIT)}, got {unit!r}")
    if path.suffix.lower() not in MESH_ENDINGS:
        raise OutlineError(path, "not a mesh file", f"expected {', '.join(MESH_ENDINGS)}")
    if not path.is_file():
        raise OutlineError(path, "not found", "give a mesh file")
    try:
        mesh = trimesh.load_mesh(path, file_type=path.suffix[1:].lower(), skip_materials=True)
        faces = len(mesh.faces)
    except Exception as error:  # the readers of trimesh raise whatever they stumble over
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise OutlineError(path, f"not readable as a mesh ({reason})", "export it again") from None
    if not faces:
        raise OutlineError(path, "has no faces", "give a triangle mesh")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if unit != "m":
        mesh.apply_scale(METRES_PER_UNIT[unit])
    return mesh


def upright_plane(
    mesh: trimesh.Trimesh, along: Literal["rectangle", "longest"] = "rectangle"
) -> CuttingPlane:
    """The vertical plane through the centroid along the widest direction; z of the mesh is up.

    `rectangle` runs along the longer side of the smallest rectangle around the object seen
    from above (a box is cut along its face), `longest` along its largest diameter (a mug is
    cut through its handle).
    """
    above = shapely.MultiPoint(np.asarray(mesh.vertices)[:, :2]).convex_hull
    if not isinstance(above, shapely.Polygon):
        raise ValueError("the mesh is flat seen from above; give a plane")
    if along == "rectangle":
        corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(above))[:3]
        sides = np.diff(corners, axis=0)
        direction = sides[np.linalg.norm(sides, axis=1).argmax()]
    elif along == "longest":
        rim = shapely.get_coordinates(above)[:-1]
        spans = rim[:, None] - rim[None]
        first, second = np.unravel_index((spans**2).sum(-1).argmax(), spans.shape[:2])
        direction = spans[first, second]
    else:
        raise ValueError(f"along must be 'rectangle' or 'longest', got {along!r}")
    if (direction[0], direction[1]) < (0.0, 0.0):
        direction = -direction
    normal = np.array([direction[1], -direction[0], 0.0])
    return CuttingPlane(np.array(mesh.centroid), normal, np.array([0.0, 0.0, 1.0]))


def cut_mesh(
    mesh: trimesh.Trimesh,
    name: str,
    plane: CuttingPlane | None = None,
    *,
    close_recesses: bool = False,
    path: str | Path | None = None,
) -> Outline:
    """The largest loop of a plane cut, holes filled [m]; `upright_plane` unless a plane is given.

    `close_recesses` also fills what is open towards the top or the bottom (cups, the sunk
    lids of cans) up to a straight line across the opening.

    Raises:
        OutlineError: the mesh is not watertight, the plane misses it, the cut crosses itself,
            or it is no outline of plausible size.
    """
    blame = path if path is not None else f"mesh '{name}'"
    if not mesh.is_watertight:
        raise OutlineError(
            blame,
            f"the mesh is not watertight ({_open_edges(mesh)} open edges)",
            "close its holes first",
        )
    loops = _loops(mesh, plane if plane is not None else upright_plane(mesh), blame)
    largest = max(loops, key=lambda loop: loop.area)
    pieces = [p for p in loops if p is not largest and not largest.contains(p)]
    extra = sum(p.area for p in pieces) / largest.area
    further = "1 further piece" if len(pieces) == 1 else f"{len(pieces)} further pieces"
    notes = f"the cut has {further}, {extra:.0%} of the largest one's area, left out"
    if close_recesses:
        largest = _recesses_closed(largest)
    return make_outline(
        name,
        np.asarray(largest.exterior.coords)[:-1],
        path=path,
        source=f"plane cut of {Path(path).name}" if path is not None else "plane cut",
        notes=notes if extra >= NOTED_PIECE else "",
    )


def mesh_silhouette(
    mesh: trimesh.Trimesh,
    name: str,
    plane: CuttingPlane,
    *,
    path: str | Path | None = None,
) -> Outline:
    """Outer boundary of the mesh seen along the plane's normal, holes filled [m].

    For flat objects that no single plane represents. The mesh may be open.

    Raises:
        OutlineError: the silhouette is no outline of plausible size.
    """
    across, up, _ = plane.axes()
    corners = (np.asarray(mesh.triangles) - plane.origin) @ np.stack((across, up), axis=1)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
        area = np.abs(area)  # of a closed mesh the faces that look at the viewer cover all
    facing = corners[area > SMALLEST_TRIANGLE]
    if not len(facing):
        blame = path if path is not None else f"mesh '{name}'"
        raise OutlineError(blame, "no face is seen from that side", "choose another plane")
    shadow = shapely.union_all(shapely.polygons(facing))
    pieces = list(getattr(shadow, "geoms", [shadow]))
    largest = max(pieces, key=lambda piece: shapely.Polygon(piece.exterior).area)
    return make_outline(
        name,
        np.asarray(largest.exterior.coords)[:-1],
        path=path,
        source=f"silhouette of {Path(path).name}" if path is not None else "silhouette",
    )


def _loops(mesh: trimesh.Trimesh, plane: CuttingPlane, blame: str | Path) -> list[shapely.Polygon]:
    """Closed loops of the cut as polygons in the axes of the plane."""
    from trimesh.intersections import mesh_plane

    across, up, normal = plane.axes()
    size = float(mesh.scale)
    touched = False
    for nudge in NUDGES:
        origin = plane.origin + nudge * size * normal
        pieces = np.asarray(mesh_plane(mesh, normal, origin)).reshape(-1, 2, 3)
        if not len(pieces):
            continue
        touched = True
        flat = np.round((pieces - plane.origin) @ np.stack((across, up), axis=1) / GRID) * GRID
        flat = flat[(flat[:, 0] != flat[:, 1]).any(axis=1)]
        merged = shapely.line_merge(shapely.MultiLineString(list(flat)))
        lines = list(getattr(merged, "geoms", [merged]))
        if lines and all(line.is_closed for line in lines):
            rings = [line for line in lines if len(line.coords) > 3]
            _check_uncrossed(rings, blame)
            return [shapely.Polygon(ring) for ring in rings]
    if not touched:
        raise OutlineError(
            blame, "the plane misses the mesh", f"its points lie within {mesh.bounds.tolist()} m"
        )
    raise OutlineError(
        blame, "the cut is not a set of closed loops: the mesh meets itself", "repair the mesh"
    )


def _check_uncrossed(rings: list[shapely.LineString], blame: str | Path) -> None:
    """Refuse loops that cross themselves or each other."""
    remedy = "repair the mesh (unite its bodies) or cut elsewhere"
    for index, ring in enumerate(rings):
        if not ring.is_simple:
            raise OutlineError(blame, "the mesh crosses itself in the cut", remedy)
        for other in rings[:index]:
            if ring.intersects(other):
                place = ring.intersection(other).representative_point()
                raise OutlineError(
                    blame,
                    f"the mesh crosses itself in the cut at ({place.x:.4g}, {place.y:.4g}) m",
                    remedy,
                )


def _recesses_closed(polygon: shapely.Polygon, steepest: float = 15.0) -> shapely.Polygon:
    """Fill pockets behind those edges of the convex hull that face up or down [degrees]."""
    points = shapely.get_coordinates(polygon.exterior)[:-1]
    on_hull = {tuple(p) for p in shapely.get_coordinates(polygon.convex_hull)}
    stops = [index for index, point in enumerate(points) if tuple(point) in on_hull]
    pockets = []
    for first, last in zip(stops, stops[1:] + stops[:1], strict=True):
        chord = np.abs(points[last] - points[first])
        if chord[1] < np.tan(np.radians(steepest)) * chord[0]:
            stretch = np.arange(first, last + 1 if last > first else last + 1 + len(points))
            if len(stretch) > 2:
                pockets.append(shapely.Polygon(points[stretch % len(points)]).buffer(0))
    filled = shapely.union_all([polygon, *pockets], grid_size=GRID)
    largest = max(getattr(filled, "geoms", [filled]), key=lambda piece: piece.area)
    return shapely.Polygon(largest.exterior)


def _open_edges(mesh: trimesh.Trimesh) -> int:
    _, counts = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
    return int((counts != 2).sum())
