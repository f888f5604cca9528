"""Training runs end to end on three built-in outlines and learns their shapes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from tpcd.cli import run as run_command
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.checkpoint import load_prior
from training.config import DataConfig, OptimConfig, TrainingConfig
from training.evaluate import outline_errors
from training.kept import read_kept
from training.outlines import data_hash, mirrored, suitable, training_outlines
from training.rates import cosine_rate, split_optimizers
from training.train import Training, train_prior
from training.validity import TrainingError

CONFIGS = Path(__file__).resolve().parents[1] / "training" / "configs"
NAMES = ("drink_can", "banana", "juice_carton")
ARGUMENTS = [
    f"--config={CONFIGS / 'builtin-z2.yaml'}",
    f"--data.only=[{','.join(NAMES)}]",
    "--layout.between=200",
    "--layout.object_samples=1000",
    "--layout.attempts=1",
    "--network.width=64",
    "--network.frequency=3",
    "--optim.batch=768",
    "--optim.latents=64",
    "--optim.threads=1",
    "--check.mask_cells=8",
    "--check.draws=40",
    "--check.unseen=false",
]


def call(*arguments: str) -> int:
    """Train by the command; its exit code."""
    with pytest.raises(SystemExit) as stopped:
        run_command(train_prior, Training, list(arguments), prog="train")
    return int(stopped.value.code or 0)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    assert call(*ARGUMENTS, "--optim.steps=210", f"--out={out}") == 0
    return out


def test_the_prior_learns_its_outlines(run: Path) -> None:
    shape = load_prior(run / "builtin-z2")
    assert set(shape.names) == set(NAMES)
    for name in NAMES:
        errors = outline_errors(shape, shape.code_of(name), builtin_outlines()[name].vertices)
        assert errors["outline"].mean() < 0.8
        assert np.abs(errors["support"]).mean() < 0.8


def test_the_card_tells_what_was_done(run: Path) -> None:
    card = json.loads((run / "builtin-z2" / "card.json").read_text())
    assert set(card["outlines"]) == set(NAMES)
    assert card["configuration"]["optim"]["steps"] == 210
    assert card["training_errors_mm"]["outline"]["mean"] < 0.8
    assert card["valid_share"] > 0.8
    assert {"torch", "numpy", "python"} <= set(card["versions"])
    assert "learning_rates_from_step_of_steps" not in card
    outlines = training_outlines(DataConfig("builtin", only=list(NAMES)), np.random.default_rng(0))
    assert card["data_sha256"] == data_hash(outlines)


def test_figures_and_tensorboard_are_written(run: Path) -> None:
    for name in ("outlines", "latent_map", "worst"):
        assert (run / f"{name}.png").stat().st_size > 10_000
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    scalars: set[str] = set()
    for file in (run / "tensorboard").glob("events*"):
        events = EventAccumulator(str(file))
        events.Reload()
        scalars |= set(events.Tags()["scalars"]) | set(events.Tags()["images"])
    wanted = {
        "loss",
        "loss/distance",
        "loss/support",
        "loss/outline",
        "outlines",
        "latent_map",
        "worst",
    }
    assert wanted | {f"error_mm/{name}" for name in NAMES} <= scalars


def test_a_run_resumes_where_it_stopped(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert read_kept(run / "last.ckpt")[0].steps_done == 210
    assert call(*ARGUMENTS, "--optim.steps=230", f"--out={run}", "--resume") == 0
    card = load_prior(run / "builtin-z2").card
    assert card["configuration"]["optim"]["steps"] == 230
    # No training of 230 steps that was not stopped has had these learning rates.
    assert card["learning_rates_from_step_of_steps"] == [[0, 210], [210, 230]]


def test_a_run_of_another_network_is_not_resumed(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(*ARGUMENTS, "--network.width=32", f"--out={run}", "--resume") == 2
    message = capsys.readouterr().err.strip()
    assert "holds a run whose network is not the same" in message and "\n" not in message


def test_resuming_from_nothing_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(*ARGUMENTS, f"--out={tmp_path}", "--resume") == 2
    message = capsys.readouterr().err.strip()
    assert "last.ckpt" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], "is not empty; name a new folder or pass --overwrite"),
        (["--out={0}/config.yaml"], "config.yaml is a file; name another folder"),
        (["--out={1}", "--export={0}/config.yaml"], "config.yaml: is a file"),
        (["--out={1}", "--export={0}/builtin-z2"], "is not empty; name a new folder"),
    ],
)
def test_nothing_is_trained_over_what_is_there(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options, expected: str
) -> None:
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    options = [option.format(run, tmp_path / "new") for option in options] or [f"--out={run}"]
    assert call(*ARGUMENTS, *options) == 2
    message = capsys.readouterr().err.strip()
    assert expected in message and "\n" not in message
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before
    assert not (tmp_path / "new").exists()


def test_a_training_that_fails_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def failing(*arguments):
        raise TrainingError("the trained network decodes to nothing")

    monkeypatch.setattr("training.run.prepare", failing)
    assert call(*ARGUMENTS, f"--out={tmp_path / 'x'}") == 2
    assert "decodes to nothing" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_unknown_outlines_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--data.source=builtin", "--data.only=[teapot]", f"--out={tmp_path / 'x'}"]
    assert call(*arguments) == 2
    assert "teapot" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    "argument", ["--optim.steps=0", "--layout.extent=2", "--optim.latents=0", "--optim.x=1"]
)
def test_bad_settings_are_refused_in_one_line(
    argument: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(argument) == 2
    message = capsys.readouterr().err.strip()
    assert argument[2:].partition("=")[0].split(".")[1] in message
    assert "\n" not in message


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_configuration_parses(path: Path) -> None:
    from training.measure import config_of

    saved = yaml.safe_load(path.read_text())
    config = config_of(saved)
    assert isinstance(config, TrainingConfig)
    assert config.name == path.stem


def test_leaving_out_an_object_leaves_out_its_views_and_mirror_images() -> None:
    config = DataConfig("builtin", mirror=True, leave_out=["mug"], builtin_variants=5)
    found = training_outlines(config, np.random.default_rng(0))
    assert not any(name.startswith("mug") for name in found)
    assert {"banana", "banana/mirrored"} <= set(found)
    assert any(name.startswith("builtin/") for name in found)
    assert all(suitable(vertices, config) for vertices in found.values())


def test_a_mirrored_outline_is_counter_clockwise() -> None:
    vertices = builtin_outlines()["mug"].vertices
    after = np.roll(mirrored(vertices), -1, axis=0)
    area = 0.5 * np.sum(
        mirrored(vertices)[:, 0] * after[:, 1] - mirrored(vertices)[:, 1] * after[:, 0]
    )
    assert area > 0
    np.testing.assert_array_equal(mirrored(mirrored(vertices)), vertices)


def test_the_learning_rate_rises_and_falls() -> None:
    rates = [cosine_rate(step, 1000) for step in range(1000)]
    assert rates[0] < 0.03
    assert max(rates) == pytest.approx(1.0, abs=0.02)
    assert rates[-1] < 0.01


def test_every_weight_has_exactly_one_optimiser() -> None:
    from tpcd.shape.deepsdf import Architecture, DeepSDFNetwork

    network = DeepSDFNetwork(Architecture(2), 3)
    optimizers = split_optimizers(network.decoder, network.codes, 1, 1, 1)
    held = [id(p) for o in optimizers for g in o.param_groups for p in g["params"]]
    assert sorted(held) == sorted(id(p) for p in network.parameters())
    assert OptimConfig().steps > 0
