"""Records that were edited get one line with the file's name, whatever is wrong with them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tpcd.commands.estimation import _earlier_rows
from tpcd.commands.plausibility import run_warnings
from tpcd.errors import FileError, RunError
from tpcd.records import read_entries
from tpcd.results import resumed_run, run_folder
from tpcd.versions import differing_parts, versions

BAD = {
    "nothing": (b"", "nothing, expected entries"),
    "a list": (b"[1]", "a list, expected entries by name; restore it"),
    "no text": (b"a: \xe4", "not a UTF-8 text file"),
    "cut off": (b"{a: [1,", "not valid YAML at line 1"),
    "a key twice": (b"a: 1\nb: {c: 1, c: 2}\n", "key c appears twice"),
    "too deep": (b"[" * 100_000, "not valid YAML"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_mapping_of_entries_is_one_line(case: str, tmp_path: Path) -> None:
    content, told = BAD[case]
    (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(FileError) as caught:
        read_entries(tmp_path / "config.yaml", "restore it")
    assert told in str(caught.value) and str(tmp_path / "config.yaml") in str(caught.value)


def test_json_too_deep_or_with_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b"[" * 100_000)
    with pytest.raises(FileError, match="is not JSON"):
        read_entries(path, "restore it")
    path.write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert read_entries(path, "restore it") == {"a": 1}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("summary.json", "[]"),
        ("summary.json", '{"fit": null}'),
        ("summary.json", '{"unexplained_rows": [3, 4, 5, 6], "rows": 6}'),
        ("results.json", "[]"),
        ("doubts.json", "{}"),
    ],
)
def test_an_edited_run_is_told_by_the_file_that_is_wrong(
    name: str, content: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(RunError) as caught:
        run_warnings(tmp_path, [])
    assert caught.value.path == tmp_path / name


@pytest.mark.parametrize(
    "steps", [[], [1, 3], [3, 2, 1], [1, 1, 2]], ids=["gone", "left out", "turned", "repeated"]
)
def test_steps_that_are_not_those_of_the_state_are_refused(
    steps: list[int], tmp_path: Path
) -> None:
    path = tmp_path / "steps.jsonl"
    path.write_text("".join(json.dumps({"step": step}) + "\n" for step in steps))
    with pytest.raises(RunError, match="holds other steps than the 3"):
        _earlier_rows(path, 3)
    path.write_text("[1]\n[2]\n[3]\n")
    with pytest.raises(RunError, match="steps.jsonl: cannot be read"):
        _earlier_rows(path, 3)
    path.unlink()
    with pytest.raises(RunError, match="no such file; restore it"):
        _earlier_rows(path, 3)
    assert _earlier_rows(path, 0) == []


@pytest.mark.parametrize("name", ["config.yaml", "versions.json"])
@pytest.mark.parametrize("content", ["", "[1]", "{", "{}"])
def test_a_run_whose_records_were_edited_is_not_gone_on_with(
    name: str, content: str, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    with run_folder(folder, "a command", {"seed": 1}):
        pass
    (folder / name).write_text(content)
    with pytest.raises(FileError) as caught, resumed_run(folder, {"seed": 1}):
        pass
    assert caught.value.path in (folder / name, folder)


def test_a_run_that_goes_on_with_other_versions_says_so_and_keeps_both(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    with run_folder(folder, "a command", {"seed": 1}):
        pass
    with resumed_run(folder, {"seed": 1}):
        pass
    assert capsys.readouterr().err == ""
    recorded = read_entries(folder / "versions.json", "")
    assert differing_parts(recorded, versions()) == []
    recorded["packages"]["torch"] = "0.1"
    (folder / "versions.json").write_text(json.dumps(recorded))
    for told in ("goes on with other versions than before (torch 0.1, now", ""):
        with resumed_run(folder, {"seed": 1}):
            pass
        assert told in capsys.readouterr().err
    now = read_entries(folder / "versions.json", "")
    assert now["packages"]["torch"] == "0.1"
    assert [each["tpcd"] for each in now["gone_on_with"]] == [versions()["tpcd"]]
