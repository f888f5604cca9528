"""What was measured and does not fit a belief is told, by predict and by the run that learnt it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_calls import call, make_world

from tpcd.belief.storage import load_belief
from tpcd.commands.prediction import predict_rows
from tpcd.commands.unexplained import (
    FEW_INSIDE,
    Fit,
    fit_of,
    fit_sentence,
    fit_to,
    other_scene_warning,
    unknown_object_warning,
)
from tpcd.data import read_episode
from tpcd.data.files import write_episode
from tpcd.predict import ContactPredictor


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an exploration, a test episode, and the run that learnt from the first."""
    return make_world(tmp_path_factory.mktemp("world"))


def test_the_share_of_readings_in_their_intervals_is_counted(world: Path) -> None:
    belief, episode = load_belief(world / "run"), read_episode(world / "explore.csv")
    predicted = predict_rows(ContactPredictor(belief), episode)
    rows = torch.cat((episode.poses, episode.wrenches), -1)[1:]
    within = (rows > predicted.low) & (rows < predicted.high)
    fit = fit_of(predicted, episode)
    assert fit.inside == pytest.approx(float(within.double().mean()), abs=0.02)
    nothing = replace(predicted, mean=predicted.mean * torch.nan)
    assert fit_of(nothing, episode).inside == 0.0
    assert len(fit_of(nothing, episode).unexplained) == fit.rows


@pytest.mark.parametrize(
    ("fit", "told"),
    [
        (Fit(30, 0.9, []), None),
        (Fit(30, FEW_INSIDE - 0.01, []), "49% of the readings"),
        (Fit(2, 0.1, []), None),
        (Fit(30, 0.8, [{"row": 7, "channel": "z", "deviations": 31.0}] * 6), "(row 7: z by 31)"),
        (Fit(30, 0.8, [{"row": 7, "channel": None, "deviations": None}] * 6), "6 of 30 rows"),
        (Fit(30, 0.8, [{"row": 7, "channel": "z", "deviations": 31.0}] * 2), None),
    ],
)
def test_a_recording_of_another_scene_is_told_by_share_and_by_distance(
    fit: Fit, told: str | None
) -> None:
    said = other_scene_warning(fit)
    assert said is None if told is None else told in str(said)


def test_predict_tells_a_recording_of_another_scene_from_one_of_its_own(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = read_episode(world / "explore.csv")
    elsewhere = replace(episode, poses=episode.poses.clone(), commands=episode.commands.clone())
    elsewhere.poses[:, 1] += 0.008  # the floor is 8 mm higher there
    elsewhere.commands[:, 1] += 0.008
    write_episode(elsewhere, tmp_path / "elsewhere.csv")
    for name, options in (("a", ()), ("b", ("--of", "true")), ("c", ("--rollout",))):
        for path in (world / "explore.csv", tmp_path / "elsewhere.csv"):
            out = str(tmp_path / f"{name}-{path.stem}.csv")
            call("predict", str(world / "run"), str(path), "--out", out, *options)
            said = "what was measured does not fit the belief" in capsys.readouterr().err
            assert said == (path.stem == "elsewhere")


def test_a_run_keeps_its_fit(world: Path) -> None:
    belief, episode = load_belief(world / "run"), read_episode(world / "explore.csv")
    summary = json.loads((world / "run" / "summary.json").read_text())
    assert summary["readings_in_90"] == fit_to(belief, episode).inside
    assert summary["unknown_object"] is None


def test_an_outline_beyond_the_prior_and_the_noise_is_told(world: Path) -> None:
    belief = load_belief(world / "run")
    noise = torch.tensor([2e-4, 2e-4, 5e-4], dtype=torch.float64)
    for misfit, told in ((3e-4, False), (5.9e-4, False), (6.1e-4, True), (3e-3, True)):
        one = replace(belief, misfit_sd=torch.full_like(belief.misfit_sd, misfit))
        assert (unknown_object_warning(one, noise) is not None) == told
        assert f"by {1e3 * misfit:.2g} mm" in fit_sentence(Fit(15, 0.9, []), one)
    exact = replace(belief, misfit=replace(belief.misfit, sd=0.0))
    assert unknown_object_warning(exact, noise) is None
    assert "outline" not in fit_sentence(Fit(15, 0.9, []), exact)


def test_predict_repeats_that_the_prior_does_not_know_the_object(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:

    run = tmp_path / "run"
    shutil.copytree(world / "run", run)
    summary = json.loads((run / "summary.json").read_text())
    summary["unknown_object"] = "the prior does not know this object: 3 mm"
    (run / "summary.json").write_text(json.dumps(summary))
    call("predict", str(run), str(world / "explore.csv"), "--out", str(tmp_path / "p.csv"))
    assert "the prior does not know this object: 3 mm" in capsys.readouterr().err
