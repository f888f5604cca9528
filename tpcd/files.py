"""Text and JSON files, written in one move, and plain values of what goes into them.

Files are written under a temporary name and moved into place, so that none is ever half there, and
a disk that is full is told with the file's name. JSON has no NaN: such a value is stored as null
and its place listed under `non_finite`. Nothing heavy is imported here.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tpcd.errors import FileError


@contextmanager
def named(path: str | Path) -> Iterator[None]:
    """Give the file's name to an error of the system that has none, as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def staged(path: Path) -> Iterator[Path]:
    """A temporary file to write in place of `path`, which it replaces once the body is done.

    The folder is made if needed. Errors of the system name `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with named(path):
            yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename == str(temporary):
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> Path:
    """Write a file in UTF-8 in one move; its folder is made if needed."""
    return write_bytes(path, text.encode("utf-8", "surrogateescape"))


def write_bytes(path: Path, content: bytes) -> Path:
    """Write a file in one move; its folder is made if needed."""
    with staged(path) as temporary:
        temporary.write_bytes(content)
    return path


def write_json(path: str | Path, content: Any) -> Path:
    """Write JSON in one move; NaN and infinities become null, listed under `non_finite`."""
    flagged: list[str] = []
    plain = to_plain(content, flagged=flagged)
    if flagged and isinstance(plain, dict):
        plain["non_finite"] = flagged
    elif flagged:
        raise ValueError(f"{path}: not finite at {', '.join(flagged)}; wrap it in a mapping")
    text = json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False)
    return write_text(Path(path), text + "\n")


def read_json(path: str | Path) -> Any:
    """Read a JSON file; raises `FileError` when it is missing or malformed."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise FileError(path, "does not exist") from None
    except (ValueError, RecursionError) as error:
        raise FileError(path, f"is not JSON ({error})") from error


def to_plain(value: Any, *, flagged: list[str] | None = None, place: str = "") -> Any:
    """Turn dataclasses, mappings, sequences, paths, arrays and tensors into plain values.

    What has a `to_plain` of its own is asked for it.
    With a list `flagged`, numbers that are not finite become None and their place
    (`table[0].error`) is appended to it.
    """
    own = getattr(value, "to_plain", None)
    if callable(own) and not isinstance(value, type):
        value = own()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        dot = "." if place else ""
        return {
            str(key): to_plain(entry, flagged=flagged, place=f"{place}{dot}{key}")
            for key, entry in value.items()
        }
    to_list = getattr(value, "tolist", None)
    if to_list is not None:  # arrays, tensors and their scalars
        value = to_list()
    if isinstance(value, (list, tuple, set, frozenset)):
        entries = sorted(value) if isinstance(value, (set, frozenset)) else value
        return [
            to_plain(entry, flagged=flagged, place=f"{place}[{i}]")
            for i, entry in enumerate(entries)
        ]
    if isinstance(value, float) and not math.isfinite(value) and flagged is not None:
        flagged.append(place)
        return None
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{place or 'value'}: cannot store a {type(value).__name__}")
