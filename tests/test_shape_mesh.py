"""Mesh files as they come: encodings, cut-off files, polygons, vertices that are no numbers."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from tpcd.errors import OutlineError
from tpcd.shape.mesh import load_mesh
from tpcd.shape.section import CuttingPlane
from tpcd.shape.sources import load_outlines

BOX = trimesh.creation.box((0.06, 0.04, 0.09))
AREA = 0.0054
OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in BOX.vertices) + "".join(
    "f " + " ".join(str(corner + 1) for corner in face) + "\n" for face in BOX.faces
)
STL = (
    "solid Gehäuse\n"
    + "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in triangle)
        + "endloop\nendfacet\n"
        for triangle in BOX.triangles
    )
    + "endsolid\n"
)


def refusal(path) -> str:
    with pytest.raises(OutlineError) as caught:
        load_mesh(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
@pytest.mark.parametrize(
    ("name", "text"), [("part.obj", "# Gehäuse\no Gehäuse\n" + OBJ), ("part.stl", STL)]
)
def test_text_is_read_in_every_encoding(tmp_path, encoding, name, text):
    path = tmp_path / name
    path.write_bytes(text.encode(encoding))
    assert load_outlines(path)["part"].area == pytest.approx(AREA)


def test_a_ply_with_a_comment_in_another_encoding_is_read(tmp_path):
    path = tmp_path / "part.ply"
    content = BOX.export(file_type="ply")
    path.write_bytes(content.replace(b"\nelement vertex", b"\ncomment Geh\xe4use\nelement vertex"))
    assert load_outlines(path)["part"].area == pytest.approx(AREA)


def polygons(ending: str, vertices, faces) -> str:
    """The text of an OBJ or a PLY with faces of any number of corners."""
    points = [" ".join(f"{value:.9f}" for value in vertex) for vertex in vertices]
    if ending == "obj":
        lines = [f"v {point}" for point in points]
        lines += ["f " + " ".join(str(k + 1) for k in face) for face in faces]
        return "\n".join(lines) + "\n"
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [f"{len(face)} " + " ".join(map(str, face)) for face in faces]
    return head + "\n".join((*points, *rows)) + "\n"


def column(corners) -> tuple[np.ndarray, list[list[int]]]:
    """A prism 0.04 m high over a polygon in the plane of x and y, one face for each side."""
    n = len(corners)
    vertices = [(x, y, z) for z in (-0.02, 0.02) for x, y in corners]
    sides = [[k, (k + 1) % n, (k + 1) % n + n, k + n] for k in range(n)]
    return np.array(vertices), [list(range(n))[::-1], list(range(n, 2 * n)), *sides]


U_SHAPE = np.array([[0, 0], [6, 0], [6, 8], [5, 8], [5, 2], [2, 2], [2, 8], [0, 8]]) / 100


@pytest.mark.parametrize("ending", ["obj", "ply"])
@pytest.mark.parametrize("first", range(8))
def test_a_face_that_is_not_convex_encloses_what_its_corners_do(tmp_path, ending, first):
    """A fan of triangles around one corner of a U bridges its arms, and the cut between them."""
    path = tmp_path / f"part.{ending}"
    path.write_text(polygons(ending, *column(np.roll(U_SHAPE, first, axis=0))))
    mesh = load_mesh(path)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(0.04 * 30e-4)
    forward = CuttingPlane(*np.array([[0, 0.05, 0], [0, -1.0, 0], [0, 0, 1.0]]))
    outline = load_outlines(path, plane=forward)["part"]
    assert outline.size == pytest.approx((0.02, 0.04)) and "50% of the largest" in outline.notes


def test_a_face_that_crosses_itself_is_refused(tmp_path):
    vertices, faces = column(U_SHAPE[[0, 2, 1, 3]])
    path = tmp_path / "part.obj"
    path.write_text(polygons("obj", vertices, faces))
    assert "has a face of 4 corners that crosses itself" in refusal(path)


@pytest.mark.parametrize("apart", ["", "g b\n", "o b\nusemtl c\n"])
def test_negative_indices_count_back_from_their_line(tmp_path, apart):
    path = tmp_path / "part.obj"
    moved = BOX.copy()
    moved.apply_translation([0.2, 0, 0])
    path.write_text(
        apart.join(
            "".join(f"v {x} {y} {z}\n" for x, y, z in body.vertices)
            + "".join(f"f {a - 8} {b - 8} {c - 8}\n" for a, b, c in body.faces)
            for body in (BOX, moved)
        )
    )
    assert load_mesh(path).bounds[1, 0] == pytest.approx(0.23)
    assert "1 further piece, 100%" in load_outlines(path)["part"].notes


def test_blanks_of_an_obj_are_any(tmp_path):
    path = tmp_path / "part.obj"
    path.write_text(OBJ.replace(" ", "\t").replace("v", "  v"))
    assert load_outlines(path)["part"].area == pytest.approx(AREA)


@pytest.mark.parametrize("row", ["f 1 2", "f 1 2 c", "v 0 0", "f 1.5 2 3"])
def test_a_bad_row_of_an_obj_is_named(tmp_path, row):
    path = tmp_path / "part.obj"
    path.write_text(f"{OBJ}{row}\n")
    assert f"line 21 is '{row}'" in refusal(path)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.985])
def test_a_ply_in_text_that_is_cut_off_says_so(tmp_path, share):
    content = polygons("ply", BOX.vertices, BOX.faces)
    body = content.index("end_header") + 11
    path = tmp_path / "part.ply"
    path.write_text(content[: body + int(share * (len(content) - body))])
    assert "is cut off: states 20 rows" in refusal(path) or "11 are whole" in refusal(path)


def test_a_ply_is_refused_for_what_it_is(tmp_path):
    path = tmp_path / "part.ply"
    sound = BOX.export(file_type="ply")
    for content, told in (
        (sound[:60], "is cut off within its header"),
        (sound[:-5], "is cut off, or has faces of different numbers of corners"),
        (BOX.export(file_type="stl"), "does not begin with 'ply'"),
        (polygons("ply", BOX.vertices, [*BOX.faces, [0, 1, 99]]).encode(), "vertex that is not"),
        (polygons("ply", BOX.vertices, [*BOX.faces, [0, 1, -1]]).encode(), "vertex that is not"),
        (polygons("ply", BOX.vertices, BOX.faces).replace(".0", ",0").encode(), "decimal comma"),
        (polygons("ply", BOX.vertices, BOX.faces).encode() + b"3 0 1 2\n", "and holds 21"),
    ):
        path.write_bytes(content)
        assert told in refusal(path)


@pytest.mark.parametrize("stated", [0, 6, 11])
def test_a_binary_stl_with_more_triangles_than_stated_is_refused(tmp_path, stated):
    content = BOX.export(file_type="stl")
    path = tmp_path / "part.stl"
    path.write_bytes(content[:80] + stated.to_bytes(4, "little") + content[84:])
    assert f"states {stated} triangles and holds 12" in refusal(path)


@pytest.mark.parametrize("name", ["a", "FACET", "my endfacet", "vertex 1 2", "endsolid of b"])
@pytest.mark.parametrize("spell", [str.lower, str.upper, str.title])
def test_an_stl_in_text_is_read_in_every_spelling_and_with_every_name(tmp_path, name, spell):
    path = tmp_path / "part.stl"
    path.write_text(spell(STL.replace("Gehäuse", name)), encoding="utf-8")
    assert load_outlines(path)["part"].area == pytest.approx(AREA)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (STL.replace("endsolid\n", ""), "no 'endsolid' ends it"),
        (STL.replace("endloop", "vertex 0 0 0\nendloop"), "facets of other than 3 vertices"),
        (OBJ, "is text without a line that begins with 'facet'"),
    ],
)
def test_an_stl_in_text_is_refused_for_what_it_is(tmp_path, text, told):
    path = tmp_path / "part.stl"
    path.write_text(text, encoding="utf-8")
    assert told in refusal(path)


def test_a_flat_mesh_is_refused_with_its_file(tmp_path):
    path = tmp_path / "part.obj"
    path.write_text("v 0 0 0\nv 0.06 0 0\nv 0 0 0.09\nf 1 2 3\n")
    with pytest.raises(OutlineError, match=f"^{path}: the mesh is flat seen from above"):
        load_outlines(path)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.95])
def test_a_binary_stl_that_is_cut_off_says_so(tmp_path, share):
    content = BOX.export(file_type="stl")
    path = tmp_path / "part.stl"
    path.write_bytes(content[: int(share * len(content))])
    assert "is cut off" in refusal(path) and "of the 12 triangles" in refusal(path)


def test_a_stub_of_an_stl_is_none(tmp_path):
    path = tmp_path / "part.stl"
    path.write_bytes(BOX.export(file_type="stl")[:60])
    assert "holds 60 bytes, no STL" in refusal(path)


def test_an_stl_in_text_that_is_cut_off_says_so(tmp_path):
    path = tmp_path / "part.stl"
    path.write_text(STL[: int(0.6 * len(STL))], encoding="utf-8")
    assert "cut off" in refusal(path)


@pytest.mark.parametrize("header", [b"solid part", b"COLOR=\xc8\xc8\xc8\xff,MATERIAL="])
@pytest.mark.parametrize("behind", [b"", b"\0\0\0\0"])
def test_a_binary_stl_is_read_whatever_its_header_says(tmp_path, header, behind):
    content = BOX.export(file_type="stl")
    path = tmp_path / "part.stl"
    path.write_bytes(header.ljust(80, b"\0") + content[80:] + behind)
    assert load_outlines(path)["part"].area == pytest.approx(AREA)


@pytest.mark.parametrize(("name", "text"), [("part.obj", OBJ), ("part.stl", STL)])
def test_decimal_commas_are_named_with_their_line(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text.replace(".", ","), encoding="utf-8")
    assert f"line {1 if name == 'part.obj' else 4} has a decimal comma" in refusal(path)


def test_a_vertex_that_is_no_number_is_named_if_a_face_has_it(tmp_path):
    vertices = np.array(BOX.vertices)
    path = tmp_path / "part.ply"
    trimesh.Trimesh(np.vstack((vertices, [[np.nan] * 3])), BOX.faces, process=False).export(path)
    assert load_outlines(path)["part"].area == pytest.approx(AREA)
    vertices[3] = np.nan
    trimesh.Trimesh(vertices, BOX.faces, process=False).export(path)
    assert "1 of the 8 vertices of its faces are no finite numbers" in refusal(path)


def test_an_object_lost_in_the_rounding_far_from_the_origin_is_refused(tmp_path):
    for shift, name in ((500.0, "near.ply"), (5e6, "far.ply")):
        moved = BOX.copy()
        moved.apply_translation([shift, 0, 0])
        moved.export(tmp_path / name)
    assert "5e+06 units from its origin" in refusal(tmp_path / "far.ply")
    assert load_outlines(tmp_path / "near.ply")["near"].area == pytest.approx(AREA, rel=1e-3)


def test_a_face_of_a_missing_vertex_is_named(tmp_path):
    path = tmp_path / "part.obj"
    path.write_text(OBJ + "f 1 2 99\n")
    assert "a face names a vertex that is not there" in refusal(path)


def test_an_obj_that_counts_from_zero_is_refused(tmp_path):
    path = tmp_path / "part.obj"
    faces = "".join("f " + " ".join(str(corner) for corner in face) + "\n" for face in BOX.faces)
    path.write_text(OBJ[: OBJ.index("f ")] + faces)
    assert "counts vertices from 0" in refusal(path)
