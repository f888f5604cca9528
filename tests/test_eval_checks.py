"""The checks' own check runs small, goes on where it stopped, and its page says what it counted."""

from __future__ import annotations

import json

import pytest

from eval.checks import arms, page, recordings, scenes
from eval.checks.__main__ import RUNS_FILE, Checks, evaluate_checks
from eval.checks.page import page_text, tables_of
from eval.checks.scenes import fit_runs
from tpcd.files import read_json

FAST = ("identification", "conventions", "channels", "delays", "steps")


def rows_of(rows, start):
    return {row["of"]: row for row in rows if row["of"].startswith(start)}


def test_a_small_run_tells_what_the_checks_are_right_in_and_goes_on(tmp_path, monkeypatch, capsys):
    few = {name: recordings.MISTAKES[name] for name in ("sign", "frame")}
    arm = {"world axes, inverted": arms.MOVING["world axes, inverted"]}
    monkeypatch.setattr(arms, "MOVING", arm)
    monkeypatch.setattr(recordings, "SENSORS", recordings.SENSORS[:1])
    monkeypatch.setattr(scenes, "OUTLINES", scenes.OUTLINES[:2])
    monkeypatch.setattr(recordings, "MISTAKES", few)
    monkeypatch.setattr(recordings, "PAIRS", [("sign", "frame")])
    folder = tmp_path / "run"
    evaluate_checks(Checks(out=folder, runs=1, parts=FAST))
    results = read_json(folder / "results.json")
    assert results["runs_of_parts"] == dict.fromkeys(FAST, 1) and results["seeds"] == [110000]
    moving = rows_of(results["table"], "world axes")
    assert len(moving) == 12 and moving["world axes, inverted, stiffness [N/m]"]["told"] == 3
    held = [row["held"] for row in results["table"] if "held" in row]
    told = [row["told"] for row in results["table"] if "held" in row]
    assert sum(held) > 0.85 * sum(told) > 30
    assert [row["told"] for row in results["untold"]] == [0, 0, 0, 0]
    read = {row["of"]: row["told"] for row in results["conventions"]}
    assert read == {"read rightly": 0, "one mistake": 2, "two mistakes": 1}
    channels = rows_of(results["channels"], "steps of 0 sd")
    assert channels["steps of 0 sd, clean"]["told"] == 0
    assert channels["steps of 0 sd, frozen for 40 samples"]["told"] == 1
    told, held = (sum(row.get(of, 0) for row in results["delays"]) for of in ("told", "held"))
    assert sum(row["asked"] for row in results["delays"]) == 14 and held > 0.6 * told > 4
    assert all(row["median"] < 0.03 for row in results["delays"] if "median" in row)
    for row in results["steps"]:
        assert row["good"] > 0.9 * row["steps"] and row["depth"] < 1e-6
    shown = capsys.readouterr().out
    assert page_text(results) in shown and page_text(results) == (folder / "README.md").read_text()

    lines = (folder / RUNS_FILE).read_text().splitlines()
    # The first line again without the rest: only what is missing is made anew.
    changed = json.loads(lines[0]) | {"rows": json.loads(lines[0])["rows"][:1]}
    (folder / RUNS_FILE).write_text(f"{json.dumps(changed)}\n{lines[2]}\n{lines[1][:50]}")
    parts = ("identification", "channels", "steps")
    evaluate_checks(Checks(out=folder, runs=1, parts=parts, resume=True))
    again = read_json(folder / "results.json")
    assert len(again["table"]) == 1 and again["steps"] == results["steps"]
    assert again["channels"] == results["channels"] and "delays" not in again


def test_shares_come_with_exact_intervals_and_published_pages_name_no_place(tmp_path, monkeypatch):
    rows = [{"of": ["a"], "told": k < 9, "held": k < 8 if k < 9 else None} for k in range(10)]
    (row,) = tables_of([{"part": "delays", "rows": rows}])["delays"]
    assert (row["asked"], row["told"], row["held"]) == (10, 9, 8)
    # Beta quantiles (Clopper and Pearson 1934).
    assert row["told, low"] == pytest.approx(0.5550, abs=1e-4)
    assert row["told, high"] == pytest.approx(0.9975, abs=1e-4)
    evaluate_checks(Checks(out=tmp_path / "run", runs=1, parts=("channels",)))
    monkeypatch.setattr(page, "__file__", str(tmp_path / "page.py"))
    page.publish(page.Page(tmp_path / "run"))
    published = (tmp_path / "results.json").read_text()
    assert str(tmp_path) not in published and "channels" in published
    assert "frozen for 40" in (tmp_path / "README.md").read_text()


def test_the_page_is_made_of_the_results_beside_it():
    folder = page.Path(page.__file__).parent
    results = read_json(folder / "results.json")
    assert (folder / "README.md").read_text(encoding="utf-8") == page_text(results)


@pytest.mark.slow
def test_a_belief_tells_other_scenes_from_its_own():
    told = {row["of"][0]: row["told"] for row in fit_runs(70000)}
    assert not told["its own scene"] and told["floor 10 mm higher"] and len(told) == 6


def test_a_part_that_is_none_is_refused():
    with pytest.raises(ValueError, match="part is 'arms', expected one of identification"):
        Checks(parts=("arms",))
