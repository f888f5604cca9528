"""YAML is read as it is written, by every door."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tpcd.cli import parse
from tpcd.data.header import read_header
from tpcd.errors import EpisodeError, FileError
from tpcd.plain_yaml import parse_yaml, read_yaml, to_yaml

words = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=6)
plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | words
    | st.sampled_from(["0100", "1:30", "1e-3", "on", "0x10", "1_000", "2026-01-01", "<<", "~"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
)


@settings(max_examples=50)
@given(plain)
def test_what_is_written_is_read_alike_by_either_kind_of_yaml(content) -> None:
    assert parse_yaml(to_yaml(content)) == content == yaml.safe_load(to_yaml(content))


@pytest.mark.parametrize(
    ("text", "value"),
    [("0.5", 0.5), ("1e-3", 1e-3), (".5", 0.5), ("-2.E+1", -20.0), ("+5", 5), ("0", 0), ("~", None)]
    + [(word, word) for word in ("0100", "1:30", "1:30.5", "on", "No", "0x10", "1_000", "2026-1-1")]
    + [("true", True), ("False", False), ("-.inf", -float("inf"))],
)
def test_scalars_are_what_they_look_like(text: str, value: object) -> None:
    found = parse_yaml(f"a: {text}")["a"]
    assert found == value and type(found) is type(value)


def test_a_file_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    for content, told in (
        (b"a: 1\nb: 2\na: 3\n", "key a appears twice"),
        (b"a: [1\nb: : 2\n", "not valid YAML at line 2"),
        (b"a: \xff", "not a UTF-8 text file"),
        (None, "no such file"),
    ):
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(FileError, match=told):
            read_yaml(path)


@dataclass(frozen=True)
class Made:
    """Settings of a made-up command."""

    size: float = 0.0
    """A number."""
    count: int = 0
    """A whole number."""
    loud: bool = False
    """A truth value."""
    name: str = ""
    """A text."""


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("size: 0100", Made(size=100.0)),
        ("count: 0100", Made(count=100)),
        ("size: 1e-3", Made(size=1e-3)),
        ("name: on", Made(name="on")),
        ("name: 0100", Made(name="0100")),
        ("size: 1:30", "size: found '1:30', expected a finite number"),
        ("count: '1:30'", "count: found '1:30', expected a whole number"),
        ("loud: on", "found 'on', expected true or false"),
        ("name: 1.10", "name: found '1.1', expected text, in quotes where"),
        ("size: 1\nsize: 2", "key size appears twice"),
    ],
)
def test_settings_of_a_file_are_what_is_written(text: str, expected, tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    arguments = ["--config", str(path)]
    if isinstance(expected, Made):
        assert parse(Made, arguments) == expected
        return
    with pytest.raises((ValueError, FileError)) as caught:
        parse(Made, arguments)
    assert expected in str(caught.value)


def test_numbers_of_a_command_line_are_decimal() -> None:
    assert parse(Made, ["--size", "0100", "--count", "010", "--name", "1:30"]) == Made(
        100.0, 10, name="1:30"
    )
    with pytest.raises(ValueError, match="size: found '1:30', expected a finite number"):
        parse(Made, ["--size", "1:30"])


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("stiffness: [0100, '100', 1e2]", (100.0, 100.0, 100.0)),
        ("stiffness: [1:30, 100, 50]", "stiffness: found '1:30', expected a finite number"),
        ("stiffness: [0x64, 100, 50]", "stiffness: found '0x64'"),
        ("stiffness: [100, 1_00, 50]", "stiffness: found '1_00'"),
        ("stiffness: [100, 100, 50]\nunusual: on", "unusual is 'on', expected true or false"),
        ("stiffness: [100, 100, 50]\nobject: 1.10", "object: found 1.1, expected text"),
    ],
)
def test_an_episode_is_read_as_it_is_written(line: str, expected, tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(f"{line}\nnotes: 2026-01-01\n")
    if isinstance(expected, tuple):
        header = read_header(path)
        assert header.stiffness == expected and header.notes == "2026-01-01"
        return
    with pytest.raises(EpisodeError) as caught:
        read_header(path)
    assert expected in str(caught.value)
