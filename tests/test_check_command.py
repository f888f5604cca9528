"""scripts/check.py on any recording: its verdict, its exit code, and the page it leaves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_calls import load_script
from made_logs import Setting, an_episode, write_csv
from made_streams import POSE, WRENCH, frozen, made_stream
from matplotlib.image import imread
from test_import_command import importing

from tpcd.cli import run
from tpcd.data import read_episode, write_episode
from tpcd.figures.recording import MOMENTS, envelope
from tpcd.quality.stream import Stream

CLEAN = made_stream(setting=Setting())


def checking(*words: str) -> int:
    """Run the command in this process; its exit code."""
    module = load_script("check")
    with pytest.raises(SystemExit) as stopped:
        run(
            module.check_recording,
            module.Check,
            list(words),
            positional=("recording",),
            prog="check",
        )
    return int(stopped.value.code or 0)


def table(stream: Stream, path: Path, leave_out: tuple[str, ...] = ()) -> Path:
    """A CSV of a stream with its times."""
    columns = {"t": stream.times, **dict(zip(stream.channels, stream.values.T, strict=True))}
    return write_csv(path, {n: c for n, c in columns.items() if n not in leave_out})


def found(out: Path) -> dict:
    return json.loads((out / "check.json").read_text())


def test_a_clean_recording_is_usable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert checking(str(table(CLEAN, tmp_path / "run.csv")), "--out", str(out)) == 0
    printed = capsys.readouterr().out
    assert "usable: nothing is wrong with its samples" in printed and "clocks" in printed
    told = found(out)
    assert told["exit_code"] == 0 and told["usable_share"] == 1.0
    assert all(each["weight"] == "note" for each in told["findings"])
    noise = {each["name"]: each["sample"] for each in told["noise"]}
    assert noise["F_z"] == pytest.approx(0.2, rel=0.2)
    # The stiffness shows in w against x - u, whatever is touched.
    stiffness = {q["name"]: q for q in told["quantities"]}["stiffness_z"]
    assert stiffness["interval"][0] < 100.0 < stiffness["interval"][1]
    assert (out / "check.txt").read_text() in printed
    page = (out / "check.html").read_text()
    assert page.count("data:image/png;base64,") == 4 and "<script" not in page
    for name in ("pose", "rotation", "wrench", "clocks"):
        assert imread(out / "figures" / f"{name}.png").shape[0] > 200
    assert json.loads((out / "results.json").read_text())["table"] == told["channels"]


def test_a_frozen_sensor_is_named_on_every_page_and_left_out_of_the_import(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = table(frozen(CLEAN, WRENCH, 2000, 2400), tmp_path / "run.csv")
    out = tmp_path / "out"
    assert checking(str(path), "--out", str(out)) == 4
    told = "frozen from 20 to 23.99 s (400 samples, rows 2000 to 2399)"
    assert told in capsys.readouterr().out and told in (out / "check.html").read_text()
    entries = ["time=t", *(f"{n}={n}" for n in CLEAN.channels)]
    # These streams have no rotation of the set point, which is a serious doubt of its own.
    words = (str(path), "--map", *entries, "--stiffness", "100", "100", "50", "--accept_doubts")
    assert importing(*words, "--out", str(tmp_path / "imported")) == 4
    assert "frozen from 20 to 23.99 s" in capsys.readouterr().out
    whole = table(CLEAN, tmp_path / "whole.csv")
    assert importing(str(whole), *words[1:], "--out", str(tmp_path / "all")) == 4
    kept = read_episode(tmp_path / "imported").extra["time_s"]
    every = read_episode(tmp_path / "all").extra["time_s"]
    lost = np.setdiff1d(every.round(3), kept.round(3))
    # Every row whose half second lies in the frozen stretch is gone, and no other.
    assert len(lost) > 1 and lost.min() > 19.9 and lost.max() < 24.6
    assert not ((kept > 20.5) & (kept < 23.9)).any()


def test_millimetres_without_their_unit_are_not_usable(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = CLEAN.values.copy()
    values[:, :3] = 1e3 * values[:, :3] + 500.0
    path = table(replace(CLEAN, values=values), tmp_path / "run.csv", ("u_x", "u_y", "u_z"))
    entries = ["time=t", *(f"{n}={n}" for n in (*POSE, *WRENCH))]
    assert checking(str(path), "--map", *entries, "--out", str(tmp_path / "out")) == 5
    printed = capsys.readouterr().out
    assert "not usable as it is read" in printed and "looks like millimetres" in printed
    assert "=COLUMN:mm" in printed
    # What the numbers suggest reads them rightly.
    assert checking(str(path), "--out", str(tmp_path / "suggested")) == 0
    assert "x=x:mm" in capsys.readouterr().out


def test_a_recording_that_is_mostly_frozen_is_not_usable(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = table(frozen(CLEAN, WRENCH, 2000, 5510), tmp_path / "run.csv")
    assert checking(str(path), "--out", str(tmp_path / "out")) == 5
    assert "64% of the samples are left out (1 frozen)" in capsys.readouterr().out


def test_a_recording_without_wrench_or_without_places_is_checked_as_far_as_it_goes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    posed = table(CLEAN, tmp_path / "pose.csv", WRENCH)
    assert checking(str(posed), "--out", str(tmp_path / "pose")) == 4
    assert "F_x, F_z not in the map" in capsys.readouterr().out
    assert {row["channel"] for row in found(tmp_path / "pose")["channels"]} == {
        *("x", "y", "z", "rotation")
    }
    turned = table(CLEAN, tmp_path / "turned.csv", ("x", "y", "z", "u_x", "u_y", "u_z"))
    assert checking(str(turned), "--out", str(tmp_path / "turned")) == 0
    assert "no positions were recorded" in capsys.readouterr().out
    channels = {row["channel"] for row in found(tmp_path / "turned")["channels"]}
    assert channels == {"rotation", *WRENCH}


def test_an_episode_is_checked_row_by_row(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = an_episode(15)
    write_episode(episode, tmp_path / "clean")
    assert checking(str(tmp_path / "clean.csv"), "--out", str(tmp_path / "out")) == 0
    assert "nothing is wrong with its rows" in capsys.readouterr().out
    wrenches = episode.wrenches.clone()
    wrenches[6:12, 1] = wrenches[6, 1]
    write_episode(replace(episode, wrenches=wrenches), tmp_path / "frozen")
    assert checking(str(tmp_path / "frozen"), "--out", str(tmp_path / "again")) == 4
    assert "rows 6 to 11: F_z exactly" in capsys.readouterr().out


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nameless = write_csv(tmp_path / "a.csv", {"a": CLEAN.times, "b": CLEAN.times})
    for words, told in (
        ((str(tmp_path / "none.csv"),), "no such file"),
        ((str(nameless),), "no column is named as a pose or a wrench"),
        ((str(nameless), "--topics", "pose=/p"), "topics are for bags"),
        ((str(nameless), "--stiffness", "1", "2"), "expected 3 or 6"),
        ((str(nameless), "--map", "x=c"), "no column 'c'"),
    ):
        assert checking(*words, "--out", str(tmp_path / "out")) == 2
        error = capsys.readouterr().err
        assert told in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_exit_codes_are_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert checking("--help") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "0 where it is usable, 4 where it is with samples left out" in told
    assert "5 where it is not usable" in told and "2 where it cannot be read" in told


def test_a_single_sample_shows_in_a_million() -> None:
    times, values = np.arange(1e6), np.zeros(1_000_000)
    values[123_456], values[777] = 5.0, np.nan
    middle, low, high = envelope(times, values)
    assert len(middle) <= MOMENTS and high.max() == 5.0 and low.min() == 0.0
    assert abs(middle[np.argmax(high)] - 123_456) <= len(values) / MOMENTS + 1
