"""What does not fit a belief is told with its figures, what fits is not: recordings of another
scene, and objects that the prior does not know."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_calls import PRIOR, call, make_world
from scipy.stats import binom
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.belief.storage import load_belief, save_belief
from tpcd.commands.fit import (
    LARGE_MISFIT,
    fit_of,
    foreign_warning,
    learnt_fit,
    unknown_warning,
)
from tpcd.commands.plausibility import run_warnings
from tpcd.commands.prediction import PredictedRows
from tpcd.data import read_episode, write_episode
from tpcd.files import read_json
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, read_truth, record
from tpcd.truth.scene import draw_scene

NOISE = torch.tensor([2e-4, 2e-4, 5e-4, 0.3, 0.3, 0.02], dtype=torch.float64)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exploration, a test episode of the same scene, and the run that learnt from the first."""
    return make_world(tmp_path_factory.mktemp("world"))


def predicted(rows: Tensor, mean: Tensor, std: Tensor) -> PredictedRows:
    """Normal predictions of some rows."""
    std = std.expand_as(rows)
    transform = torch.special.ndtr((rows - mean) / std)
    return PredictedRows(mean, std, mean - 1.645 * std, mean + 1.645 * std, transform)


@pytest.mark.parametrize("count", [3, 15, 60, 300])
def test_readings_that_are_as_predicted_are_not_told_of_once_in_a_hundred(count):
    """Also where the three readings of pose and wrench err wholly together."""
    generator = torch.Generator().manual_seed(count)
    std, told = 2.0 * NOISE, 0
    for _ in range(300):
        error = torch.randn(count, 3, generator=generator, dtype=torch.float64).repeat(1, 2)
        rows = std * error
        told += foreign_warning(fit_of(predicted(rows, 0 * rows, std), rows, NOISE)) is not None
    assert told <= 3


def test_the_figures_of_a_fit_are_those_of_the_rows():
    rows = torch.zeros(40, 6, dtype=torch.float64)
    mean = rows.clone()
    mean[:10, :2] = 5e-3
    found = fit_of(predicted(rows, mean, NOISE), rows, NOISE)
    assert found["in_90"] == pytest.approx(1 - 20 / 240)
    assert found["error_mm"] == pytest.approx(1.25) and found["noise_mm"] == pytest.approx(0.2)
    assert found["predicted_sd_mm"] == pytest.approx(0.2)
    assert found["error_over_sd"] == pytest.approx((20 * 25**2 / 240) ** 0.5)
    assert found["in_90_least"] <= float(binom.ppf(1e-3, 40, 0.9)) / 40
    assert found["beyond"] == 10 and not found["fits"]
    few = fit_of(predicted(rows[5:], mean[5:], NOISE), rows[5:], NOISE)
    assert few["beyond"] == 5 and few["fits"] and foreign_warning(few) is None
    far = fit_of(predicted(rows, mean + 20 * NOISE, NOISE), rows, NOISE)
    assert not far["fits"]
    told = str(foreign_warning(far))
    assert "0% of the readings lie in their 90 % intervals" in told and "\n" not in told


def test_what_no_particle_answers_does_not_fit():
    rows = torch.zeros(4, 6, dtype=torch.float64)
    lost = predicted(rows, rows, NOISE * torch.nan)
    assert "no particle" in str(foreign_warning(fit_of(lost, rows, NOISE)))


def test_a_recording_of_another_scene_is_told_with_its_figures_and_one_of_the_same_is_not(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = read_truth(world / "test")[1]
    generator = torch.Generator().manual_seed(5)
    higher = draw_scene(
        "jam_jar",
        scene.outline_vertices.numpy(),
        generator,
        fixed={**scene.theta, "floor_height": scene.floor_height + 0.01},
    )
    motion = make_motion("test", higher, 20, generator)
    other = record(make_truth(higher, "quasistatic"), higher, motion, 20, generator)
    path = write_episode(other.measured, tmp_path / "other")
    for recording, foreign in ((world / "test.csv", False), (path, True)):
        for more in ((), ("--rollout",), ("--of", "true")):
            target = tmp_path / f"{recording.stem}{len(more)}.csv"
            arguments = (str(world / "run"), str(recording), "--out", str(target))
            assert call("predict", *arguments, *more, "--overwrite") == 0
            shown = capsys.readouterr()
            assert "of the readings lie in their 90 % intervals" in shown.out
            assert ("does not fit this belief" in shown.err) is foreign
            results = read_json(target.with_name(f"{target.name}.json"))
            assert results["fits"][0]["fits"] is not foreign
            assert (results["warnings"][0] is not None) is foreign
            assert len(results["scores"]) == 6
    # Of several it is the one that is foreign, wherever it stands.
    for order in ((world / "test.csv", path), (path, world / "test.csv", world / "explore.csv")):
        target = tmp_path / f"several{len(order)}.csv"
        named = map(str, order)
        assert call("predict", str(world / "run"), *named, "--out", str(target)) == 0
        shown = capsys.readouterr().err
        lines = [line for line in shown.splitlines() if "does not fit this belief" in line]
        assert len(lines) == 1 and lines[0].startswith("warning: other.csv: ")
        results = read_json(target.with_name(f"{target.name}.json"))
        assert [fit["fits"] for fit in results["fits"]] == [one != path for one in order]
        assert [told is None for told in results["warnings"]] == [one != path for one in order]


def with_misfit(belief: Belief, misfit: float) -> Belief:
    return replace(belief, misfit_sd=torch.full_like(belief.misfit_sd, misfit))


def test_an_object_that_needs_another_outline_than_any_of_the_prior_is_told(world: Path):
    belief, episode = load_belief(world / "run"), read_episode(world / "explore.csv")
    found = learnt_fit(episode, belief)
    assert found["known"] and found["fits"] and unknown_warning(found) is None
    assert found["misfit_usual_mm"] <= 1e3 * LARGE_MISFIT
    usual = 1e-3 * found["misfit_usual_mm"]
    assert learnt_fit(episode, with_misfit(belief, 0.9 * usual))["known"]
    told = str(unknown_warning(learnt_fit(episode, with_misfit(belief, 2 * usual))))
    assert "the prior does not know this object" in told
    assert f"{2e3 * usual:.2g} mm" in told and "\n" not in told


def test_later_commands_repeat_that_the_prior_does_not_know_the_object(
    world: Path, tmp_path: Path
) -> None:
    belief, episode = load_belief(world / "run"), read_episode(world / "explore.csv")
    save_belief(belief, tmp_path, PRIOR)
    summary = json.loads((world / "run" / "summary.json").read_text(encoding="utf-8"))
    assert summary["fit"]["known"] and not run_warnings(world / "run", [])
    summary["fit"] = learnt_fit(episode, with_misfit(belief, 0.02))
    (tmp_path / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    (told,) = run_warnings(tmp_path, [])
    assert "the prior does not know this object" in told and str(tmp_path) in told
