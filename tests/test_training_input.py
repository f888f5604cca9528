"""Settings, outlines and losses that lead nowhere end a training at once, in one line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tpcd.cli import run as run_command
from tpcd.errors import CheckpointError, FileError
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.checkpoint import load_prior, save_prior
from tpcd.shape.protocol import Misfit
from training.config import DataConfig, LayoutConfig, NetworkConfig, OptimConfig, TrainingConfig
from training.data import Prepared, prepare
from training.evaluate import measure_prior
from training.fitting import fit
from training.kept import CHECKPOINT, Kept, read_kept
from training.layout import make_layout
from training.measure import training_of
from training.module import PriorModule
from training.outlines import training_outlines
from training.run import quoted_errors, train
from training.train import Training, train_prior
from training.watch import DIVERGED, TrainingError, check_loss, check_weights

FOUR = ["drink_can", "banana", "juice_carton", "mug"]
CONFIG = TrainingConfig(
    data=DataConfig("builtin", only=FOUR),
    layout=LayoutConfig(points=32, between=50, object_samples=100, attempts=1, components=2),
    network=NetworkConfig(width=16, depth=2, frequency=3.0),
    optim=OptimConfig(steps=8, batch=32, latents=8, threads=1),
)


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return prepare(CONFIG)


def refused(capsys: pytest.CaptureFixture[str], out: Path, *arguments: str) -> str:
    """The one line with which the command refuses, having left nothing."""
    given = [f"--out={out}", "--data.source=builtin", f"--data.only=[{','.join(FOUR)}]"]
    with pytest.raises(SystemExit) as stopped:
        run_command(train_prior, Training, [*given, *arguments], prog="train")
    message = capsys.readouterr().err.strip()
    assert stopped.value.code == 2 and "\n" not in message, message
    assert not out.exists()
    return message


@pytest.mark.parametrize("latents", [4, 6])
def test_more_latents_than_ways_in_which_outlines_differ_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], latents: int
) -> None:
    message = refused(capsys, tmp_path / "run", f"--network.latent_dim={latents}")
    assert (
        f"network.latent_dim is {latents}, but 4 outlines differ in 3 independent ways" in message
    )
    assert "expected at most 3 latents" in message


def test_as_many_latents_as_ways_have_finite_codes() -> None:
    config = replace(CONFIG, network=replace(CONFIG.network, latent_dim=3))
    codes = prepare(config).codes
    assert codes.shape == (4, 3) and codes.isfinite().all() and (codes.std(0) > 0.1).all()


def test_the_same_outline_twice_is_not_another_way_to_differ() -> None:
    rng = np.random.default_rng(0)
    outlines = rng.standard_normal((4, 32, 2)) * 0.05
    again = np.concatenate((outlines, outlines[:2]))
    with pytest.raises(ValueError, match="6 outlines differ in 3 independent ways"):
        make_layout(again, 4, CONFIG.layout, rng)
    with pytest.raises(ValueError, match="all 5 outlines to train on are the same"):
        make_layout(np.repeat(outlines[:1], 5, 0), 2, CONFIG.layout, rng)


@pytest.mark.parametrize("only", [["mug"], ["mug", "banana"], ["mug", "mug", "mug"]])
def test_too_few_outlines_are_refused(only: list[str]) -> None:
    found = len(set(only))
    with pytest.raises(ValueError, match=f"^{found} outlines are left .* expected at least 3"):
        training_outlines(DataConfig("builtin", only=only), np.random.default_rng(0))


def test_an_outline_with_nan_is_refused_with_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    square = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])
    broken = np.where(square == 0.1, np.nan, square)
    np.savez(tmp_path / "slices.npz", a=square, b=broken)
    monkeypatch.setattr("tpcd.shape.ycb.ycb_folder", lambda: tmp_path)
    with pytest.raises(FileError, match=r"slices.npz: outline 'b'"):
        training_outlines(DataConfig("ycb21"), np.random.default_rng(0))


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ("optim.seed=-1", "seed is -1, expected 0 to"),
        ("optim.batch=1000000000000", "batch is 1000000000000, expected at most"),
        ("optim.muon_rate=-0.1", "muon_rate is -0.1, expected at least 0"),
        ("optim.distance_weight=1e38", "distance_weight is 1e+38, expected at most"),
        ("layout.neighbours=1", "neighbours is 1, expected at least 2"),
        ("layout.near_spread=15", "near_spread is 15.0, expected at most 1"),
        ("network.frequency=1e30", "frequency is 1e+30, expected at most"),
        ("network.depth=1000", "depth is 1000, expected at most"),
        ("check.draws=3", "draws is 3, expected at least 4"),
        ("check.mask_cells=100000", "mask_cells is 100000, expected at most"),
        ("check.mask_cells=1.5", "check.mask_cells"),
        ("data.leave_out=['']", "leave_out or only holds an empty name"),
        ("data.leave_out=['zzz']", "leave_out names zzz, with which no outline's name begins"),
        ("data.largest_size=260", "largest_size is 260, expected at most 5 in size; lengths are"),
        ("name=..", "name is '..', expected the plain name of a folder"),
        ("name=a/b", "name is 'a/b', expected the plain name of a folder"),
        ("unseen_from=no-such-prior", "no-such-prior: holds no prior"),
    ],
)
def test_settings_out_of_range_are_refused_before_anything_is_trained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, expected: str
) -> None:
    assert expected in refused(capsys, tmp_path / "run", f"--{option}")


def test_a_run_is_not_replaced_by_its_own_prior(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert "is the folder of the run" in refused(capsys, out, f"--export={out}")
    assert "not both" in refused(capsys, out, "--resume", "--overwrite")


def test_fewer_latents_in_between_than_components_are_refused() -> None:
    sizes = NetworkConfig(latent_dim=3)
    with pytest.raises(ValueError, match="layout.between is 47, expected at least 48"):
        TrainingConfig(network=sizes, layout=LayoutConfig(between=47, components=24))
    assert TrainingConfig(network=sizes, layout=LayoutConfig(between=48, components=24))


def test_all_weights_of_the_loss_zero_are_refused() -> None:
    with pytest.raises(ValueError, match="distance_weight and .* are 0, expected one of them"):
        OptimConfig(distance_weight=0, support_weight=0, outline_weight=0)


@pytest.mark.parametrize("rate", ["adam_rate", "muon_rate"])
@pytest.mark.parametrize("value", [1e6, 1e30])
def test_a_training_that_diverges_stops_at_once_and_keeps_what_was_good(
    prepared: Prepared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate: str, value: float
) -> None:
    monkeypatch.setattr("training.kept.EVERY", 1)
    config = replace(CONFIG, optim=replace(CONFIG.optim, **{rate: value}))
    with pytest.raises(TrainingError, match=rf"the loss .* step 2\b.*{rate} \(1e\+") as caught:
        fit(PriorModule(prepared, config), prepared, config, tmp_path)
    assert "decodes" not in str(caught.value) and "\n" not in str(caught.value)
    kept, weights = read_kept(tmp_path / CHECKPOINT)
    assert kept.steps_done == 1 and all(value.isfinite().all() for value in weights.values())


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("term", ["distance", "support", "outline"])
def test_a_loss_that_is_not_finite_is_told_with_its_term(
    prepared: Prepared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: float, term: str
) -> None:
    monkeypatch.setattr("training.kept.EVERY", 2)
    whole = PriorModule.loss_terms

    def broken(module: PriorModule, batch):
        terms = whole(module, batch)
        return terms | ({term: terms[term] * 0 + value} if batch.step == 5 else {})

    module = PriorModule(prepared, CONFIG)
    monkeypatch.setattr(PriorModule, "loss_terms", broken)
    with pytest.raises(TrainingError, match=f"the loss is .* at step 6 .*loss/{term} {value}"):
        fit(module, prepared, CONFIG, tmp_path)
    assert read_kept(tmp_path / CHECKPOINT)[0].steps_done == 4
    assert all(weight.isfinite().all() for weight in module.parameters())


def test_weights_that_are_not_finite_are_never_kept(
    prepared: Prepared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("training.kept.EVERY", 2)
    module = PriorModule(prepared, CONFIG)
    whole = PriorModule.training_step

    def broken(module: PriorModule, batch, index: int) -> None:
        whole(module, batch, index)
        if batch.step == 7:
            module.network.codes.data[0, 0] = torch.nan

    monkeypatch.setattr(PriorModule, "training_step", broken)
    with pytest.raises(
        TrainingError, match="weights 'network.codes' hold NaN or infinity after step 8"
    ):
        fit(module, prepared, CONFIG, tmp_path)
    assert read_kept(tmp_path / CHECKPOINT)[0].steps_done == 6


def test_a_loss_within_bounds_is_let_go_on() -> None:
    for loss in (0.0, 1.0, 0.99 * DIVERGED):
        check_loss({"loss": torch.tensor(loss)}, 1.0, 3, CONFIG.optim)
    check_loss({"loss": torch.tensor(1e9)}, None, 3, CONFIG.optim)
    with pytest.raises(TrainingError, match="grown from 1 to 101 by step 3"):
        check_loss({"loss": torch.tensor(1.01 * DIVERGED)}, 1.0, 3, CONFIG.optim)
    check_weights(torch.nn.Linear(2, 2), 3, CONFIG.optim)


def test_a_prior_without_unseen_errors_is_not_quoted(monkeypatch: pytest.MonkeyPatch) -> None:
    shape = load_prior("ycb21-z2")
    card = {key: value for key, value in shape.card.items() if key != "unseen"}
    monkeypatch.setattr("training.run.load_prior", lambda prior: replace(shape, card=card))
    with pytest.raises(CheckpointError, match="ycb21-z2: has a card without unseen errors"):
        quoted_errors("ycb21-z2")


def test_a_card_with_settings_of_another_program_is_not_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shape = load_prior("ycb21-z2")
    card = {**shape.card, "configuration": {"optim": {"momentum": 3}}}
    monkeypatch.setattr(
        "tpcd.shape.checkpoint.load_prior", lambda folder: replace(shape, card=card)
    )
    with pytest.raises(CheckpointError, match="configuration is not understood .*momentum"):
        training_of(tmp_path)


def test_too_few_steps_are_told_with_what_the_loss_did(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        f"--out={tmp_path / 'run'}",
        "--data.source=builtin",
        f"--data.only=[{','.join(FOUR)}]",
        "--layout.between=50",
        "--layout.object_samples=100",
        "--layout.attempts=1",
        "--network.width=16",
        "--optim.steps=3",
        "--optim.threads=1",
        "--check.mask_cells=4",
        "--check.draws=8",
        "--check.unseen=false",
    ]
    with pytest.raises(SystemExit) as stopped:
        run_command(train_prior, Training, arguments, prog="train")
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert stopped.value.code == 2
    assert "no cell of latents decodes to closed outlines; train for more steps" in message
    assert "the loss went from" in message and "in 3 steps" in message
    left = sorted(path.name for path in (tmp_path / "run").iterdir())
    assert left == ["config.yaml", CHECKPOINT, "tensorboard", "versions.json"]


def test_level_sets_that_are_no_single_curve_leave_their_figures_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Regression: a prior of few steps, none of whose traced draws was one curve: IndexError."""
    shape = load_prior("ycb21-z2")
    outlines = {"banana": builtin_outlines()["banana"].vertices}
    named = replace(shape, names=("banana", *shape.names[1:]))
    monkeypatch.setattr(
        "training.evaluate.level_set_errors",
        lambda shape, latents: (np.zeros(0), np.full(len(latents), np.nan)),
    )
    monkeypatch.setattr("training.evaluate.plausible_share", lambda shape, latents: 0.0)
    card = measure_prior(named, outlines, draws=50)
    assert card["level_set_to_outline_mm"] is None and card["level_set_support_mm"] is None
    assert "at 12 draws, one closed curve at 0 of them" in str(card["level_set_is"])
    json.dumps(card, allow_nan=False)


def test_a_prior_that_cannot_be_measured_is_not_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = load_prior("ycb21-z2")

    def exported(network, prepared, config, folder: Path, kept: Kept) -> Path:
        return save_prior(
            folder, shipped.network, shipped.density, shipped.names, Misfit(), {"note": "x"}
        )

    def failing(*_: object) -> None:
        raise ValueError("after 100 rounds of drawing anew")

    monkeypatch.setattr("training.run.fit", lambda *_: Kept(steps_done=8))
    monkeypatch.setattr("training.run.export_prior", exported)
    monkeypatch.setattr("training.run.measure_prior", failing)
    with pytest.raises(ValueError, match="100 rounds"):
        train(CONFIG, tmp_path, tmp_path / "prior")
    assert list(tmp_path.iterdir()) == []
