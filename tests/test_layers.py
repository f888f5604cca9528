"""Imports go one way: rooms take from those below them, and no modules import in a circle."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RUNTIME = (
    "errors text numerals random parameters loops terrain files plain_yaml planar threads targets"
    " versions cli_messages console records ownership contract cli results"
)
"""Modules that know nothing of the problem, or only its units and names; they carry all rooms."""
LAYERS = (
    RUNTIME,
    "geometry qp shape quality figures",
    "contact data",
    "simulator logs",
    "effects identification",
    "belief truth",
    "prediction",
    "predict",
    "information robot",
    "policies discrepancy",
    "exploration",
    "commands compile_ahead",
)
"""Rooms and single modules of tpcd, from the lowest layer up; each takes from those below it."""


def imported(tree: ast.AST) -> Iterator[str]:
    """Names that run-time imports name, whether they are modules or not."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            continue
        if isinstance(node, ast.Import):
            yield from (each.name for each in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{each.name}" for each in node.names)
        yield from imported(node)


@cache
def graph() -> dict[str, set[str]]:
    """Module to those that it imports, of all packages of the project."""
    files = [path for room in ("tpcd", "eval", "training") for path in (ROOT / room).rglob("*.py")]
    names = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in files
    }
    found = {}
    for module, path in names.items():
        taken = set()
        for name in imported(ast.parse(path.read_text(encoding="utf-8"))):
            while name and name not in names:
                name = name.rpartition(".")[0]
            taken |= {name} - {"", "tpcd", module}
        # A package's own file gathers what its modules define.
        found[module] = {name for name in taken if not name.startswith(f"{module}.")}
    return found


def test_no_modules_import_in_a_circle() -> None:
    try:
        TopologicalSorter(graph()).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_rooms_take_from_lower_layers_only() -> None:
    layer = {room: k for k, rooms in enumerate(LAYERS) for room in rooms.split()}
    wrong = []
    for module, taken in graph().items():
        package, _, rest = module.partition(".")
        room = rest.partition(".")[0]
        for name in taken if package == "tpcd" else ():
            other = name.split(".")[1] if name.startswith("tpcd.") else None
            beside = room == other or room in RUNTIME.split() and other in RUNTIME.split()
            if other is None or not beside and layer[other] >= layer[room]:
                wrong.append(f"{module} takes {name}")
    assert wrong == []
