"""The benchmark of choosing a command runs small, and says what it timed and ranked."""

from __future__ import annotations

from pathlib import Path

from eval.bench.gain import Benchmark, benchmark
from tpcd.files import read_json


def test_the_quick_run_times_choices_and_compares_rankings(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    benchmark(
        Benchmark(
            out=folder,
            quick=True,
            threads=1,
            repeats=1,
            commands=(27, 54),
            candidates=32,
            reference_draws=4,
            reference_particles=500,
        )  # fmt: skip
    )
    results = read_json(folder / "results.json")
    rows = results["table"]
    assert [row["particles"] for row in rows if row["curve"] == "particles"] == [100, 200]
    assert [row["commands"] for row in rows if row["curve"] == "commands"] == [27, 54]
    assert all(row["wall_s"] > 0 for row in rows)
    ranking = {row["particles"]: row for row in results["ranking"]}
    assert ranking[100]["beliefs"] == 4
    assert ranking[100]["spearman"] >= 0.95
    assert ranking[100]["regret"] <= 0.01
    for name in ("gain_by_particles", "gain_by_commands"):
        assert (folder / "figures" / f"{name}.png").stat().st_size > 5000
