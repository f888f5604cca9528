"""What a user reads when a command line is wrong, in place of the parser's own words.

A message says which setting it is about, what was found, what is expected, and, where a
name was misspelt, which one was probably meant.
"""

from __future__ import annotations

import difflib
import errno
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from tpcd.errors import FileError

KINDS = {"int": "a whole number", "float": "a finite number", "bool": "true or false",
         "str": "text, in quotes where it looks like a number"}  # fmt: skip
REMEDIES = {
    errno.EACCES: "choose a place where you may read and write",
    errno.EPERM: "choose a place where you may read and write",
    errno.EROFS: "choose a place where you may write",
    errno.ENOENT: "check the path",
    errno.ENOSPC: "free some space",
    errno.EDQUOT: "free some space of your quota",
    errno.EFBIG: "raise the limit on the size of files",
    errno.EIO: "check the disk",
    errno.ENOTDIR: "a file stands where a folder is needed",
    errno.ENAMETOOLONG: "choose a shorter name",
}


def parsing_problem(message: str, names: Iterable[str]) -> str:
    """The parser's message in plain words; `names` are the settings that exist."""
    message = " ".join(message.split())
    names = list(names)
    if found := re.match(r'Parser key "([\w.]+)"( element \d+)?: (.*)', message):
        return f"{found[1]}: {_wrong_value(found[3])}"
    if found := re.match(r"Value not boolean: (.*)\.$", message):
        return f"found {found[1]!r}, expected true or false"
    if found := re.match(r"the following arguments are required: (.*)", message):
        missing = [name if name.startswith("-") else f"--{name}" for name in found[1].split(", ")]
        return f"{' and '.join(missing)} missing"
    if found := re.match(r"unrecognized arguments: (\S+)", message):
        name = found[1].partition("=")[0]
        if not name.startswith("--"):
            return f"{name}: one argument too many"
        return f"unknown option {name}{_meant(name.lstrip('-'), names, '--')}"
    if found := re.match(r"Option '([\w.]+)' is not accepted", message):
        return f"unknown setting {found[1]!r} in the configuration{_meant(found[1], names)}"
    return message


def system_problem(error: OSError) -> str:
    """An error of the operating system with the file in front and what to do behind."""
    if error.strerror is None:
        return " ".join(str(error).split()) or type(error).__name__
    remedy, file = REMEDIES.get(error.errno or 0), file_of(error)
    front = "" if file is None else f"{file}: "
    return f"{front}{error.strerror}" + (f"; {remedy}" if remedy else "")


def file_of(error: OSError) -> str | None:
    """The file that an error of the operating system is about, where it is known.

    What closes the files of a full disk fails once more, without a name: the first error counts.
    """
    file, cause = error.filename, error.__context__
    while file is None and isinstance(cause, OSError) and cause.errno == error.errno:
        file, cause = cause.filename, cause.__context__
    return os.fsdecode(file) if isinstance(file, (str, bytes, os.PathLike)) else None


def check_config_files(paths: Sequence[str]) -> None:
    """Refuse a configuration that is missing or no mapping of settings, by `FileError`."""
    from tpcd.records import read_entries

    for name in paths:
        read_entries(
            Path(name), "give a YAML file of settings such as config.yaml of a run", FileError
        )


def _wrong_value(problem: str) -> str:
    value = re.search(r"(?:Got|Given) value: (.*)$", problem)
    if value is None:
        return problem
    if literal := re.search(r"Literal\[(.*?)\]", problem):
        expected = f"one of {literal[1]}"
    else:
        named = re.findall(r"Expected an? <class '(\w+)'>", problem)
        kinds: dict[str, None] = dict.fromkeys(named)
        kinds.pop("NoneType", None)
        expected = " or ".join(KINDS.get(kind, kind) for kind in kinds) or "another value"
    return f"found {value[1]!r}, expected {expected}"


def _meant(name: str, names: Sequence[str], prefix: str = "") -> str:
    close = difflib.get_close_matches(name.replace("-", "_"), names, 1, 0.6)
    return f"; did you mean {prefix}{close[0]}?" if close else ""
