"""The calibration experiment: its tables, its resuming, and data from the likelihood's model."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from eval.calibration import Calibration, calibrate, coverage_table
from eval.drawn import draw_episode
from eval.lines import append_lines, read_lines, write_line
from tpcd.belief.belief import misfit_field
from tpcd.belief.history import history_of
from tpcd.belief.likelihood import history_likelihood
from tpcd.belief.prior import make_prior
from tpcd.belief.settings import EstimatorSettings
from tpcd.errors import RunError
from tpcd.parameters import Parameters
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape


def test_uniform_places_pass_and_narrow_posteriors_fail() -> None:
    generator = np.random.default_rng(0)
    places = np.stack((generator.uniform(size=1000), generator.beta(0.5, 0.5, size=1000)), axis=1)
    good, narrow = coverage_table(places.tolist(), ["good", "narrow"])
    assert good["within_50"] and good["within_90"] and good["p_uniform"] > 0.01
    assert narrow["inside_90"] < narrow["low_90"]
    assert narrow["p_uniform"] < 1e-6


def test_a_cut_off_last_line_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "runs.jsonl"
    assert read_lines(path) == []
    path.write_text('{"seed": 3, "place": [0.5]}\n{"seed": 4, "pl')
    assert [line["seed"] for line in read_lines(path)] == [3]
    with append_lines(path) as file:
        write_line(file, {"seed": 4})
        write_line(file, {"seed": 5})
    assert [line["seed"] for line in read_lines(path)] == [3, 4, 5]


def test_drawn_data_are_likelier_under_the_truth_than_under_another_floor() -> None:
    """The truth is likelier than a floor 6 mm higher in at least 5 of 6 episodes."""
    prior = make_prior(PolygonShape(builtin_outlines()["mug"]))
    settings = EstimatorSettings(misfit_sd=1e-3)
    field = misfit_field(prior.shape, settings)
    wins = 0
    for seed in range(6):
        generator = torch.Generator().manual_seed(seed)
        truth, episode = draw_episode(prior, settings, 6, generator)
        vector, misfit_sd = truth[:-1], truth[-1:]
        moved = vector.clone()
        moved[-2] += 0.006
        found = history_likelihood(
            prior.shape,
            Parameters.from_vector(torch.stack((vector, moved))),
            misfit_sd.expand(2),
            history_of(episode),
            field,
            settings.step,
        )
        assert torch.isfinite(found.total[0])
        wins += int(found.total[0] > found.total[1])
    assert wins >= 5


def test_a_run_can_be_continued_but_not_with_other_settings(tmp_path: Path) -> None:
    out = tmp_path / "calibration"
    small = {"steps": 2, "quick": True, "particles": 64}
    calibrate(Calibration(out=out, runs=1, **small))
    first = (out / "runs.jsonl").read_text()
    calibrate(Calibration(out=out, runs=2, **small))
    lines = (out / "runs.jsonl").read_text()
    assert lines.startswith(first)
    assert [json.loads(line)["seed"] for line in lines.splitlines()] == [0, 1]
    results = json.loads((out / "results.json").read_text())
    assert results["runs"] == 2
    assert {"inside_50", "inside_90", "p_uniform"} <= set(results["table"][0])
    assert (out / "figures" / "ranks.png").is_file()
    with pytest.raises(RunError, match="another steps"):
        calibrate(Calibration(out=out, runs=2, steps=3, quick=True, particles=64))
