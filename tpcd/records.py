"""Records in YAML and JSON: what people write by hand, and what runs keep of themselves.

Both may be edited, so what is no text, malformed, or other than what is expected gets one line with
the file's name, and the second of two equal keys never silently wins.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tpcd.errors import FileError, RunError
from tpcd.files import read_json
from tpcd.plain_yaml import read_yaml


def read_entries(path: Path, remedy: str, fault: type[FileError] = RunError) -> dict[str, Any]:
    """Read a file of entries by name, JSON where it is called so, else YAML; raises `FileError`,
    and `fault` where it holds something else."""
    content = read_json(path) if path.suffix == ".json" else read_yaml(path, fault, remedy)
    if not isinstance(content, dict):
        found = "nothing" if content is None else f"a {type(content).__name__}"
        raise fault(path, f"holds {found}, expected entries by name", remedy)
    return content


@contextmanager
def fitting(path: Path, remedy: str) -> Iterator[None]:
    """Take from a record what it should hold: `RunError` with its name where that is not there."""
    try:
        yield
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise RunError(path, f"cannot be read ({error!r})", remedy) from error
