"""Loading outlines by kind of file, and what each loader refuses."""

from __future__ import annotations

import numpy as np
import pytest

from tpcd.errors import OutlineError
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.sources import load_outlines

BUILTIN = builtin_outlines()
HAMMER = BUILTIN["hammer"].vertices


def refusal(path, **options) -> str:
    with pytest.raises(OutlineError) as caught:
        load_outlines(path, **options)
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message
    return message


def write(path, text):
    path.write_text(text)
    return path


def test_slices_come_back_as_they_were_written(tmp_path):
    path = tmp_path / "slices.npz"
    np.savez(path, **{name: outline.vertices for name, outline in BUILTIN.items()})
    found = load_outlines(path)
    assert list(found) == list(BUILTIN)
    for name, outline in found.items():
        np.testing.assert_allclose(outline.vertices, BUILTIN[name].vertices, atol=1e-15)


@pytest.mark.parametrize("header", ["", "x,z\n", "# a hammer\nx_m,z_m\n\n"])
@pytest.mark.parametrize("separator", [",", ";", "\t", ", "])
def test_a_csv_polygon_is_named_after_its_file(tmp_path, header, separator):
    rows = "\n".join(separator.join(f"{value:.17g}" for value in row) for row in HAMMER)
    path = write(tmp_path / "my_hammer.csv", header + rows + "\n")
    found = load_outlines(path)
    assert list(found) == ["my_hammer"]
    np.testing.assert_allclose(found["my_hammer"].vertices, HAMMER, atol=1e-15)


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1e3), ("cm", 1e2), ("in", 1 / 0.0254)])
@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_units_are_turned_into_metres(tmp_path, unit, factor, ending):
    path = tmp_path / f"hammer.{ending}"
    if ending == "csv":
        np.savetxt(path, HAMMER * factor, delimiter=",")
    else:
        np.savez(path, hammer=HAMMER * factor)
    found = load_outlines(path, unit=unit)["hammer"]
    np.testing.assert_allclose(found.vertices, HAMMER, atol=1e-14)


@pytest.mark.parametrize(
    "rows",
    [
        "0,00;0,00\n0,06;0,00\n0,06;0,09\n0,00;0,09\n",
        "x;z\n0;0\n0,06;0\n0,06;0,09\n0;0,09\n",
        "0\t0\n6e-2\t0\n0,06\t0,09\n0\t9,0E-2\n",
        "0 0\n0,06 0\n0,06 0,09\n0 0,09\n",
        "0, 0\n0.06, 0\n0.06, 0.09\n0, 0.09\n",
        "0,0,\n0.06,0,\n0.06,0.09,\n0,0.09,\n",
        '"x","z"\n"0","0"\n"0.06","0"\n"0.06","0.09"\n"0","0.09"\n',
        '"0,0","0,0"\n"0,06","0,0"\n"0,06","0,09"\n"0,0","0,09"\n',
        "'0';'0'\n'0,06';'0'\n'0,06';'0,09'\n'0';'0,09'\n",
        '"0,0";"0,0"\n"0,06";"0"\n"0,06";"0,09"\n"0";"0,09"\n',
        '"x","z"\n"0.0","0.0"\n"0.06","0"\n"0.06","0.09"\n"0","0.09"\n',
        '"x [m]","z [m]"\n"0,0","0,0"\n"0,06","0"\n"0,06","0,09"\n"0","0,09"\n',
        '"x [mm]"; "z [mm]"\n"0,0"; "0,0"\n"60"; "0"\n"60"; "90"\n"0"; "90"\n',
    ],
)
def test_decimal_commas_are_read_where_something_else_parts_the_numbers(tmp_path, rows):
    outline = load_outlines(write(tmp_path / "plate.csv", rows))["plate"]
    assert outline.area == pytest.approx(0.0054)


def test_blanks_before_a_comma_make_no_decimals(tmp_path):
    path = write(tmp_path / "plate.csv", "0 ,0\n60 ,0\n60 ,90\n0 ,90\n")
    assert load_outlines(path, unit="mm")["plate"].area == pytest.approx(0.0054)


def test_the_unit_of_a_header_is_taken_unless_another_is_given(tmp_path):
    path = write(tmp_path / "plate.csv", "x [mm];z [mm]\n0;0\n60;0\n60;90\n0;90\n")
    assert load_outlines(path)["plate"].area == pytest.approx(0.0054)
    with pytest.raises(OutlineError, match="its header is in mm; expected one unit, cm"):
        load_outlines(path, unit="cm")


@pytest.mark.parametrize(
    ("header", "scale"),
    [
        ("x_mm,z_mm", 1000),
        ("X (MM);Z (MM)", 1000),
        ("x/cm\tz/cm", 100),
        ("x, z in mm", 1000),
        ("x,z\nmm,mm", 1000),
        ('"x","z"\n"[in]","[in]"', 1 / 0.0254),
        ("x [inch],z [inch]", 1 / 0.0254),
        ("x [centimeters];z [centimeters]", 100),
        ("x in millimetres,z in millimetres", 1000),
        ("x (meter),z (meter)", 1),
        ("# unit: mm\nx,z", 1000),
        ("# a plate, cut from 3 mm steel\nx,z", 1),
        ("width in front,height in front", 1),
        ("left foot,right foot", 1),
    ],
)
def test_a_header_names_its_unit_in_many_ways(tmp_path, header, scale):
    corners = [(0, 0), (0.06, 0), (0.06, 0.09), (0, 0.09)]
    rows = "".join(f"{x * scale},{z * scale}\n" for x, z in corners)
    outline = load_outlines(write(tmp_path / "plate.csv", f"{header}\n{rows}"))["plate"]
    assert outline.area == pytest.approx(0.0054)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8", "utf-8-sig", "utf-16"])
