"""YAML as it is written: one reader and one writer of the project's files.

YAML 1.1 reads `0100` as 64, `1:30` as 90, `1e-3` as text and `on` as true. Here numbers are decimal
and only true and false are truth values; everything else is text, and so is what has leading
zeros, since it may be a name. What is written is read alike by either kind.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from tpcd.errors import FileError

_TAG = "tag:yaml.org,2002:"
_KINDS = (
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("int", r"[-+]?(0|[1-9][0-9]*)", "-+0123456789"),
    (
        "float",
        r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?[0-9]+[eE][-+]?[0-9]+"
        r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
    ("merge", "<<", "<"),
)


class RepeatedKeyError(yaml.YAMLError):
    """A key that a mapping holds twice."""


class PlainLoader(yaml.SafeLoader):
    """Reads numbers as they are written, and refuses the second of two equal keys."""

    yaml_implicit_resolvers: dict[str, list[Any]] = {}

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        repeated = [key for key in keys if keys.count(key) > 1]
        if repeated:
            raise RepeatedKeyError(repeated[0])
        return super().construct_mapping(node, deep)


class _QuotingDumper(yaml.SafeDumper):
    """Puts text in quotes that either kind of YAML would read as something else."""


for _kind, _pattern, _first in _KINDS:
    for _class in (PlainLoader, _QuotingDumper):
        _class.add_implicit_resolver(_TAG + _kind, re.compile(f"(?:{_pattern})$"), list(_first))


def parse_yaml(text: str | bytes) -> Any:
    """What a text says; raises `yaml.YAMLError`."""
    return yaml.load(text, PlainLoader)


def read_yaml(path: Path, error: type[FileError] = FileError, remedy: str = "") -> Any:
    """What a file says; raises `error` in one line for one that is missing or no YAML."""
    try:
        return parse_yaml(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as cause:
        raise error(path, "no such file", remedy) from cause
    except OSError as cause:
        raise error(path, f"cannot be read ({cause.strerror})", remedy) from cause
    except UnicodeDecodeError as cause:
        raise error(path, "not a UTF-8 text file", "save it in UTF-8") from cause
    except RepeatedKeyError as cause:
        raise error(path, f"key {cause} appears twice", "remove one of them") from cause
    except (yaml.YAMLError, ValueError, RecursionError) as cause:
        mark = getattr(cause, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        raise error(path, f"not valid YAML{where}", "correct it by hand") from cause


def to_yaml(content: Any, flow: bool = False) -> str:
    """Plain values as YAML, in the order in which they stand; `flow` keeps lists of numbers in a
    line."""
    return yaml.dump(
        content,
        Dumper=_QuotingDumper,
        sort_keys=False,
        allow_unicode=True,
        default_flow_style=None if flow else False,
    )
