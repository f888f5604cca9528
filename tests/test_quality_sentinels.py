"""Numbers that stand for no reading are named with their rows and left out; readings are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_logs import STIFFNESS, Setting, an_episode, in_space, sampled, write_csv

from tpcd.logs.columns import log_from_columns
from tpcd.logs.importing import Importing, import_log
from tpcd.logs.table import read_columns
from tpcd.quality.sentinels import find_sentinels

FLOAT, DOUBLE = float(np.finfo(np.float32).max), np.finfo(np.float64).max
SENTINELS = (FLOAT, -FLOAT, DOUBLE, -999.0, 999.9, 9999.0, -99999.0, 1e30, 65535.0, -(2.0**31))
FORCE = 3.0 * np.sin(np.arange(2000) / 100) + np.random.default_rng(0).normal(0, 0.2, 2000)


@pytest.mark.parametrize("number", SENTINELS)
@pytest.mark.parametrize("rows", [[700], [10, 11, 12, 900], range(500, 1500)])
def test_a_sentinel_is_found_in_its_rows(number: float, rows) -> None:
    values = FORCE.copy()
    values[list(rows)] = number
    ((found, marked),) = find_sentinels(values).items()
    assert found == number and np.flatnonzero(marked).tolist() == list(rows)


def test_two_sentinels_are_both_found_and_positions_in_millimetres_have_them_too() -> None:
    values = 400.0 + 1e2 * FORCE
    values[[5, 6]], values[[800]] = -999.0, 9999.0
    assert {number: int(m.sum()) for number, m in find_sentinels(values).items()} == {
        -999.0: 2,
        9999.0: 1,
    }


@pytest.mark.parametrize(
    "values",
    [
        FORCE,
        np.clip(500 * FORCE, -999.0, 999.0),
        np.clip(5e3 * FORCE, -9999.0, 9999.0).round(),
        np.linspace(990.0, 999.0, 500),
        np.repeat([998.0, 999.0, 997.0], 300),
        np.full(500, -999.0),
        np.where(np.arange(2000) < 900, FORCE, 5.0 + FORCE),
        np.append(FORCE, 8000.0),
    ],
    ids=["force", "clipped", "counts", "ramp", "steps", "constant", "step", "spike"],
)
def test_readings_are_no_sentinels(values) -> None:
    assert find_sentinels(np.asarray(values)) == {}


@pytest.mark.parametrize("number", [FLOAT, -999.0, 9999.0])
def test_an_import_names_them_and_makes_the_same_rows(tmp_path: Path, number: float) -> None:
    space = in_space(sampled(an_episode(8)), Setting())
    columns = {"t": space["time"]}
    blocks = {"p": ("position", "rotation"), "w": ("force", "torque"), "u": ("target", "turned")}
    for name, parts in blocks.items():
        values = np.column_stack([space[part] for part in parts])
        columns.update({f"{name}_{k}": values[:, k] for k in range(values.shape[1])})

    def imported(wrong: float | None):
        written = {name: values.copy() for name, values in columns.items()}
        if wrong is not None:
            written["w_2"][[600, 601, 900]] = wrong
        path = write_csv(tmp_path / "run.csv", written)
        entries = ["time=t", "pose=p", "wrench=w", "command=u"]
        return import_log(log_from_columns(read_columns(path), entries, path), Importing(STIFFNESS))

    found, right = imported(number), imported(None)
    told = [line for line in found.account.findings if "stands for no reading" in line]
    assert len(told) == 1 and "F_z: 3 of" in told[0] and "rows 600 to 601, 900" in told[0]
    assert found.account.doubts == right.account.doubts
    assert found.settled.rows == pytest.approx(right.settled.rows, abs=0.1)
