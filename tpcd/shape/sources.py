"""Outlines from files: slices (`.npz`), polygons (`.csv`), drawings (`.svg`), meshes.

`load_outlines` looks at the file's ending. Whatever the file holds, what comes back has been
checked by `make_outline`: simple, counter-clockwise, centred, in metres.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from tpcd.errors import OutlineError
from tpcd.shape.outline import Outline, make_outline


def load_slices(path: str | Path) -> dict[str, Outline]:
    """Outlines of an `.npz` file: one array (n, 2) [m] per outline, the key is its name.

    Nothing is unpickled.

    Raises:
        OutlineError: missing, not an `.npz` file, empty, or an array that is no outline.
    """
    path = Path(path)
    if not path.is_file():
        raise OutlineError(path, "not found", "give an .npz file of (n, 2) arrays")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            slices = {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise OutlineError(
            path, f"not a readable .npz file ({reason})", "expected (n, 2) float arrays by name"
        ) from None
    if not slices:
        raise OutlineError(path, "holds no arrays", "expected one (n, 2) array per outline")
    return {
        name: make_outline(name, points, path=path, source=path.name)
        for name, points in slices.items()
    }