def test_a_csv_is_read_in_every_encoding(tmp_path, encoding):
    path = tmp_path / "plate.csv"
    path.write_bytes("# Gehäuse\n0,0\n0.06,0\n0.06,0.09\n0,0.09\n".encode(encoding))
    assert load_outlines(path)["plate"].area == pytest.approx(0.0054)


def test_a_csv_in_millimetres_without_saying_so_gets_the_hint(tmp_path):
    path = tmp_path / "hammer.csv"
    np.savetxt(path, HAMMER * 1000, delimiter=",")
    assert "looks like millimetres" in refusal(path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "holds no vertices"),
        ("x,z\n", "holds no vertices"),
        ("x,z\n0,0\n0.1,zero\n0.1,0.1\n", "line 3 is '0.1,zero'"),
        ("x,z\nmore,words\n0,0\n", "line 2 is 'more,words'"),
        ("0,0\n0.1,0,5\n0.1,0.1\n", "line 2 has 3 numbers"),
        ("0,0,0,0\n", "part x and z by a semicolon"),
        ("0..0,0\n0.1,0\n0.1,0.1\n", "line 1 is '0..0,0'"),
        ("\u22120.1,0\n0.1,0\n0.1,0.1\n", "line 1 is"),
        ("z,x\n0,0\n0.1,0\n0.1,0.1\n", "line 1 begins with z"),
        ("x [mm],z [cm]\n0,0\n0.1,0\n0.1,0.1\n", "its header is in cm and mm"),
        ("x [ft],z [ft]\n0,0\n0.1,0\n0.1,0.1\n", "its header is in ft"),
        ("x [feet],z [feet]\n0,0\n0.1,0\n0.1,0.1\n", "its header is in feet"),
        ("x in decimetres,z\n0,0\n0.1,0\n0.1,0.1\n", "its header is in decimetres"),
        ("0,0\n0.1,0\n0.1,0.1\n\n0.2,0\n0.3,0\n0.3,0.1\n", "line 4 is empty and parts"),
        ("0,0\n0.1\n0.1,0.1\n", "line 2 has 1 numbers"),
        ("0,0\n0.1,nan\n0.1,0.1\n", "line 2 is '0.1,nan'"),
        ("0;0\n100,5;0\n100;1.234\n", "line 3: z is '1.234', which may be 1.234 or 1234"),
        ("0,5;0\n100,5;0\n100.5;10\n", "line 3: x is '100.5'; expected numbers: elsewhere"),
        ("0,0\n0.1,0.1\n0.1,0\n0,0.1\n", "crosses or touches itself at (0.05, 0.05) m"),
    ],
)
def test_a_bad_csv_is_refused_with_its_line(tmp_path, text, expected):
    assert expected in refusal(write(tmp_path / "bad.csv", text))


def test_a_csv_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "bad.csv"
    path.write_bytes(b"\x89PNG\x00\x81")
    assert "not readable as text" in refusal(path)


def test_slices_are_never_unpickled(tmp_path):
    path = tmp_path / "evil.npz"
    np.savez(path, thing=np.array([{"a": 1}], dtype=object))
    assert "not a readable .npz file" in refusal(path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut off", b"no zip at all"])
def test_a_file_that_is_no_npz_is_refused(tmp_path, content):
    path = tmp_path / "bad.npz"
    path.write_bytes(content)
    assert "not a readable .npz file" in refusal(path)


def test_a_truncated_npz_is_refused(tmp_path):
    path = tmp_path / "bad.npz"
    np.savez(path, hammer=HAMMER)
    path.write_bytes(path.read_bytes()[:-100])
    assert "not a readable .npz file" in refusal(path)


def test_a_plain_array_under_the_name_npz_is_refused(tmp_path):
    path = tmp_path / "bad.npz"
    with path.open("wb") as stream:
        np.save(stream, HAMMER)
    assert "not a readable .npz file" in refusal(path)


@pytest.mark.parametrize(
    ("array", "expected"),
    [
        (np.array(["a", "b"]), "'thing' holds <U1"),
        (np.zeros((5, 3)), "outline 'thing' has shape (5, 3)"),
        (HAMMER * 1000, "looks like millimetres"),
        (np.full((5, 2), np.nan), "vertex 0 is (nan, nan)"),
    ],
)
def test_an_array_that_is_no_outline_is_named(tmp_path, array, expected):
    path = tmp_path / "slices.npz"
    np.savez(path, thing=array)
    assert expected in refusal(path)


def test_an_empty_npz_is_refused(tmp_path):
    path = tmp_path / "empty.npz"
    np.savez(path)
    assert "holds no arrays" in refusal(path)


@pytest.mark.parametrize("ending", ["npz", "csv", "svg", "ply", "stl", "obj"])
def test_a_missing_file_is_named(tmp_path, ending):
    assert "not found" in refusal(tmp_path / f"nowhere.{ending}")


def test_an_unknown_kind_of_file_lists_the_known_ones(tmp_path):
    assert ".npz, .csv, .svg, .ply, .stl, .obj" in refusal(write(tmp_path / "shape.dxf", "0"))


def test_an_unknown_unit_is_refused(tmp_path):
    with pytest.raises(ValueError, match="unit must be one of m, cm, mm, in"):
        load_outlines(write(tmp_path / "shape.csv", "0,0"), unit="furlong")
