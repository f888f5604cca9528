"""The calibration experiment: its tables, its resuming, and data from the likelihood's model."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from linear_model import DIMENSION, LinearModel, LinearTarget
from torch import Tensor

from eval.calibration import Calibration, calibrate, coverage_by_misfit, coverage_table
from eval.conditional import conditional_places
from eval.drawn import draw_episode
from eval.lines import append_lines, read_lines, write_line
from eval.opened import opened_run
from tpcd.belief.belief import misfit_field
from tpcd.belief.history import history_of
from tpcd.belief.likelihood import history_likelihood
from tpcd.belief.prior import make_prior
from tpcd.belief.settings import EstimatorSettings
from tpcd.errors import RunError
from tpcd.parameters import Parameters
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.checkpoint import find_prior
from tpcd.shape.polygon import PolygonShape


def normal_target(precision: Tensor) -> LinearTarget:
    """Standard normal entries, and a likelihood of so much precision about zero."""
    return LinearModel(1).target(1, lambda x: -0.5 * ((x @ precision) * x).sum(-1))


def test_uniform_places_pass_and_narrow_posteriors_fail() -> None:
    generator = np.random.default_rng(0)
    places = np.stack((generator.uniform(size=1000), generator.beta(0.5, 0.5, size=1000)), axis=1)
    good, narrow = coverage_table(places.tolist(), ["good", "narrow"])
    assert good["within_50"] and good["within_90"] and good["p_uniform"] > 0.01
    assert narrow["inside_90"] < narrow["low_90"]
    assert narrow["p_uniform"] < 1e-6


def test_coverage_is_told_by_the_size_of_the_true_misfit() -> None:
    """Of 400 runs those with a large misfit have places at the ends only, and one is small."""
    generator = np.random.default_rng(0)
    places, scores = generator.uniform(size=(400, 9)), generator.uniform(-0.9, 2.0, size=400)
    places[scores > 1] = np.where(places[scores > 1] < 0.5, 0.01, 0.99)
    scores[0] = -3.0
    usual, large = coverage_by_misfit(places.tolist(), scores.tolist())
    assert usual["true_misfit"] == "usual" and large["true_misfit"] == "large"
    assert usual["runs"] + large["runs"] == 399
    assert abs(usual["inside_90"] - 0.9) < 4 * usual["se_90"] < 0.05
    assert abs(usual["inside_50"] - 0.5) < 4 * usual["se_50"] < 0.1
    assert large["inside_90"] == large["inside_50"] == large["se_90"] == 0


def test_places_given_all_other_entries_are_those_of_a_normal_posterior() -> None:
    """Whether an entry is known to 1 or to 0.003 standard deviations of its prior."""
    scale = torch.ones(DIMENSION).double()
    scale[1] = 300.0
    shared = 0.5 * torch.ones(DIMENSION, DIMENSION).double() + torch.eye(DIMENSION)
    added = scale * shared * scale[:, None]
    precision = added + torch.eye(DIMENSION)
    for seed in range(5):
        generator = torch.Generator().manual_seed(seed)
        normal = torch.randn(DIMENSION, generator=generator, dtype=torch.float64)
        truth = torch.linalg.solve(torch.linalg.cholesky(precision).mT, normal)
        # Given all others entry i has the precision P_ii, and (P x)_i = P_ii (x_i - its mean).
        expected = torch.special.ndtr((precision @ truth) / precision.diagonal().sqrt())
        assert (conditional_places(normal_target(added), truth) - expected).abs().max() < 0.01


def test_no_place_where_nothing_explains_the_data() -> None:
    target = normal_target(torch.full((DIMENSION, DIMENSION), torch.nan).double())
    with pytest.raises(ValueError, match="zero at the truth"):
        conditional_places(target, torch.zeros(DIMENSION, dtype=torch.float64))


def test_the_likelihood_is_calibrated_without_a_sampler(tmp_path: Path) -> None:
    out = tmp_path / "likelihood"
    config = Calibration(out=out, runs=6, steps=3, quick=True, estimator="likelihood", misfit=5e-4)
    calibrate(config)
    results = json.loads((out / "results.json").read_text())
    assert results["runs"] == 6 and results["failed"] == 0
    names = [row["parameter"] for row in results["table"]]
    assert names[-1] == "misfit_sd" and len(names) == len(set(names)) > 5
    lines = read_lines(out / "runs.jsonl")
    assert all(0 <= u <= 1 for line in lines for u in line["place"])
    assert np.std([line["place"] for line in lines]) > 0.1


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
    with pytest.raises(RunError, match="whose steps is not the same"):
        calibrate(Calibration(out=out, runs=2, steps=3, quick=True, particles=64))


def test_the_belief_between_moves_is_another_than_the_last_one(tmp_path: Path) -> None:
    """Same truths and data; only the closing draws are left out."""
    small = {"runs": 1, "steps": 2, "quick": True, "particles": 64}
    places = []
    for estimator in ("default", "steps"):
        out = tmp_path / estimator
        calibrate(Calibration(out=out, estimator=estimator, **small))
        places.append(read_lines(out / "runs.jsonl")[0]["place"])
    assert places[0] != places[1]
    assert np.abs(np.subtract(*places)).max() < 0.5


def test_a_run_does_not_go_on_with_a_prior_that_was_trained_again(tmp_path: Path) -> None:
    """Under the same name: its figures would be of both."""
    prior, out = tmp_path / "prior", tmp_path / "run"
    shutil.copytree(find_prior("ycb21-z2"), prior)
    config = Calibration(out=out, runs=1, steps=3, quick=True, prior=str(prior))
    with opened_run(config, "calibrate", ("out", "runs"), resume=False):
        pass
    with opened_run(config, "calibrate", ("out", "runs"), resume=True):
        pass
    shutil.rmtree(prior)
    shutil.copytree(find_prior("ycb-rich"), prior)
    with (
        pytest.raises(RunError, match="goes on with another prior .*name a new folder"),
        opened_run(config, "calibrate", ("out", "runs"), resume=True),
    ):
        pass
