"""The commands from end to end, as a user runs them."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_calls import PRIOR, call, make_world

from tpcd.belief.storage import load_belief
from tpcd.commands.drawing import central_outline
from tpcd.commands.unexplained import unexplained_rows, unexplained_warning
from tpcd.data import read_episode, write_episode
from tpcd.data.table import read_table
from tpcd.predict import ContactPredictor
from tpcd.prediction import Prediction


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an exploration, a test episode, and the run that learnt from the first."""
    return make_world(tmp_path_factory.mktemp("world"))


def test_rows_that_a_belief_does_not_explain_are_found(
    world: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    belief, episode = load_belief(world / "run"), read_episode(world / "explore.csv")
    assert unexplained_rows(episode, belief) == []
    assert json.loads((world / "run" / "summary.json").read_text())["unexplained_rows"] == []
    last = len(episode) - 1
    poses = episode.poses.clone()
    poses[last, 1] += 0.01
    (found,) = unexplained_rows(replace(episode, poses=poses), belief)
    assert (found["row"], found["channel"]) == (last, "z") and found["deviations"] > 20
    assert unexplained_warning([found], last) is None
    # What no particle has an answer to is not explained either.
    predict = ContactPredictor.predict

    def unanswered(*arguments: Any, **settings: Any) -> Prediction:
        answer = predict(*arguments, **settings)
        answered = answer.answered.clone()
        answered[2:5] = False
        weights = torch.where(answered, answer.weights, torch.nan)
        return replace(answer, answered=answered, weights=weights)

    monkeypatch.setattr(ContactPredictor, "predict", unanswered)
    rows = unexplained_rows(episode, belief)
    assert [(row["row"], row["deviations"]) for row in rows] == [(3, None), (4, None), (5, None)]
    assert f"3 of {last} rows" in str(unexplained_warning(rows, last))


def test_many_rows_that_are_not_explained_are_told(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = read_episode(world / "explore.csv")
    poses = episode.poses.clone()
    poses[2::2, 1] -= 0.05  # The wrench says otherwise.
    path = write_episode(replace(episode, poses=poses), tmp_path / "moved")
    settings = ("--prior", PRIOR, "--particles", "100", "--out", str(tmp_path / "run"))
    assert call("estimate", str(path), *settings) == 0
    told = capsys.readouterr().err
    assert f"of {len(episode) - 1} rows lie more than 5" in told and "diagnose.py" in told
    rows = json.loads((tmp_path / "run" / "summary.json").read_text())["unexplained_rows"]
    assert {row["row"] for row in rows} >= {2, 4, 6}
    arguments = (str(tmp_path / "run"), str(world / "test.csv"), "--out", str(tmp_path / "p.csv"))
    call("predict", *arguments)
    assert "of what it was learnt from" in capsys.readouterr().err


def test_a_start_inside_of_what_later_rows_press_on_is_refused(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = read_episode(world / "explore.csv")
    poses, commands = episode.poses.clone(), episode.commands.clone()
    poses[0, 1] -= 0.08
    commands[0, 1] -= 0.08
    path = write_episode(replace(episode, poses=poses, commands=commands), tmp_path / "low")
    assert call("estimate", str(path), "--prior", PRIOR, "--out", str(tmp_path / "run")) == 2
    told = capsys.readouterr().err
    assert "row 0" in told and "mm inside the floor" in told
    assert not (tmp_path / "run").exists()


def test_an_estimate_leaves_a_complete_run(world: Path) -> None:
    run = world / "run"
    summary = json.loads((run / "summary.json").read_text())
    entries = summary["parameters"]
    assert set(entries) >= {"latent_0", "scale", "mount_x", "friction", "floor_height"}
    floor = entries["floor_height"]
    assert floor["unit"] == "m"
    assert floor["interval_90"][0] <= floor["mean"] <= floor["interval_90"][1]
    assert entries["floor_height"]["still_the_prior"] is False
    for name in ("estimation", "outline", "scene"):
        assert (run / "figures" / f"{name}.png").stat().st_size > 5000
    assert any((run / "tensorboard").iterdir())
    assert (run / "config.yaml").is_file() and (run / "versions.json").is_file()
    rows = [json.loads(line) for line in (run / "steps.jsonl").read_text().splitlines()]
    assert ["closed" in row for row in rows] == [False] * 5 + [True]


def test_a_belief_comes_back_as_it_was_saved(world: Path) -> None:
    belief = load_belief(world / "run")
    assert belief.vectors.dtype == torch.float64
    assert float(belief.weights.sum()) == pytest.approx(1.0)
    again = json.loads((world / "run" / "summary.json").read_text())["parameters"]
    means = dict(zip(belief.prior.names, belief.mean().tolist(), strict=True))
    for name, entry in again.items():
        assert means[name] == pytest.approx(entry["mean"])


def test_the_floor_under_an_unknown_object_is_found(world: Path) -> None:
    import yaml

    truth = yaml.safe_load((world / "explore.truth.yaml").read_text())["theta"]
    entries = json.loads((world / "run" / "summary.json").read_text())["parameters"]
    floor = entries["floor_height"]
    assert abs(floor["mean"] - truth["floor_height"]) < 6 * floor["std"] + 1e-3


@pytest.mark.parametrize(
    "options", [(), ("--rollout",), ("--of", "true"), ("--rollout", "--of", "true")], ids=str
)
def test_predictions_have_a_row_for_each_step(
    world: Path, tmp_path: Path, options: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "predictions.csv"
    arguments = (str(world / "run"), str(world / "test.csv"), "--out", str(out), *options)
    assert call("predict", *arguments) == 0
    rows = list(csv.DictReader(out.open()))
    episode = read_episode(world / "test.csv")
    assert [int(row["step"]) for row in rows] == list(range(1, len(episode)))
    for name in ("x", "z", "phi", "F_x", "F_z", "tau"):
        for row in rows:
            assert float(row[f"{name}_q05"]) <= float(row[f"{name}_q95"])
            assert float(row[f"{name}_sd"]) > 0
    printed = capsys.readouterr().out
    assert "coverage_90" in printed and "mae" in printed


def test_predictions_of_what_is_true_are_compared_with_the_truth_where_it_is_known(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for suffix in ("csv", "yaml"):
        shutil.copy(world / f"test.{suffix}", tmp_path / f"bare.{suffix}")

    def told(episode: Path, of: str) -> tuple[str, float]:
        out = ("--out", str(tmp_path / "p.csv"), "--overwrite")
        assert call("predict", str(world / "run"), str(episode), "--of", of, *out) == 0
        printed = capsys.readouterr().out
        (force,) = [line.split() for line in printed.splitlines() if line.startswith("F_x")]
        return printed, float(force[2])

    truly, error = told(world / "test.csv", "true")
    assert "against the rows without noise" in truly and "noisy rows" not in truly
    bare, noisy = told(tmp_path / "bare.csv", "true")
    assert "against the rows as measured" in bare and "noisy rows" in bare
    measured, same = told(world / "test.csv", "measured")
    assert "against the rows as measured" in measured and "noisy rows" not in measured
    assert same == noisy > 0.1
    assert error < 0.5 * noisy


def test_predictions_are_a_table_of_the_kind_that_is_named(world: Path, tmp_path: Path) -> None:
    episodes = (str(world / "test.csv"), str(world / "explore.csv"))
    tables = {}
    for suffix in ("csv", "parquet"):
        out = tmp_path / f"p.{suffix}"
        assert call("predict", str(world / "run"), *episodes, "--out", str(out)) == 0
        tables[suffix] = read_table(out, ("episode", "step", "x_mean", "tau_q95"))
    assert list(tables["csv"]) == list(tables["parquet"])
    for name, column in tables["csv"].items():
        assert column.tolist() == tables["parquet"][name].tolist()
    lengths = [len(read_episode(path)) - 1 for path in episodes]
    assert np.bincount(tables["csv"]["episode"].astype(int)).tolist() == lengths
    assert tables["csv"]["step"].tolist() == [k + 1 for n in lengths for k in range(n)]


def test_predictions_of_a_stopped_run_or_an_inverted_sensor_are_warned_of(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(world / "run", tmp_path / "run")
    episode = read_episode(world / "explore.csv")
    write_episode(replace(episode, wrenches=-episode.wrenches), tmp_path / "upside_down.csv")

    def told(file: Path, out: str) -> str:
        call("predict", str(tmp_path / "run"), str(file), "--out", str(tmp_path / out))
        return capsys.readouterr().err

    assert "warning" not in told(world / "test.csv", "whole.csv")
    assert "upside_down.csv: F_z looks inverted" in told(tmp_path / "upside_down.csv", "wrong.csv")
    (tmp_path / "run" / "results.json").unlink()
    assert "was stopped before it was done" in told(world / "explore.csv", "part.csv")


def test_nothing_is_overwritten_silently(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (world / "run" / "belief.json").read_bytes()
    code = call(
        "estimate", str(world / "explore.csv"), "--prior", PRIOR, "--out", str(world / "run")
    )
    assert code == 2
    assert "is not empty" in capsys.readouterr().err
    assert (world / "run" / "belief.json").read_bytes() == before
    existing = tmp_path / "p.csv"
    existing.write_text("mine")
    code = call("predict", str(world / "run"), str(world / "test.csv"), "--out", str(existing))
    assert code == 2 and existing.read_text() == "mine"


def test_a_belief_of_another_controller_is_refused(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for suffix in ("csv", "yaml"):
        shutil.copy(world / f"test.{suffix}", tmp_path / f"stiff.{suffix}")
    header = (tmp_path / "stiff.yaml").read_text().replace("100.0", "150.0")
    (tmp_path / "stiff.yaml").write_text(header)
    arguments = (str(world / "run"), str(tmp_path / "stiff.csv"))
    code = call("predict", *arguments, "--out", str(tmp_path / "p.csv"))
    assert code == 2
    assert "stiffness" in capsys.readouterr().err
    assert not (tmp_path / "p.csv").exists()


@pytest.mark.parametrize(
    ("size", "shape", "told"),
    [
        (500.0, 0.4, ""),
        (500.0, None, ""),
        (500.0, 1.2, "1.2"),
        (3.0, 0.4, "of 3"),
        (3.0, None, "of 3"),
    ],
)
def test_a_belief_that_few_draws_carry_is_warned_of(
    size: float, shape: float | None, told: str
) -> None:
    from tpcd.commands.estimation import few_draws_warning

    row = {"step": 7, "effective_sample_size": size, "tail_shape": shape}
    warning = few_draws_warning(row)
    assert (warning is not None) == bool(told)
    assert told in (warning or "")


def test_the_outline_in_the_scene_is_a_central_one() -> None:
    """Not the first of equal weights, and where weight gathers."""
    angles = torch.linspace(0, 2 * torch.pi, 33, dtype=torch.float64)[:-1]
    circle = torch.stack((angles.cos(), angles.sin()), -1)
    radii = torch.tensor([0.01, 0.05, 0.051, 0.052, 0.09], dtype=torch.float64)
    outlines = radii[:, None, None] * circle
    for weights, expected in (([1.0] * 5, 2), ([0.1, 0.1, 0.1, 0.1, 9.0], 4)):
        found = central_outline(outlines, torch.tensor(weights, dtype=torch.float64))
        torch.testing.assert_close(found, outlines[expected])
