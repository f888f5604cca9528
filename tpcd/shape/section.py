"""Outlines from triangle meshes: a plane cut, or the silhouette in one direction.

A `CuttingPlane` carries the frame of the outline: its x axis is horizontal in the picture, its
z axis is `up`. A cut is a set of line pieces; whatever they enclose is filled, so that faces given
twice, faces without area, inner shells and bodies that overlap or share a face change nothing. The
largest piece is kept. Where the pieces leave a gap in the boundary the mesh has a hole there, and
the cut is refused with the place.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import shapely
from jaxtyping import Float

from tpcd.errors import OutlineError
from tpcd.shape.outline import Outline, make_outline

if TYPE_CHECKING:
    import trimesh

GRID = 1e-9
"""Resolution of outlines [m]."""
NEIGHBOURS = (0.0, 1e-6, 1e-5)
"""Ends of pieces this near, in mesh sizes beyond `GRID`, are one point; tried in turn: vertices of
faces that were written one by one differ by rounding."""
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
        OutlineError: the cut is open (with the place) or in pieces that touch, the plane misses the
            mesh, or it is no outline of plausible size.
    """
    blame = path if path is not None else f"mesh '{name}'"
    try:
        plane = plane if plane is not None else upright_plane(mesh)
    except ValueError as error:
        raise OutlineError(blame, str(error)) from None
    loops = _loops(mesh, plane, blame)
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
    """What the pieces of the cut enclose, as polygons in the axes of the plane."""
    from trimesh.intersections import mesh_plane

    across, up, normal = plane.axes()
    size = float(mesh.scale)
    ends: np.ndarray | None = None
    for nudge in NUDGES:
        origin = plane.origin + nudge * size * normal
        pieces = np.asarray(mesh_plane(mesh, normal, origin)).reshape(-1, 2, 3)
        if not len(pieces):
            continue
        flat = (pieces - plane.origin) @ np.stack((across, up), axis=1)
        for nearness in NEIGHBOURS:
            filled, loose = _enclosed(flat, GRID + nearness * size)
            if shapely.is_empty(loose) and not shapely.is_empty(filled):
                loops = list(getattr(filled, "geoms", [filled]))
                _check_apart(loops, blame)
                return loops
            if ends is None:
                ends = shapely.get_coordinates(shapely.boundary(loose))
    if ends is None:
        raise OutlineError(
            blame, "the plane misses the mesh", f"its points lie within {mesh.bounds.tolist()} m"
        )
    count = _open_edges(mesh)
    hole = f"the mesh has {count} open edges" if count else "the mesh meets itself there"
    where = f" at ({ends[0, 0]:.4g}, {ends[0, 1]:.4g}) m" if len(ends) else ""
    raise OutlineError(blame, f"the cut is open{where} ({hole})", "close the mesh or cut elsewhere")


def _enclosed(
    pieces: Float[np.ndarray, "k 2 2"], nearness: float
) -> tuple[shapely.Geometry, shapely.Geometry]:
    """What line pieces enclose once ends within `nearness` [m] are one point, and the lines outside
    of it, which end nowhere."""
    joined = _joined(pieces.reshape(-1, 2), nearness).reshape(-1, 2, 2)
    joined = joined[(joined[:, 0] != joined[:, 1]).any(axis=1)]
    lines = shapely.union_all(shapely.linestrings(joined))
    cells, bridges, dangles, _ = shapely.polygonize_full([lines])
    rings = shapely.get_exterior_ring(shapely.get_parts(cells))
    filled = shapely.union_all(shapely.polygons(rings))
    # Where two long edges of a shared face are noded apart, slivers between them stay empty.
    loose = shapely.union_all([bridges, dangles]).difference(filled.buffer(nearness))
    return filled, loose


def _joined(points: Float[np.ndarray, "k 2"], nearness: float) -> Float[np.ndarray, "k 2"]:
    """The points, each replaced by the first of those that are within `nearness` of each other."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    pairs = KDTree(points).query_pairs(nearness, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    _, group = connected_components(links, directed=False)
    _, first = np.unique(group, return_index=True)
    return points[first[group]]


def _check_apart(loops: list[shapely.Polygon], blame: str | Path) -> None:
    """Refuse pieces that touch: at a point or an edge seen end on, nobody knows what is solid."""
    for index, piece in enumerate(loops):
        for other in loops[:index]:
            if piece.touches(other):
                place = piece.intersection(other).representative_point()
                raise OutlineError(
                    blame,
                    f"the mesh crosses or touches itself in the cut at ({place.x:.4g},"
                    f" {place.y:.4g}) m",
                    "repair the mesh (unite its bodies) or cut elsewhere",
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
    """Edges of one face only, faces that are given twice or have no area left out."""
    faces = np.unique(np.sort(mesh.faces, axis=1), axis=0)
    faces = faces[(np.diff(faces, axis=1) > 0).all(axis=1)]
    edges = np.concatenate((faces[:, :2], faces[:, 1:], faces[:, ::2]))
    _, counts = np.unique(edges, axis=0, return_counts=True)
    return int((counts == 1).sum())
