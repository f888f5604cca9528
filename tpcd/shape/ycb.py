"""Outlines of the YCB objects, read from a folder that is not part of this repository.

The folder holds `slices.npz` (one main outline per object) and may hold `slices_extra.npz`
(side and top views, keys `<object>/side`), each array (n, 2) float64 [m], and `meshes/`.
`scripts/fetch_ycb.py` makes such a folder from the meshes the set's own site offers. The
environment variable `TPCD_YCB` names it; without it, `../shared/ycb` beside the repository
is taken where it exists.

Source of the set: B. Calli et al., "Benchmarking in Manipulation Research: The YCB Object
and Model Set and Benchmarking Protocols", IEEE Robotics and Automation Magazine 2015; CC BY 4.0.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from tpcd.errors import FileError
from tpcd.shape.outline import Outline
from tpcd.shape.sources import load_slices

FOLDER_VARIABLE = "TPCD_YCB"
REMEDY = f"run scripts/fetch_ycb.py and set {FOLDER_VARIABLE} to the folder it made"

GRASPABLE_21 = (
    "002_master_chef_can",
    "003_cracker_box",
    "004_sugar_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "007_tuna_fish_can",
    "008_pudding_box",
    "009_gelatin_box",
    "010_potted_meat_can",
    "011_banana",
    "019_pitcher_base",
    "021_bleach_cleanser",
    "024_bowl",
    "025_mug",
    "035_power_drill",
    "036_wood_block",
    "037_scissors",
    "040_large_marker",
    "051_large_clamp",
    "052_extra_large_clamp",
    "061_foam_brick",
)
"""The 21 objects of YCB-Video, a published selection of graspable YCB objects: Y. Xiang,
T. Schmidt, V. Narayanan, D. Fox, "PoseCNN", Robotics: Science and Systems 2018."""


def ycb_folder() -> Path | None:
    """The folder with the YCB outlines, or None where there is none on this machine.

    Raises:
        FileError: `TPCD_YCB` is set but names no folder.
    """
    named = os.environ.get(FOLDER_VARIABLE)
    if named:
        folder = Path(named).expanduser()
        if not folder.is_dir():
            raise FileError(folder, f"the folder {FOLDER_VARIABLE} names does not exist", REMEDY)
        return folder
    beside = Path(__file__).resolve().parents[2].parent / "shared" / "ycb"
    return beside if beside.is_dir() else None


def load_ycb(which: Literal["main", "extra", "all"] = "main") -> dict[str, Outline]:
    """YCB outlines by name, such as `006_mustard_bottle` or, of the extra views, `006_.../side`.

    Raises:
        FileError: there is no YCB folder, or it lacks the file.
        OutlineError: a file there is not what it should be.
    """
    if which not in ("main", "extra", "all"):
        raise ValueError(f"which must be 'main', 'extra' or 'all', got {which!r}")
    folder = ycb_folder()
    if folder is None:
        raise FileError("YCB outlines", "no such folder on this machine", REMEDY)
    files = {"main": ["slices.npz"], "extra": ["slices_extra.npz"]}
    outlines: dict[str, Outline] = {}
    for name in files["main"] + files["extra"] if which == "all" else files[which]:
        path = folder / name
        if not path.is_file():
            raise FileError(path, "not found", REMEDY)
        outlines.update(load_slices(path))
    return outlines


def ycb_meshes() -> dict[str, Path]:
    """Paths of the YCB meshes (`.ply`) by object name; empty where there are none."""
    folder = ycb_folder()
    return {} if folder is None else {p.stem: p for p in sorted(folder.glob("meshes/*.ply"))}
