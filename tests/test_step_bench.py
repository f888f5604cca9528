"""The benchmark of the filter step runs small, and says what it timed."""

from __future__ import annotations

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from eval.bench.figures import step_seconds
from eval.bench.step import Benchmark, benchmark, fastest
from tpcd.files import read_json


def test_the_quick_run_times_every_part_and_draws_the_curve(tmp_path, capsys):
    folder = tmp_path / "run"
    benchmark(Benchmark(out=folder, quick=True, threads=1))
    printed = capsys.readouterr().out
    results = read_json(folder / "results.json")
    rows = results["table"]
    parts = [row["part"] for row in rows]
    for name in ("shape", "weights", "filter step", "QP, 16 rows, one solve"):
        assert name in parts and name in printed
    assert all(0 < row["wall_s"] < 60 and row["cpu_s"] > 0 for row in rows)
    (whole, *_), pieces = [r for r in rows if r["part"] == "filter step"], rows[:3]
    assert whole["particles"] == 200 and whole["transitions"] == 1000
    assert max(row["wall_s"] for row in pieces) < 3 * whole["wall_s"]
    assert [row["particles"] for row in rows if row.get("curve")] == [100, 200]
    solved = [row["solved"] for row in rows if "solved" in row]
    assert solved and min(solved) > 0.9
    assert results["config"]["memory"] == 5 and results["seeds"] == [0]
    assert {"hardware", "packages"} <= results["versions"].keys()
    for name in ("step_seconds", "part_seconds"):
        assert (folder / "figures" / f"{name}.png").stat().st_size > 5000
    log = EventAccumulator(str(folder / "tensorboard")).Reload()
    assert [event.step for event in log.Scalars("filter_step_by_particles/wall_s")] == [100, 200]
    assert [event.step for event in log.Scalars("f_theta_by_outline_points/cpu_s")] == [16, 64]
    assert sorted(log.Tags()["images"]) == ["figures/part_seconds", "figures/step_seconds"]


def test_the_fastest_run_counts_and_the_first_does_not():
    calls = []
    times = fastest(lambda: calls.append(1), 3, synchronise=False)
    assert len(calls) == 4
    assert 0 <= times["wall_s"] < 1


def test_the_target_is_drawn_where_the_curve_reaches_it():
    rows = [
        {"particles": m, "transitions": 5 * m, "wall_s": m / 1e5, "cpu_s": m / 5e4}
        for m in (1000, 5000)
    ]
    labels = [
        text.get_text()
        for target in ((5000, 0.15), (9000, 0.15))
        for text in step_seconds(rows, target).legends[0].get_texts()
    ]
    assert sum("target" in label for label in labels) == 1
    assert "wall time" in labels


@pytest.mark.parametrize(
    "wrong", [{"particles": 0}, {"curve_particles": (5, -1)}, {"curve_points": ()}, {"seed": -1}]
)
def test_sizes_of_nothing_are_refused(wrong):
    with pytest.raises(ValueError, match="expected"):
        Benchmark(**wrong)
