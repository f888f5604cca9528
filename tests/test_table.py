"""The experiment table: statistics on made-up cells, and a quick run with its files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from eval.table.__main__ import KEY, Table, make_table, plan, read_cells
from eval.table.cells import top_particles
from eval.table.summary import Row, bootstrap, compare, curve_rows, curves, summarise
from tpcd.belief import EstimatorSettings, SamplerSettings
from tpcd.belief.belief import prior_belief
from tpcd.errors import FileError
from tpcd.shape.checkpoint import load_prior
from tpcd.shape.ycb import ycb_folder


def cell(name: str, seed: int, policy: str, error: float) -> Row:
    """A cell whose every channel is off by `error` after two moves and by ten times as much
    after one."""
    return {
        "truth": "mujoco", "object": name, "seed": seed, "estimator": "default", "policy": policy,
        "moves": [1, 2], "mae": [[10 * error] * 6, [error] * 6], "sd": [[0.0] * 6, [error] * 6],
        "peak_wrench": [10 * error] * 3, "coverage_50": [0.1, 0.5], "coverage_90": [0.2, 0.9],
        "contact_90": [0.3, 0.8], "choosing_s": 1.0, "learning_s": 2.0,
        "contact_transform": [[0.5] * 6],
        "open_mae": [[10 * error] * 6, [2 * error] * 6], "closing_s": 3.0,
    }  # fmt: skip


CELLS = [
    cell(name, seed, policy, factor * size)
    for policy, factor in (("active", 1.0), ("random", 4.0))
    for name, size in (("mug", 1e-3), ("can", 3e-3))
    for seed in (0, 1)
]


def test_the_table_holds_means_over_cells_in_readable_units() -> None:
    active, random = summarise(CELLS)
    assert (active["row"], random["row"]) == ("default / active", "default / random")
    assert active["x_mm"] == pytest.approx(2.0) and active["F_x_N"] == pytest.approx(2e-3)
    assert active["force_of_peak"] == pytest.approx(0.1)
    assert (active["coverage_50"], active["coverage_90"], active["contact_90"]) == (0.5, 0.9, 0.8)
    # Two objects: the bootstrap draws one of them twice in half of the cases.
    assert active["xz_low"] == pytest.approx(1.0) and active["xz_high"] == pytest.approx(3.0)


def test_pairs_are_compared_over_common_cells_only() -> None:
    (line,) = compare(CELLS, "default / active", "default / random")
    assert line["pairs"] == 4
    assert line["x, z"] == pytest.approx(0.25) and line["x, z 90 %"] == "0.25-0.25"
    (line,) = compare(CELLS[:-1], "default / active", "default / random")
    assert line["pairs"] == 3
    assert compare(CELLS, "default / active", "paper / grid") == []


def test_cells_with_other_decoded_outlines_are_no_pairs() -> None:
    decoded = [{**row, "truth": "decoded", "prior": row["policy"]} for row in CELLS]
    assert compare(decoded, "default / active", "default / random") == []
    same = [{**row, "prior": "ycb21-z2"} for row in decoded]
    assert compare(same, "default / active", "default / random")[0]["pairs"] == 4


def test_an_unknown_object_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    if ycb_folder() is None:
        return
    with pytest.raises(ValueError, match="object is 'teapot'"):
        make_table(Table(out=tmp_path / "table", objects=("teapot",)))
    assert not (tmp_path / "table").exists()


def test_curves_follow_the_moves() -> None:
    moves, errors = curves(CELLS, "mujoco")["default / random"]
    assert moves.tolist() == [1, 2]
    np.testing.assert_allclose(errors, [80.0, 16.0])
    (row,) = (r for r in curve_rows(CELLS) if r["row"] == "default / random")
    assert row["truth"] == "mujoco" and [row["1"], row["2"]] == pytest.approx([80.0, 16.0])


def test_bootstrap_draws_whole_objects() -> None:
    values = np.repeat([0.0, 1.0], 50)
    low, high = bootstrap(values, ["a"] * 50 + ["b"] * 50, np.mean)
    assert (low, high) == (0.0, 1.0)
    low, high = bootstrap(values, [str(i) for i in range(100)], np.mean)
    assert 0.4 < low < 0.45 < 0.55 < high < 0.6


def test_the_top_particles_are_those_of_the_largest_weights() -> None:
    from tpcd.robot.simulated import SimulatedRobot
    from tpcd.shape.builtin import builtin_outlines
    from tpcd.truth.make import make_truth
    from tpcd.truth.scene import draw_scene

    generator = torch.Generator().manual_seed(0)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    episode = SimulatedRobot(make_truth(scene, "quasistatic"), scene, 0).start()
    settings = EstimatorSettings(sampler=SamplerSettings(particles=50))
    belief = prior_belief(episode, load_prior("ycb21-z2"), generator, settings)
    weights = torch.arange(50, dtype=torch.float64)
    top = top_particles(replace(belief, weights=weights / weights.sum()), 10)
    torch.testing.assert_close(top.vectors, belief.vectors[40:].flip(0))
    torch.testing.assert_close(top.weights, weights[40:].flip(0) / weights[40:].sum())


@pytest.mark.parametrize(
    "wrong",
    [{"truths": ("real",)}, {"rows": ("ours/active",)}, {"workers": 0}, {"rows": ("paper",)}],
)
def test_bad_settings_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="expected|at least"):
        Table(**wrong)


def test_the_quick_table_scores_every_cell_and_goes_on_after_a_stop(tmp_path: Path) -> None:
    config = Table(out=tmp_path / "table", quick=True)
    if ycb_folder() is None:
        with pytest.raises(FileError, match="fetch_ycb"):
            make_table(config)
        return
    make_table(config)
    results = json.loads((config.out / "results.json").read_text())
    rows = {row["row"]: row for row in results["table"]}
    assert set(rows) == {"default / active", "default / random", "paper / random"}
    for row in rows.values():
        assert row["cells"] == 2 and 0 < row["x_mm"] < 30 and 0 <= row["coverage_90"] <= 1
    # After four moves the paper's filter, made for errors of centimetres, is far behind.
    assert rows["default / active"]["x_mm"] < rows["paper / random"]["x_mm"]
    assert results["comparisons"][0]["pairs"] == 2
    learnt = {row["row"]: row for row in results["curves"]}
    assert set(learnt) == set(rows) and set(learnt["default / active"]) >= {"1", "2", "3", "4"}
    for name in ("quasistatic-curves", "quasistatic-objects"):
        assert (config.out / "figures" / f"{name}.png").stat().st_size > 5000
    keys = {tuple(row[name] for name in KEY) for row in read_cells(config.out)}
    assert keys == {one.key for one in plan(config)}
    path = config.out / "cells-0.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-1]) + lines[-1][:50])
    make_table(replace(config, resume=True))
    again = json.loads((config.out / "results.json").read_text())
    for before, after in zip(results["table"], again["table"], strict=True):
        timed = ("choosing_s", "learning_s", "closing_s")
        assert {k: v for k, v in before.items() if k not in timed} == {
            k: v for k, v in after.items() if k not in timed
        }
