"""A checkpoint comes back as it was saved; a bad one gets one line, and nothing is unpickled."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from tpcd.errors import CheckpointError
from tpcd.shape.checkpoint import CARD, WEIGHTS, load_prior, save_prior
from tpcd.shape.deepsdf import Architecture, DeepSDFNetwork
from tpcd.shape.density import MaskDensity
from tpcd.shape.protocol import Misfit

SMALL = Architecture(2, width=8, depth=1, points=16)
MISFIT = Misfit(0.002, 0.8, 0.2, 0.1, 5.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = DeepSDFNetwork(SMALL, 3)
    density = MaskDensity(torch.eye(4, dtype=torch.bool))
    return save_prior(tmp_path / "small", network, density, ("a", "b", "c"), MISFIT, {"note": "x"})


def test_a_saved_prior_comes_back_the_same(folder: Path, tmp_path: Path) -> None:
    first = load_prior(folder)
    second = load_prior(
        save_prior(tmp_path / "again", first.network, first.density, first.names, MISFIT, {})
    )
    latent = torch.linspace(-0.9, 0.9, 10, dtype=torch.float64).reshape(5, 2)
    torch.testing.assert_close(second.boundary_points(latent), first.boundary_points(latent))
    points = torch.rand(5, 4, 2, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(
        second.signed_distance(points, latent), first.signed_distance(points, latent)
    )
    assert torch.equal(second.valid(latent), first.valid(latent))
    assert (second.misfit, second.names) == (MISFIT, ("a", "b", "c"))
    assert first.card["note"] == "x"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["again", "small"]


def _edit_card(folder: Path, **changes: object) -> None:
    card = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(card | changes))


def test_a_card_without_the_texture_of_the_misfit_takes_the_defaults(folder: Path) -> None:
    card = json.loads((folder / CARD).read_text())
    for key in ("misfit_log_std", "misfit_width_rad", "misfit_grain", "misfit_roughness_per_rad"):
        del card[key]
    (folder / CARD).write_text(json.dumps(card))
    assert load_prior(folder).misfit == Misfit(sd=MISFIT.sd)


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("key", ["misfit_sd_m", "misfit_width_rad", "misfit_roughness_per_rad"])
def test_a_misfit_without_meaning_is_refused(folder: Path, key: str, value: float) -> None:
    _edit_card(folder, **{key: value})
    with pytest.raises(CheckpointError, match="of the misfit is .*, expected a finite number"):
        load_prior(folder)


def test_a_misfit_in_millimetres_is_refused(folder: Path) -> None:
    _edit_card(folder, misfit_sd_m=1.5)
    with pytest.raises(CheckpointError, match="'misfit_sd_m' .1.5., expected at most 0.5 m"):
        load_prior(folder)


def test_weights_of_a_larger_network_are_refused(folder: Path) -> None:
    """Regression: layers that the card does not know were dropped without a word."""
    _edit_tensors(folder, lambda t: t.update({"decoder.4.weight": torch.zeros(8, 8)}))
    with pytest.raises(CheckpointError, match="holds the tensor 'decoder.4.weight'"):
        load_prior(folder)


def test_the_card_tells_the_size_of_the_weights_it_is_saved_with(folder: Path, tmp_path) -> None:
    small = load_prior(folder)
    deeper = Architecture(2, width=8, depth=3, points=16)
    network = DeepSDFNetwork(deeper, 3)
    saved = save_prior(tmp_path / "deeper", network, small.density, small.names, MISFIT, small.card)
    assert load_prior(saved).network.architecture == deeper


def _edit_tensors(folder: Path, change) -> None:
    tensors = load_file(folder / WEIGHTS)
    change(tensors)
    save_file(tensors, folder / WEIGHTS)
    import hashlib

    digest = hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()
    _edit_card(folder, weights_sha256=digest)


def _truncate(folder: Path) -> None:
    data = (folder / WEIGHTS).read_bytes()
    (folder / WEIGHTS).write_bytes(data[: len(data) // 2])


DEFECTS = {
    "format version 99": lambda f: _edit_card(f, format_version=99),
    "not a card": lambda f: (f / CARD).write_text("[]"),
    "no readable JSON": lambda f: (f / CARD).write_text("{"),
    "card.json: is missing": lambda f: (f / CARD).unlink(),
    "weights.safetensors: is missing": lambda f: (f / WEIGHTS).unlink(),
    "no safetensors file": _truncate,
    "hash differs": lambda f: _edit_card(f, weights_sha256="0"),
    "lacks or garbles 'outlines'": lambda f: (f / CARD).write_text(
        json.dumps({k: v for k, v in json.loads((f / CARD).read_text()).items() if k != "outlines"})
    ),
    "lacks or garbles 'pickle'": lambda f: _edit_card(f, density="pickle"),
    "lacks the tensor 'decoder.0.weight'": lambda f: _edit_tensors(
        f, lambda t: t.pop("decoder.0.weight")
    ),
    "holds NaN": lambda f: _edit_tensors(f, lambda t: t["decoder.0.bias"].fill_(torch.nan)),
    "'codes' has shape": lambda f: _edit_tensors(f, lambda t: t.update(codes=torch.zeros(9, 2))),
    "density tensor": lambda f: _edit_tensors(f, lambda t: t.pop("density.cells")),
    "width is 8.5, expected a whole number": lambda f: _edit_size(f, width=8.5),
    "depth is True, expected a whole number": lambda f: _edit_size(f, depth=True),
    "points is 10000000000, expected 1 to 4096": lambda f: _edit_size(f, points=10**10),
    "latent_dim is 0, expected 1 to": lambda f: _edit_size(f, latent_dim=0),
    "has shape (8, 2), expected (16000, 2)": lambda f: _edit_size(f, width=16_000),
    "expected depth, latent_dim, points, width": lambda f: _edit_size(f, heads=4),
    "'outlines' ('abc'), expected a list": lambda f: _edit_card(f, outlines="abc"),
    "'outlines' with a name twice": lambda f: _edit_card(f, outlines=["a", "a", "b"]),
    "'outlines' with the name 3": lambda f: _edit_card(f, outlines=["a", "b", 3]),
    "'misfit_grain' ('0.1'), expected a number": lambda f: _edit_card(f, misfit_grain="0.1"),
    "is no readable JSON (maximum recursion": lambda f: (f / CARD).write_text("[" * 100_000),
    "'decoder.0.bias' holds int64": lambda f: _edit_tensors(
        f, lambda t: t.update({"decoder.0.bias": torch.zeros(8, dtype=torch.int64)})
    ),
    "'cells' of shape (4, 3), expected a square": lambda f: _edit_tensors(
        f, lambda t: t.update({"density.cells": torch.ones(4, 3, dtype=torch.uint8)})
    ),
    "'cells', expected 0 and 1, and one of them 1": lambda f: _edit_tensors(
        f, lambda t: t["density.cells"].zero_()
    ),
}


def _edit_size(folder: Path, **changes: object) -> None:
    size = json.loads((folder / CARD).read_text())["architecture"]
    _edit_card(folder, architecture=size | changes)


def _mixture() -> dict[str, torch.Tensor]:
    eye = torch.eye(2, dtype=torch.float64)
    return {
        "weights": torch.tensor([0.25, 0.75], dtype=torch.float64),
        "means": torch.zeros(2, 2, dtype=torch.float64),
        "factors": 0.1 * eye.expand(2, 2, 2).clone(),
        "truncation": torch.tensor([-3.0, 0.9], dtype=torch.float64),
    }


MIXTURES = {
    "'weights', expected positive numbers that sum to 1": lambda t: t["weights"].mul_(2),
    "'weights', expected positive": lambda t: t["weights"].copy_(torch.tensor([-0.5, 1.5])),
    "weights, means and factors of shapes": lambda t: t.update(means=t["means"][:1].clone()),
    "'factors', expected lower triangles": lambda t: t["factors"].neg_(),
    "'truncation' of 1 numbers": lambda t: t.update(truncation=t["truncation"][:1].clone()),
    "'truncation' that keeps 0 of the mixture": lambda t: t["truncation"][1].zero_(),
    "has a density that is not finite": lambda t: t["means"].fill_(torch.nan),
    "density of 3 dimensions for 2 latents": lambda t: t.update(
        means=torch.zeros(2, 3).double(), factors=torch.eye(3).double().expand(2, 3, 3).clone()
    ),
}


@pytest.mark.parametrize("message", MIXTURES)
def test_a_mixture_that_is_none_gets_one_line(folder: Path, message: str) -> None:
    def with_mixture(tensors: dict[str, torch.Tensor]) -> None:
        density = _mixture()
        MIXTURES[message](density)
        del tensors["density.cells"]
        tensors.update({f"density.{name}": value for name, value in density.items()})

    _edit_tensors(folder, with_mixture)
    _edit_card(folder, density="mixture")
    with pytest.raises(CheckpointError) as caught:
        load_prior(folder)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert str(folder / WEIGHTS) in str(caught.value)


def test_a_mixture_comes_back(folder: Path) -> None:
    _edit_tensors(
        folder, lambda t: t.update({f"density.{name}": value for name, value in _mixture().items()})
    )
    _edit_card(folder, density="mixture")
    draws = load_prior(folder).sample_latent(5, torch.Generator().manual_seed(0), checked=False)
    assert draws.shape == (5, 2) and draws.isfinite().all()


PLACES = {
    "is a checkpoint of a training, expected the folder of a prior": "run/last.ckpt",
    "is the run of a training that has not written its prior": "run",
    "is a file, expected the folder of a prior, with card.json": "small/card.json",
    "is a file, expected the folder of a prior, with card": "small/weights.safetensors",
    "is a file, expected the folder": "notes.txt",
    "holds no prior itself, but 1 below it": ".",
}


@pytest.mark.parametrize("message", PLACES)
def test_a_place_that_holds_no_prior_is_called_what_it_is(
    folder: Path, tmp_path: Path, message: str
) -> None:
    (tmp_path / "run").mkdir()
    torch.save({"state_dict": {"a": torch.zeros(2)}}, tmp_path / "run" / "last.ckpt")
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(CheckpointError) as caught:
        load_prior(tmp_path / PLACES[message])
    assert message in str(caught.value) and "\n" not in str(caught.value)
    if message.startswith("holds"):
        assert str(caught.value).endswith(f"give {folder}")


@pytest.mark.parametrize("message", DEFECTS)
def test_a_defect_gets_one_line_that_names_it(folder: Path, message: str) -> None:
    DEFECTS[message](folder)
    with pytest.raises(CheckpointError) as caught:
        load_prior(folder)
    text = str(caught.value)
    assert message in text
    assert "\n" not in text
    assert str(folder) in text


def test_a_missing_prior_names_those_that_exist() -> None:
    with pytest.raises(CheckpointError, match="ycb21-z2"):
        load_prior("no-such-prior")


def test_loading_unpickles_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a pickle was read")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    monkeypatch.setattr(torch, "load", refuse)
    load_prior(folder)


def test_a_pickle_in_place_of_the_weights_is_refused(folder: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple:
            return (Path.touch, (folder / "boom",))

    (folder / WEIGHTS).write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(CheckpointError):
        load_prior(folder)
    assert not (folder / "boom").exists()
