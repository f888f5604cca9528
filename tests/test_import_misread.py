"""Tables and readings that are easily believed, or refused, for a wrong reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_logs import Setting, an_episode, in_space, sampled, write_csv

from tpcd.logs.columns import log_from_columns
from tpcd.logs.importing import Importing, import_log
from tpcd.logs.log import LogError
from tpcd.logs.table import read_columns

MAP = ["time=t", "pose=p", "wrench=w", "command=u"]
STIFFNESS = (100.0, 100.0, 50.0)


def table(gain: float = 1.0) -> dict[str, np.ndarray]:
    space = in_space(sampled(an_episode(12)), Setting())
    columns = {"t": space["time"]}
    blocks = {"p": ("position", "rotation"), "w": ("force", "torque"), "u": ("target", "turned")}
    for name, parts in blocks.items():
        values = np.column_stack([space[part] for part in parts])
        columns.update({f"{name}_{k}": values[:, k] for k in range(values.shape[1])})
    for k in range(3):
        columns[f"w_{k}"] = gain * columns[f"w_{k}"]
    return columns


def imported(path: Path, columns: dict[str, np.ndarray]):
    write_csv(path, columns)
    return import_log(log_from_columns(read_columns(path), MAP, path), Importing(STIFFNESS))


def test_a_table_whose_time_runs_backwards_is_told_to_be_sorted(tmp_path: Path) -> None:
    backwards = {name: values[::-1] for name, values in table().items()}
    with pytest.raises(LogError, match="time runs backwards from row to row; sort the rows"):
        imported(tmp_path / "run.csv", backwards)


def test_a_line_of_names_that_is_one_short_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("a,b,c\n" + "".join(f"{k},{k},{k},{k}\n" for k in range(9)))
    with pytest.raises(LogError, match="3 names, the rows below it have 4 cells"):
        read_columns(path)


def test_samples_too_rare_for_a_row_are_named_and_not_the_holds(tmp_path: Path) -> None:
    rare = {name: values[::10] for name, values in table().items()}
    with pytest.raises(LogError, match="no 0.5 s hold the 8 samples of a row: they come every"):
        imported(tmp_path / "run.csv", rare)


@pytest.mark.parametrize(("gain", "told"), [(1.0, False), (1.3, True)])
def test_forces_that_are_not_the_springs_are_doubted(
    tmp_path: Path, gain: float, told: bool
) -> None:
    doubts = imported(tmp_path / "run.csv", table(gain)).account.doubts
    assert any(each.kind in ("parity", "convention") for each in doubts) == told


@pytest.mark.parametrize("late", [0.3, 0.6])
def test_what_a_late_set_point_spoils_is_told_by_its_delay(tmp_path: Path, late: float) -> None:
    columns, count = table(), round(100 * late)
    for name in [name for name in columns if name.startswith("u_")]:
        columns[name] = np.concatenate((columns[name][:1].repeat(count), columns[name][:-count]))
    with pytest.raises(LogError, match=r"the set point is 0\.\d+ s late .*--delay command=0\.\d"):
        imported(tmp_path / "run.csv", columns)


@pytest.mark.parametrize("digits", ["single precision since 1970", "whole seconds"])
def test_times_of_too_few_digits_are_named(tmp_path: Path, digits: str) -> None:
    columns = table()
    times = columns["t"]
    coarse = (1.76e9 + times).astype(np.float32) if digits[1] == "i" else np.floor(times)
    with pytest.raises(LogError, match="new at the time of the one before: the times have too few"):
        imported(tmp_path / "run.csv", {**columns, "t": coarse.astype(np.float64)})


def test_samples_that_are_written_ten_times_are_read_once(tmp_path: Path) -> None:
    columns = {name: values.repeat(10) for name, values in table().items()}
    assert len(imported(tmp_path / "run.csv", columns).settled.rows) > 10


def test_samples_that_are_mostly_right_are_told_from_their_mean(tmp_path: Path) -> None:
    columns = table()
    struck = np.random.default_rng(4).random(len(columns["t"])) < 0.2
    columns["w_2"] = np.where(struck, columns["w_2"] + 10.0, columns["w_2"])
    doubts = imported(tmp_path / "run.csv", columns).account.doubts
    assert any(each.kind == "spikes" and "F_z in" in each.sentence for each in doubts)


@pytest.mark.parametrize(("column", "name"), [("w_0", "F_x"), ("w_4", "tau")])
def test_a_channel_that_was_not_recorded_is_no_other_convention(
    tmp_path: Path, column: str, name: str
) -> None:
    columns = table()
    columns[column] = np.zeros(len(columns["t"]))
    serious = imported(tmp_path / "run.csv", columns).account.serious
    assert [each.kind for each in serious] == ["dead"] and name in serious[0].sentence


def test_set_points_that_never_rest_are_named_and_no_shorter_window(tmp_path: Path) -> None:
    columns = table()
    columns["u_2"] = columns["u_2"] + 2e-5 * np.random.default_rng(0).standard_normal(
        len(columns["t"])
    )
    with pytest.raises(LogError, match=r"nowhere held, and go 0\.\d+ mm .*; map the set point as"):
        imported(tmp_path / "run.csv", columns)


def test_set_points_of_another_point_are_no_drift(tmp_path: Path) -> None:
    columns = table()
    columns["u_2"] = columns["u_2"] + 8e-3
    (told,) = imported(tmp_path / "run.csv", columns).account.doubts
    assert "off by F_z" in told.sentence and "drift" not in told.sentence
