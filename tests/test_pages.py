"""Pages of the project name what is there: files, layers, links."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from test_layers import LAYERS, ROOT

ROOMS = sorted(path.parent for path in (ROOT / "tpcd").glob("*/__init__.py"))
PAGES = sorted((ROOT / "tpcd").glob("*/README.md"))
ARCHITECTURE = ROOT / "docs" / "architecture.md"


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.name)
def test_a_room_has_a_page(room: Path) -> None:
    assert (room / "README.md").is_file()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_a_page_that_lists_files_lists_those_that_are_there(page: Path) -> None:
    """A page with a column of files names all of its room, and no other."""
    text = page.read_text(encoding="utf-8")
    named = set(re.findall(r"`(\w+\.py)`", text))
    there = {path.name for path in page.parent.glob("*.py")} - {"__init__.py"}
    assert "| file |" not in text or named == there


def test_the_picture_of_the_architecture_is_that_of_the_imports() -> None:
    picture = ARCHITECTURE.read_text(encoding="utf-8").split("```")[1]
    drawn = [set(re.split(r"\s{3,}", line)[0].split()) for line in picture.strip().splitlines()]
    rooms = [set(layer.split()) - {"compile_ahead"} for layer in LAYERS[1:]]
    assert drawn == rooms[::-1]


@pytest.mark.parametrize(
    "page", [ARCHITECTURE, ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES], ids=str
)
def test_links_within_the_project_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if "://" not in target:
            assert (page.parent / target).exists(), target


def test_files_that_the_architecture_names_are_there() -> None:
    """`room/file.py`, or `file.py` of a room named in the same row."""
    rows = ARCHITECTURE.read_text(encoding="utf-8").splitlines()
    missing = []
    for row in rows:
        paths = re.findall(r"`((?:\w+/)*\w+\.py)`", row)
        rooms = [ROOT, ROOT / "tpcd", *((ROOT / name).parent for name in paths)]
        rooms += [ROOT / "tpcd" / room.name for room in ROOMS if f"tpcd/{room.name}" in row]
        missing += [name for name in paths if not any((room / name).is_file() for room in rooms)]
    assert missing == []
