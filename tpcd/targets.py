"""Files and folders that are to be written, looked at before the work begins."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from tpcd.errors import RunError

ELSEWHERE = "name a place where you may write"


def check_target(
    path: str | Path, overwrite: bool = False, inputs: Sequence[str | Path] = ()
) -> None:
    """Refuse a file that could not be written in the end, before the work begins.

    Raises `RunError` where it exists and `overwrite` is false, is a folder or one of the `inputs`,
    or lies where nothing can be written.
    """
    path = Path(path)
    if any(Path(name).resolve() == path.resolve() for name in inputs):
        raise RunError(path, "is what the command reads", "choose another name")
    if path.is_dir():
        raise RunError(path, "is a folder", "name a file")
    if path.exists() and not overwrite:
        raise RunError(path, "exists already", "choose another name or pass --overwrite")
    check_place(path.parent)


def check_folder(path: str | Path, overwrite: bool = False) -> None:
    """Refuse a folder that could not be written in the end, before the work begins.

    Raises `RunError` where it is a file, holds something and `overwrite` is false, or lies where
    nothing can be written.
    """
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise RunError(folder, "is a file", "name a folder")
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise RunError(folder, "is not empty", "name a new folder or pass --overwrite")
    check_place(folder)


def check_place(folder: Path) -> None:
    """Refuse a folder that neither is one to write to nor can be made."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not there.is_dir():
        raise RunError(folder, f"cannot be made: {there} is a file", "name another folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise RunError(folder, f"cannot be written: no permission in {there}", ELSEWHERE)
