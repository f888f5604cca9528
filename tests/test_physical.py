"""The physical protocol through the emulator, in small."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_calls import PRIOR
from robot_bench import free_address

from eval.physical import Physical, evaluate_physical
from eval.physical_sessions import ORIGIN, WALL_BASE
from tpcd.data.files import read_episode


def test_every_object_has_its_tiles() -> None:
    with pytest.raises(ValueError, match="tiles has 1 numbers, expected one for each of the 2"):
        Physical(objects=("025_mug", "014_lemon"), tiles=(2.0,))


@pytest.mark.slow
def test_one_object_in_small(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rtde_control")
    config = Physical(
        tmp_path / "run", ("mug",), (4.0,), steps=4, test_steps=3, diagnosis_steps=0,
        prior=PRIOR, address=free_address(),
    )  # fmt: skip
    evaluate_physical(config)
    assert "paper, Real" in capsys.readouterr().out
    results = json.loads((config.out / "results.json").read_text())
    assert "emulated" in results["kind"]
    assert (config.out / "figures" / "errors.png").stat().st_size > 5000
    assert len(list((config.out / "tensorboard").glob("events*"))) == 1
    rows = {row["estimator"]: row for row in results["table"] if row["object"] == "mug, emulated"}
    assert set(rows) == {"paper's filter", "ours, rigid tiles"}
    assert all(0 < row["x_mm"] < 50 for row in rows.values())
    expert, test = (read_episode(config.out / "mug" / f"{n}.csv") for n in ("expert", "test"))
    assert len(expert) == 5 and len(test) == 4
    assert expert.sensor_std.tolist() == test.sensor_std.tolist()
    start = (expert.poses[0] - test.poses[0]).abs()
    assert float(start[:2].max()) < 1e-3
    assert test.priors["wall_position"] == pytest.approx(
        (ORIGIN[0] - WALL_BASE[1], ORIGIN[0] - WALL_BASE[0])
    )
