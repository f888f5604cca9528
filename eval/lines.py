"""Results kept line by line as JSON, so that a run that was stopped loses the last one at most."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TextIO

from tpcd.files import named


def read_lines(path: Path) -> list[dict[str, Any]]:
    """All whole lines of a file, none where it does not exist."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        try:
            found.append(json.loads(line))
        except ValueError:  # cut off when the run was stopped
            continue
    return found


def append_lines(path: Path) -> TextIO:
    """The file opened for further lines, after what was cut off, if anything was."""
    file = path.open("a+", encoding="utf-8")
    if file.tell():
        file.seek(file.tell() - 1)
        if file.read(1) != "\n":
            file.write("\n")
    return file


def write_line(file: TextIO, row: dict[str, Any]) -> None:
    """One more line, at once."""
    with named(file.name):
        file.write(json.dumps(row) + "\n")
        file.flush()
