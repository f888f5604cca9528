"""Mesh files as they come: encodings, cut-off files, vertices that are no numbers."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from tpcd.errors import OutlineError
from tpcd.shape.mesh import load_mesh
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
