"""The YCB folder: where it is sought, what it holds, and cuts of its meshes.

The tests of real data run where the folder is (`TPCD_YCB` or `../shared/ycb`).
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import shapely

from tpcd.errors import FileError, OutlineError
from tpcd.shape import ycb
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.mesh import load_mesh
from tpcd.shape.section import CuttingPlane, cut_mesh
from tpcd.shape.ycb import FOLDER_VARIABLE, GRASPABLE_21, load_ycb, ycb_folder, ycb_meshes
from tpcd.shape.ycb_archive import UNSUITABLE, write_slices

FOLDER = ycb_folder()
needs_ycb = pytest.mark.skipif(FOLDER is None, reason="no YCB folder on this machine")
WELL_CUT = (
    "003_cracker_box",
    "006_mustard_bottle",
    "013_apple",
    "036_wood_block",
    "077_rubiks_cube",
)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A small folder of the same layout, made of built-in outlines."""
    mug, bowl = (builtin_outlines()[name].vertices for name in ("mug", "bowl"))
    np.savez(tmp_path / "slices.npz", mug=mug, bowl=bowl)
    np.savez(tmp_path / "slices_extra.npz", **{"mug/side": bowl})
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    return tmp_path


def test_the_environment_names_the_folder(folder):
    assert ycb_folder() == folder
    assert list(load_ycb()) == ["mug", "bowl"]
    assert list(load_ycb("extra")) == ["mug/side"]
    assert list(load_ycb("all")) == ["mug", "bowl", "mug/side"]


def test_a_named_folder_that_does_not_exist_is_an_error(monkeypatch, tmp_path):
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "nowhere"))
    with pytest.raises(FileError, match="does not exist; run scripts/fetch_ycb.py"):
        load_ycb()


def test_without_a_folder_there_is_a_remedy(monkeypatch):
    monkeypatch.setattr(ycb, "ycb_folder", lambda: None)
    with pytest.raises(FileError, match="no such folder .*; run scripts/fetch_ycb.py") as caught:
        load_ycb()
    assert FOLDER_VARIABLE in str(caught.value)
    assert ycb_meshes() == {}


def test_a_folder_without_the_file_says_which(folder):
    (folder / "slices_extra.npz").unlink()
    with pytest.raises(FileError, match="slices_extra.npz: not found"):
        load_ycb("all")


def test_a_bad_slice_is_named(folder):
    np.savez(folder / "slices.npz", mug=np.zeros((4, 2)))
    with pytest.raises(OutlineError, match="outline 'mug'"):
        load_ycb()


def test_an_unknown_part_is_refused():
    with pytest.raises((ValueError, TypeError), match="which"):
        load_ycb("half")  # type: ignore[arg-type]


def test_the_selection_has_21_different_objects():
    assert len(set(GRASPABLE_21)) == 21
    numbers = [int(name[:3]) for name in GRASPABLE_21]
    assert numbers == [2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 19, 21, 24, 25, 35, 36, 37, 40, 51, 52, 61]
    assert not set(GRASPABLE_21) & UNSUITABLE


@needs_ycb
def test_all_ycb_outlines_load_and_hold_the_selection():
    main, both = load_ycb("main"), load_ycb("all")
    assert set(GRASPABLE_21) <= set(main) <= set(both)
    assert len(both) == len(main) + len(load_ycb("extra"))
    for outline in both.values():
        assert outline.polygon.centroid.distance(shapely.Point(0, 0)) < 1e-12


@needs_ycb
@pytest.mark.parametrize("name", WELL_CUT)
def test_cutting_a_ycb_mesh_in_its_published_plane_gives_the_published_outline(name):
    assert FOLDER is not None
    with (FOLDER / "slices.csv").open() as stream:
        row = next(row for row in csv.DictReader(stream) if row["object"] == name)
    origin, u, w = (np.array([float(row[f"{key}_{axis}"]) for axis in "xyz"])
                    for key in ("origin", "u", "w"))  # fmt: skip
    mesh = load_mesh(ycb_meshes()[name])
    cut = cut_mesh(mesh, name, CuttingPlane(origin, np.cross(u, w), w))
    gap = shapely.hausdorff_distance(cut.polygon, load_ycb()[name].polygon)
    assert gap < float(row["resampling_error_mm"]) / 1000 + 5e-4


@needs_ycb
def test_own_slices_of_ycb_meshes_agree_with_the_published_ones(tmp_path, monkeypatch):
    names = ("006_mustard_bottle", "024_bowl", "025_mug", "036_wood_block", "065-b_cups")
    (tmp_path / "meshes").mkdir()
    for name in names:
        (tmp_path / "meshes" / f"{name}.ply").symlink_to(ycb_meshes()[name])
    published = load_ycb()
    assert write_slices(tmp_path) == {}
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    assert {name.split("/")[0] for name in load_ycb("extra")} >= {"006_mustard_bottle"}
    for name, outline in load_ycb().items():
        one, other = outline.polygon, published[name].polygon
        mirrored = shapely.transform(one, lambda p: p * [-1, 1])
        overlap = [p.intersection(other).area / p.union(other).area for p in (one, mirrored)]
        assert max(overlap) > 0.95, name
