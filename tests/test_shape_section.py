"""Meshes to outlines: cuts with known answers, their invariances, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
import trimesh
from numpy.typing import ArrayLike

from tpcd.errors import OutlineError
from tpcd.shape.mesh import load_mesh
from tpcd.shape.section import (
    CuttingPlane,
    cut_mesh,
    mesh_silhouette,
    upright_plane,
)
from tpcd.shape.sources import load_outlines

UP = np.array([0.0, 0.0, 1.0])
FRONT = np.array([0.0, -1.0, 0.0])


def plane(origin: ArrayLike = (0.0, 0.0, 0.0), normal: ArrayLike = FRONT, up=UP) -> CuttingPlane:
    return CuttingPlane(np.array(origin, dtype=float), np.array(normal, dtype=float), up)


def box(x: float, y: float, z: float) -> trimesh.Trimesh:
    return trimesh.creation.box(extents=(x, y, z))


def wedge() -> trimesh.Trimesh:
    """A right triangle in x and z (legs 0.12 and 0.06 m), 0.05 m deep along y."""
    corners = [(0.0, 0.0), (0.12, 0.0), (0.0, 0.06)]
    vertices = [(x, y, z) for y in (-0.025, 0.025) for x, z in corners]
    return trimesh.convex.convex_hull(np.array(vertices))


def vessel(wall: float = 0.005) -> trimesh.Trimesh:
    """An open cup: a profile turned about z, with a bottom."""
    profile = [(0, 0), (0.04, 0), (0.04, 0.1), (0.04 - wall, 0.1), (0.04 - wall, wall), (0, wall)]
    return trimesh.creation.revolve(np.array(profile), sections=64)


def refusal(mesh, cutting=None, **options) -> str:
    with pytest.raises(OutlineError) as caught:
        cut_mesh(mesh, "thing", cutting, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_cut_through_a_box_is_its_face():
    outline = cut_mesh(box(0.1, 0.04, 0.2), "box", plane())
    assert outline.size == pytest.approx((0.1, 0.2))
    assert outline.area == pytest.approx(0.02)


def test_a_cut_through_a_ball_off_its_centre_is_the_smaller_disc():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    outline = cut_mesh(ball, "ball", plane(origin=(0.0, 0.03, 0.0)))
    assert outline.area == pytest.approx(np.pi * (0.05**2 - 0.03**2), rel=5e-3)


def test_the_outline_is_seen_from_the_side_the_normal_points_to():
    corner = np.array([-0.04, -0.02])  # the right angle, relative to the centroid
    seen = cut_mesh(wedge(), "wedge", plane()).vertices
    behind = cut_mesh(wedge(), "wedge", plane(normal=-FRONT)).vertices
    assert np.linalg.norm(seen - corner, axis=1).min() < 1e-8
    assert np.linalg.norm(behind - corner * [-1, 1], axis=1).min() < 1e-8


def test_moving_mesh_and_plane_together_changes_nothing():
    motion = trimesh.transformations.random_rotation_matrix(rand=np.array([0.1, 0.7, 0.4]))
    motion[:3, 3] = [0.3, -0.2, 0.5]
    moved = wedge()
    moved.apply_transform(motion)
    origin = np.array([0.03, 0.0, 0.02])
    first = cut_mesh(wedge(), "wedge", plane(origin))
    turned = [motion[:3, :3] @ v for v in (FRONT, UP)]
    second = cut_mesh(
        moved, "wedge", CuttingPlane(motion[:3, :3] @ origin + motion[:3, 3], *turned)
    )
    assert shapely.hausdorff_distance(first.polygon, second.polygon) < 2e-6


def test_holes_are_filled_and_only_the_largest_loop_is_kept():
    ring = trimesh.creation.annulus(r_min=0.02, r_max=0.05, height=0.03)
    outline = cut_mesh(ring, "ring", plane(normal=UP, up=np.array([0.0, 1.0, 0.0])))
    assert outline.area == pytest.approx(np.pi * 0.05**2, rel=0.02)
    upright = cut_mesh(ring, "ring", plane())
    assert upright.size == pytest.approx((0.03, 0.03), rel=0.02)
    assert "1 further piece, 100% of the largest one's area" in upright.notes


def test_a_cup_is_closed_only_on_request():
    cup = vessel()
    thin = cut_mesh(cup, "cup")
    filled = cut_mesh(cup, "cup", close_recesses=True)
    assert thin.area == pytest.approx(0.08 * 0.1 - 0.07 * 0.095, rel=0.01)
    assert filled.area == pytest.approx(0.08 * 0.1, rel=0.01)


def test_closing_leaves_notches_in_the_side_alone():
    notched = trimesh.creation.revolve(
        np.array([(0, 0), (0.04, 0), (0.03, 0.05), (0.04, 0.1), (0, 0.1)]), sections=64
    )
    plain, closed = (cut_mesh(notched, "spool", close_recesses=c) for c in (False, True))
    assert closed.area == pytest.approx(plain.area, rel=1e-9)


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2, 2.5])
def test_the_default_plane_runs_along_the_longer_side_whatever_the_yaw(angle):
    turned = box(0.15, 0.06, 0.1)
    turned.apply_transform(trimesh.transformations.rotation_matrix(angle, UP))
    assert cut_mesh(turned, "box").size == pytest.approx((0.15, 0.1), abs=1e-6)
    assert cut_mesh(turned, "box", upright_plane(turned, "longest")).size[0] == pytest.approx(
        np.hypot(0.15, 0.06), abs=1e-4
    )


def test_a_plane_through_faces_and_edges_of_the_mesh_still_cuts():
    """The plane y = 0 runs along edges of a box whose faces are divided in the middle."""
    mesh = box(0.1, 0.04, 0.2).subdivide()
    assert (np.abs(mesh.vertices[:, 1]) < 1e-12).sum() >= 8
    assert cut_mesh(mesh, "box", plane()).area == pytest.approx(0.02)
    for face in (-0.02, 0.02):
        assert cut_mesh(mesh, "box", plane(origin=(0, face, 0))).area == pytest.approx(0.02)


def test_a_silhouette_covers_every_cut():
    cup = vessel()
    shadow = mesh_silhouette(cup, "cup", plane())
    assert shadow.area == pytest.approx(0.08 * 0.1, rel=0.01)
    ring = trimesh.creation.annulus(r_min=0.02, r_max=0.05, height=0.03)
    above = mesh_silhouette(ring, "ring", plane(normal=UP, up=np.array([0.0, 1.0, 0.0])))
    assert above.area == pytest.approx(np.pi * 0.05**2, rel=0.02)


def test_a_silhouette_may_be_of_an_open_mesh():
    sheet = box(0.1, 0.04, 0.2)
    sheet.update_faces(np.arange(len(sheet.faces)) > 0)
    assert mesh_silhouette(sheet, "box", plane()).area == pytest.approx(0.02)


def test_a_cut_through_a_hole_is_refused_with_its_place_and_the_open_edges():
    mesh = box(0.1, 0.04, 0.2)
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    told = refusal(mesh, plane())
    assert "the cut is open at (-0.05, " in told and "3 open edges" in told


def test_a_cut_beside_a_hole_is_as_if_the_mesh_were_closed():
    mesh = box(0.1, 0.04, 0.2)
    mesh.update_faces(np.abs(mesh.face_normals[:, 1]) < 0.5)
    assert cut_mesh(mesh, "box", plane()).area == pytest.approx(0.02)


def test_a_closed_part_beside_an_open_body_is_not_taken_for_it():
    body, bolt = box(0.1, 0.04, 0.2), box(0.02, 0.02, 0.02)
    body.update_faces(body.face_normals[:, 2] < 0.5)
    bolt.apply_translation([0.2, 0, 0])
    assert "the cut is open" in refusal(trimesh.util.concatenate([body, bolt]), plane())


def spoiled(kind: str) -> trimesh.Trimesh:
    """A box of 0.06 x 0.04 x 0.09 m whose cut along x and z has 54 cm^2, faces spoiled."""
    mesh = box(0.06, 0.04, 0.09)
    v, f = np.array(mesh.vertices), np.array(mesh.faces)
    if kind == "double-sided":
        return trimesh.Trimesh(v, np.vstack((f, f[:, ::-1])), process=False)
    if kind == "a face twice":
        return trimesh.Trimesh(v, np.vstack((f, f[:1])), process=False)
    if kind == "degenerate faces":
        return trimesh.Trimesh(v, np.vstack((f, [[0, 0, 1], [2, 2, 2]])), process=False)
    if kind == "vertices rounded apart":
        loose = v[f].reshape(-1, 3) + np.random.default_rng(0).normal(0, 1e-7, (3 * len(f), 3))
        return trimesh.Trimesh(loose, np.arange(len(loose)).reshape(-1, 3), process=False)
    if kind == "inside out":
        return trimesh.Trimesh(v, f[:, ::-1], process=False)
    assert kind == "an inner sheet"
    sheet = np.array([[0, -0.02, -0.03], [0, 0.02, -0.03], [0.0, 0.02, 0.03]])
    return trimesh.Trimesh(np.vstack((v, sheet)), np.vstack((f, [[8, 9, 10]])), process=False)


@pytest.mark.parametrize(
    "kind",
    [
        "double-sided",
        "a face twice",
        "degenerate faces",
        "vertices rounded apart",
        "inside out",
        "an inner sheet",
    ],
)
def test_faces_that_enclose_the_same_are_cut_the_same(kind):
    for y in (0.0, 0.013, -0.007):
        outline = cut_mesh(spoiled(kind), "box", plane(origin=(0, y, 0)))
        assert outline.area == pytest.approx(0.0054, rel=1e-4)


@pytest.mark.parametrize(("shift", "area"), [((0.06, 0, 0), 0.0108), ((0.03, 0.01, 0.02), None)])
def test_bodies_that_share_a_face_or_cross_are_one(shift, area):
    first, second = box(0.06, 0.04, 0.09), box(0.06, 0.04, 0.09)
    second.apply_translation(shift)
    area = area or 2 * 0.0054 - 0.03 * 0.07
    both = trimesh.util.concatenate([first, second])
    assert cut_mesh(both, "two", plane()).area == pytest.approx(area)


def test_a_plane_beside_the_mesh_is_refused():
    assert "the plane misses the mesh" in refusal(box(0.1, 0.1, 0.1), plane(origin=(0, 0.2, 0)))


def test_bodies_that_touch_along_an_edge_are_refused_with_the_place():
    first, second = box(0.1, 0.1, 0.1), box(0.1, 0.1, 0.1)
    second.apply_translation([0.1, 0.0, 0.1])
    message = refusal(trimesh.util.concatenate([first, second]), plane())
    assert "touches itself in the cut at (0.05, 0.05)" in message


def test_a_body_that_crosses_itself_is_refused():
    """A prism over a bow tie: watertight as a graph, but its wall crosses itself."""
    bow_tie = [(0, 0), (0.1, 0.1), (0.1, 0), (0, 0.1)]
    vertices = [(x, y, z) for y in (-0.02, 0.02) for x, z in bow_tie]
    faces = [(0, 1, 2), (0, 2, 3), (4, 6, 5), (4, 7, 6)]
    for k in range(4):
        n = (k + 1) % 4
        faces += [(k, k + 4, n), (n, k + 4, n + 4)]
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert "the mesh crosses or touches itself in the cut" in refusal(mesh, plane())


def test_a_mesh_in_millimetres_gets_the_hint():
    assert "looks like millimetres" in refusal(box(100, 40, 200), plane())


@pytest.mark.parametrize("ending", ["ply", "stl", "obj"])
@pytest.mark.parametrize(("unit", "factor"), [("m", 1.0), ("mm", 1000.0)])
def test_meshes_of_every_kind_load_in_their_unit(tmp_path, ending, unit, factor):
    path = tmp_path / f"crate.{ending}"
    box(0.1 * factor, 0.04 * factor, 0.2 * factor).export(path)
    found = load_outlines(path, unit=unit)
    assert list(found) == ["crate"]
    assert found["crate"].size == pytest.approx((0.1, 0.2), rel=1e-6)


def test_the_plane_can_be_chosen_when_loading(tmp_path):
    path = tmp_path / "crate.ply"
    box(0.1, 0.04, 0.2).export(path)
    found = load_outlines(path, plane=plane(normal=(1.0, 0.0, 0.0)))
    assert found["crate"].size == pytest.approx((0.04, 0.2), rel=1e-6)


@pytest.mark.parametrize("ending", ["ply", "stl", "obj"])
@pytest.mark.parametrize("content", [b"", b"garbage", b"ply\nformat ascii 1.0\nelement vertex 9\n"])
def test_files_that_are_no_mesh_are_refused(tmp_path, ending, content):
    path = tmp_path / f"bad.{ending}"
    path.write_bytes(content)
    with pytest.raises(OutlineError) as caught:
        load_mesh(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_truncated_mesh_is_refused(tmp_path):
    path = tmp_path / "bad.ply"
    box(0.1, 0.1, 0.1).export(path)
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(OutlineError):
        load_outlines(path)


def test_a_file_of_another_kind_is_refused(tmp_path):
    with pytest.raises(OutlineError, match="not a mesh file"):
        load_mesh(tmp_path / "part.step")


@pytest.mark.parametrize(
    ("normal", "up"), [(UP, UP), (np.zeros(3), UP), (np.array([np.nan, 0, 0]), UP)]
)
def test_a_plane_without_a_direction_is_refused(normal, up):
    with pytest.raises(ValueError, match="normal"):
        CuttingPlane(np.zeros(3), normal, up)


def test_senseless_settings_are_refused(tmp_path):
    with pytest.raises((ValueError, TypeError), match="along"):
        upright_plane(box(0.1, 0.1, 0.1), "sideways")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="unit must be"):
        load_mesh(tmp_path / "part.stl", unit="yard")
